// The square of r = d (x - clip(x - y/d, l, u)) = max(d (x - u), min(d (x - l), y)): no division, and a NaN in y stays one;
// 0 x makes NaN of an x that is not finite where its column of A is empty, so that y says nothing of it.
double square = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double a = unit*(double)d[i], b = a < 0 ? -a : a, e = b == 0 ? 1.0 : b;
        const double r0 = natural_residual(y[i], e*(x[i] - lower(i)), e*(x[i] - upper(i))), r = unknown[i] == 1 ? r0 + 0.0*x[i] : 0.0;
        square += r*r; } });
