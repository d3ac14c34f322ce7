// Rows of a small level's matrix, of a compact stencil; cells that are no unknowns have a row of zeros.
const int m = planes*lines*cells;
for (int k = 0; k < n; ++k) {
    const int at[3] = {P.first + k, P.j, P.k}, counts[3] = {cells, lines, planes}, r = (at[2]*lines + at[1])*cells + at[0];
    const bool turns[3] = {periodic_x, periodic_y, periodic_z}; const T e = diagonal(k); double* row = matrix + (long long)r*m;
    for (int c = 0; c < m; ++c) row[c] = 0;
    if (e == 0) continue;
    row[r] = e;
    const auto visit = [&](int X, int Y, int Z, T w) {
        const int steps[3] = {X, Y, Z}; const long long strides[3] = {1, yp, zp}; int c = 0; long long q = k;
        for (int a = 2; a >= 0; --a) {
            int i = at[a] + steps[a]; q += steps[a]*strides[a];
            if (i < 0 || i >= counts[a]) {
                if (!turns[a]) return;
                const int turn = i < 0 ? counts[a] : -counts[a]; i += turn; q += turn*strides[a]; }
            c = c*counts[a] + i; }
        if (d[q] != 0) row[c] -= w; };
    const auto visit_all = [&](auto) {
#define BEFORE(W, X, Y, Z) visit(X, Y, Z, (T)W(k));
#define AND_AFTER(W, X, Y, Z) BEFORE(W, X, Y, Z) visit(-(X), -(Y), -(Z), (T)W(k - (X) - (Y)*yp - (Z)*zp));
        if constexpr (SYMMETRIC) { EACH_WEIGHT(AND_AFTER) } else { EACH_WEIGHT(BEFORE) }
#undef BEFORE
#undef AND_AFTER
    };
    visit_all(0); }
