// g = -(A x + b) / SIZE on the free set, in flagged rows and those beside them.
const auto flagged = [&](int k, int j) -> bool {
    if (around_z) k = (k + L.planes) % L.planes;
    if (around_y) j = (j + L.rows) % L.rows;
    return k >= 0 && k < L.planes && j >= 0 && j < L.rows && away[k*L.rows + j]; };
if (!(flagged(P.k, P.j) || flagged(P.k - 1, P.j) || flagged(P.k + 1, P.j) || flagged(P.k, P.j - 1) || flagged(P.k, P.j + 1))) continue;
const T inverse = reciprocal(scalars[SIZE]);
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M; T y[M];
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    SIMD8 for (int k = begin; k < end; ++k) { const T v = y[k - begin]*inverse; g[k] = free[k] != 0 ? -v : (T)0; } }
