// A row of R A P, R and P by the shares of fine cells in the four coarse ones around; of compact stencils it is one.
const int j0 = FY*P.j, below = FY == 2 && j0 > 0 ? -1 : 0, above = FY == 2 && j0 + 1 < L.n2 ? 1 : 0;
for (int k = 0; k < n; ++k) {
    const int i0 = FX*(P.first + k), left = FX == 2 && i0 > 0 ? -1 : 0, right = FX == 2 && i0 + 1 < cells ? 1 : 0;
    const long long at = P.q + FX*k; T C[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0}, magnitude = 0;
    for (int y = below; y <= above; ++y) for (int x = left; x <= right; ++x) {
        const long long f = at + x + y*yp; const T r = restricts[((x < 0) + 2*(y < 0))*size + f];
        if (r == 0) continue;
        for (int b = -1; b < 2; ++b) for (int a = -1; a < 2; ++a) {
            const int o = 3*b + a + 4, X = x + a, Y = y + b; const long long g = f + a + b*yp;
            const T w = o == 4 ? diagonals[f] : -weights[(o < 4 ? o : o - 1)*size + f], v = r*w;
            if (v == 0) continue;
            const int to_x = FX == 2 ? (X + 2)/2 - 1 : X, to_y = FY == 2 ? (Y + 2)/2 - 1 : Y;
            const bool two_x = FX == 2 && (X & 1), two_y = FY == 2 && (Y & 1); T* c = C + 3*to_y + to_x + 4;
            const T *s = shares + g;
            const T q = v*s[0]; c[0] += q; magnitude += q < 0 ? -q : q;
            if (two_x) c[1] += v*s[size];
            if (two_y) { c[3] += v*s[2*size]; if (two_x) c[4] += v*s[3*size]; } } }
    const bool kept = C[4] > (sizeof(T) == 4 ? (T)1e-6 : (T)1e-13)*magnitude;
    coarse_d[k] = kept ? C[4] : (T)0;
    for (int o = 0; o < 9; ++o) if (o != 4) coarse_weights[(o < 4 ? o : o - 1)*coarse_size + p + k] = kept ? -C[o] : (T)0; }
