// The center's coefficient plus those of closed neighbors, whose value is the cell's own, plus the shift.
for (int k = 0; k < n; ++k) {
    const T closed = around_of([&](int i, int rows, int planes) { return (T)(cells[i + beside(rows, planes, zm, zp)] == 2); }, k);
    T v = (center ? (T)center[k] : number) - closed;
    if (shift) v += (T)shift[k];
    made[k] = cells[k] == 1 ? v : (T)0; }
