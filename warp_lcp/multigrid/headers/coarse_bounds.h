// Bounds of a coarse correction: the tightest of its cells' gaps, divided by the over-correction; 0 is always allowed.
T low[2*M], high[2*M]; const T big = (T)1e30, inverse = reciprocal(scale); const int fx = pairs ? 2 : 1;
for (int begin = 0; begin < n; begin += M) {
    const int m = n - begin < M ? n - begin : (int)M;
    SIMD for (int k = 0; k < fx*m; ++k) { low[k] = -big; high[k] = big; }
    for (int z = 0; z < deep; ++z) for (int y = 0; y < wide; ++y) {
        const long long at = z*zp + y*yp + fx*begin;
        const auto* e = d + at; const T *to = x + at, *l = lower + at, *u = upper ? upper + at : l;
        SIMD for (int k = 0; k < fx*m; ++k) {
            const T a0 = (l[k] - to[k])*inverse, b0 = (u[k] - to[k])*inverse, a1 = a0 > 0 ? (T)0 : a0, b1 = b0 < 0 ? (T)0 : b0;
            const T a = e[k] != 0 ? a1 : -big, b = e[k] != 0 ? b1 : big;
            low[k] = a > low[k] ? a : low[k]; high[k] = b < high[k] ? b : high[k]; } }
    const auto tightest = [&](auto* coarse, const T* v, auto better) {
        if (pairs) { SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = better(v[2*k], v[2*k+1]); }
        else { SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = v[k]; } };
    tightest(coarse_lower, low, [](T a, T b) { return a > b ? a : b; });
    if (coarse_upper) tightest(coarse_upper, high, [](T a, T b) { return a < b ? a : b; }); }
