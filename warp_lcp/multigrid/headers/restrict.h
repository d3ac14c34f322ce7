// The sums of b - A x over the cells of aggregates: pairs along x or single ones, of `deep` planes and `wide` rows.
T r[2*M]; const int fx = pairs ? 2 : 1;
for (int begin = 0; begin < n; begin += M) {
    const int m = n - begin < M ? n - begin : (int)M;
    SIMD for (int k = 0; k < fx*m; ++k) r[k] = 0;
    for (int z = 0; z < deep; ++z) for (int y = 0; y < wide; ++y) {
        const long long at = z*zp + y*yp + fx*begin;
        SIMD for (int k = 0; k < fx*m; ++k) {
            const int i = (int)at + k; const T e = diagonal(i), v = b[i] - e*x[i] + neighbors(x, i); r[k] += e != 0 ? v : (T)0; } }
    if (pairs) { SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = r[2*k] + r[2*k+1]; }
    else { SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = r[k]; } }
