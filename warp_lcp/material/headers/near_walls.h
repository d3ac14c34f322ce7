// Call act(i) on the faces first <= i < last of a row that a wall may change: closed ones that are known, and those of the ring. A pass
// over marks and fractions finds them, so that rows away from walls cost 5 bytes a face. Pointers are to whole fields.
const int nx = given.known.shape[2] - 2, ny = given.known.shape[1] - 2, nz = given.known.shape[0] - 2;
const long long row = k*s1 + j*s2;
const signed char* known = given.known.data; const float* open = given.open.data;
auto each = [&](auto act) {
    const bool ring = j < 1 || (j > ny && axis != 1) || (planes == 2 && (k < 1 || (k > nz && axis != 2)));
    const int low = first > 1 ? first : 1, end = axis == 0 ? nx + 2 : nx + 1, high = last < end ? last : end;
    if (ring) { for (int i = first; i < last; ++i) act(i); return; }
    if (first == 0) act(0);
    for (int start = low; start < high; start += M) {
        const int n = high - start < M ? high - start : M;
        unsigned char closed[M], any = 0;
        SIMD for (int m = 0; m < n; ++m) {
            const unsigned char c = (int)(open[row + start + m] == 0) & (int)(known[row + start + m] > 0);
            closed[m] = c; any |= c;
        }
        if (any) for (int m = 0; m < n; ++m) if (closed[m]) act(start + m);
    }
    if (last == nx + 2 && end == nx + 1) act(nx + 1);
};
