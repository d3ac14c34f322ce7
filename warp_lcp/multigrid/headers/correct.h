// x += scale times the correction of its aggregate, clipped to the bounds if projected.
if (projected) {
    T e[2*M];  // the correction of each cell, so that what follows reads all fields in steps of one
    for (int begin = 0; begin < n; begin += 2*M) {
        const int m = n - begin < 2*M ? n - begin : (int)(2*M); const auto* c = coarse + (pairs ? begin/2 : begin);
        if (!pairs) { SIMD for (int k = 0; k < m; ++k) e[k] = scale*c[k]; }
        else {
            SIMD for (int k = 0; k < m / 2; ++k) { const T v = scale*c[k]; e[2*k] = v; e[2*k+1] = v; }
            if (m % 2) e[m-1] = scale*c[m/2]; }
        const auto* at = d + begin; T* to = x + begin; const T *lo = lower + begin, *hi = upper + begin;
        if (upper) SIMD for (int k = 0; k < m; ++k) { const T v = at[k] != 0 ? to[k] + e[k] : (T)0; to[k] = clipped(v, lo[k], hi[k]); }
        else SIMD for (int k = 0; k < m; ++k) { const T v = at[k] != 0 ? to[k] + e[k] : (T)0; to[k] = v < lo[k] ? lo[k] : v; } }
} else if (!pairs) {
    SIMD for (int k = 0; k < n; ++k) x[k] += d[k] != 0 ? scale*coarse[k] : (T)0;
} else {
    SIMD for (int k = 0; k < n / 2; ++k) {
        const T v = scale*coarse[k]; x[2*k] += d[2*k] != 0 ? v : (T)0; x[2*k+1] += d[2*k+1] != 0 ? v : (T)0; }
    if (n % 2) x[n-1] += d[n-1] != 0 ? scale*coarse[n/2] : (T)0;
}
