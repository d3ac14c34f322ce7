// Kernels of a problem: the natural residual, checks before a solve, bounds that are stored as a
// code per cell.

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

// kernel bounds.encode: Bits of finite bounds. Count: finite bounds that differ from the given
// number, or are NaN
//   compute    float64
//   reads      float64 lower?, upper?
//   writes     uint8 code
//   numbers    float64 least, most
//   sums       others
const double inf = (double)INFINITY;
const unsigned char below = least > -inf, above = most < inf ? 2 : 0;
double others = 0;
if (lower && upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const bool a = lower[k] == least, b = upper[k] == most;
        others += ((a | (lower[k] == -inf)) & (b | (upper[k] == inf))) ? 0.0 : 1.0;
        code[k] = (a ? 1 : 0) | (b ? 2 : 0);
    }
} else if (lower) {
    SIMD for (int k = 0; k < n; ++k) {
        const bool a = lower[k] == least;
        others += (a | (lower[k] == -inf)) ? 0.0 : 1.0;
        code[k] = (a ? 1 : 0) | above;
    }
} else {
    SIMD for (int k = 0; k < n; ++k) {
        const bool b = upper[k] == most;
        others += (b | (upper[k] == inf)) ? 0.0 : 1.0;
        code[k] = below | (b ? 2 : 0);
    }
}

// kernel bounds.code_rows: Bits of one side, whose field has no ghost cells. Count: finite values
// that differ from the number
//   compute    float64
//   writes     uint8 code
//   whole      float64 source
//   numbers    float64 value, infinite; int bit
//   sums       others
const double* v = source + (long long)P.row * L.nx + P.first;
double others = 0;
SIMD for (int k = 0; k < n; ++k) {
    const bool a = v[k] == value, none = v[k] == infinite;
    others += (a | none) ? 0.0 : 1.0;
    code[k] += (a & !none) ? bit : 0;
}

// kernel bounds.decode: Field of bounds from a code
//   compute    float64
//   reads      uint8 code
//   writes     float64 field
//   numbers    float64 value, infinite; int bit
SIMD for (int k = 0; k < n; ++k) field[k] = code[k] & bit ? value : infinite;
