// Sums of a fine field over coarse cells' shares.
const int j0 = fy*P.j; const bool below = fy == 2 && j0 > 0, above = fy == 2 && j0 + 1 < L.n2;
for (int k = 0; k < n; ++k) {
    const int i0 = fx*(P.first + k); const long long at = fx*k; const bool left = fx == 2 && i0 > 0, right = fx == 2 && i0 + 1 < cells;
    const auto row = [&](long long f, int slot) -> T {
        const T *s = shares + slot*size; T v = s[f]*t[f];
        if (right) v += s[f + 1]*t[f + 1];
        if (left) v += s[size + f - 1]*t[f - 1];
        return v; };
    T v = row(at, 0);
    if (above) v += row(at + yp, 0);
    if (below) v += row(at - yp, 2);
    coarse[k] = v; }
