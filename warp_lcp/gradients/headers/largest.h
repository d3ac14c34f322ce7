// The square and the largest magnitude of the natural residual, see `problem/headers/natural.h`.
T square = 0, most = 0;
with_bounds([&](auto lower, auto upper) {
    for (int k = 0; k < n; ++k) {  // a largest one is not vectorized
        const T a = unit*(T)d[k], b = a < 0 ? -a : a, e = b == 0 ? (T)1 : b;
        const T r0 = natural_residual(y[k], e*(x[k] - lower(k)), e*(x[k] - upper(k))), r = unknown[k] == 1 ? r0 : (T)0;
        const T size = r < 0 ? -r : r; square += r*r; most = most < size ? size : most; } });
