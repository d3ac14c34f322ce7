// Kernels of the natural residual, and of the checks of a problem before a solve.

// kernel residual.natural: Square of the natural residual r = d (x - clip(x - y/d, l, u)) = max(d
// (x - u), min(d (x - l), y)). The second form has no division, and a NaN of y stays NaN. The term
// 0 x gives NaN if x is not finite and its column of A is empty, so that y does not show it.
//   compute    float64
//   bounds
//   reads      float64 x, y; D d; int8 unknown
//   numbers    float64 unit
//   sums       square
double square = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double a = unit * (double)d[i], b = a < 0 ? -a : a, e = b == 0 ? 1.0 : b;
        const double r0 = natural_residual(y[i], e * (x[i] - lower(i)), e * (x[i] - upper(i))),
                     r = unknown[i] == 1 ? r0 + 0.0 * x[i] : 0.0;
        square += r * r;
    }
});

// kernel residual.unknown_square: Sum of the squares of a field over the unknowns
//   compute    float64
//   reads      float64 b; int8 unknown
//   sums       square
//   module     problem
double square = 0;
SIMD for (int i = 0; i < n; ++i) square += unknown[i] == 1 ? b[i] * b[i] : 0.0;

// kernel residual.within: clip(x, l, u), or clip(0, l, u), on the unknowns; 0 elsewhere
//   compute    float64
//   bounds
//   reads      int8 unknown
//   writes     float64 x
//   numbers    bool keep
//   module     problem
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double v = keep ? x[i] : 0.0, c = clipped(v, lower(i), upper(i));
        x[i] = unknown[i] == 1 ? c : 0.0;
    }
});

// kernel residual.settle_isolated: Unknowns whose row of A is empty, so that y = b: x is the bound
// that the sign of b determines
//   compute    float64
//   bounds
//   reads      D d; float64 b; int8 unknown
//   writes     float64 x
with_bounds([&](auto lower, auto upper) {
    for (int i = 0; i < n; ++i) {
        const double bound = b[i] < 0 ? upper(i) : lower(i);
        if (unknown[i] == 1 && d[i] == 0 && b[i] != 0 && bound > -1e300 && bound < 1e300)
            x[i] = bound;
    }
});

// kernel problem.check: Counts over the unknowns: values that are not finite, NaN among the bounds,
// crossed bounds, bounds that no x meets
//   compute    float64
//   bounds
//   reads      float64 b; int8 unknown
//   sums       bad, nan_lower, nan_upper, crossed, no_lower, no_upper
double bad = 0, nan_lower = 0, nan_upper = 0, crossed = 0, no_lower = 0, no_upper = 0;
const double inf = (double)INFINITY;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const double l = lower(k), u = upper(k), one = unknown[k] == 1 ? 1.0 : 0.0, v = b[k] - b[k];
        bad += v == 0 ? 0.0 : one;
        nan_lower += l == l ? 0.0 : one;
        nan_upper += u == u ? 0.0 : one;
        crossed += l > u ? one : 0.0;
        no_lower += l == inf ? one : 0.0;
        no_upper += u == -inf ? one : 0.0;
    }
});
