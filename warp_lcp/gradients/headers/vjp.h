// Kernels of vector-Jacobian products of a solution.

// kernel gradients.largest: Square and largest magnitude of the natural residual, see
// `residual.natural`
//   compute    float64
//   bounds
//   reads      float64 x, y; D d; int8 unknown
//   numbers    float64 unit
//   sums       square
//   largest    most
T square = 0, most = 0;
with_bounds([&](auto lower, auto upper) {
    for (int k = 0; k < n; ++k) {  // compilers do not vectorize the maximum
        const T a = unit * (T)d[k], b = a < 0 ? -a : a, e = b == 0 ? (T)1 : b;
        const T r0 = natural_residual(y[k], e * (x[k] - lower(k)), e * (x[k] - upper(k))),
                r = unknown[k] == 1 ? r0 : (T)0;
        const T size = r < 0 ? -r : r;
        square += r * r;
        most = most < size ? size : most;
    }
});

// kernel gradients.sets: Classify the unknowns. Free: farther from both bounds than the tolerance
// and the rounding error. Held: not free; `cells`, a copy of `unknown`, is 0 there, and `side` is 1
// (lower) or 2 (upper), the nearer bound. If both bounds are equal, the sign of y decides.
// Degenerate: held with |y| within the tolerance, and the bounds differ. Wrong: g is not finite.
//   compute    float64
//   bounds
//   reads      float64 x, y; D d; int8 unknown; float64 b, g
//   writes     int8 cells, side
//   numbers    float64 unit, tolerance, rounding
//   sums       free, degenerate, wrong
T free = 0, degenerate = 0, wrong = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = unit * (T)d[k], f = a < 0 ? -a : a, e = f == 0 ? (T)1 : f, moved = e * x[k],
                below = x[k] - lower(k), above = upper(k) - x[k];
        const T t = tolerance +
                    rounding * ((moved < 0 ? -moved : moved) * 2 + (b[k] < 0 ? -b[k] : b[k])),
                size = y[k] < 0 ? -y[k] : y[k];
        const bool inside = unknown[k] == 1, held = inside & ((e * below <= t) | (e * above <= t)),
                   now = inside & !held;
        const bool low = (below < above) | ((below == above) & (y[k] >= 0));
        free += now ? (T)1 : (T)0;
        degenerate += (held & (size <= t) & (lower(k) < upper(k))) ? (T)1 : (T)0;
        wrong += (inside & !(g[k] - g[k] == 0)) ? (T)1 : (T)0;
        side[k] = held ? (low ? (signed char)1 : (signed char)2) : (signed char)0;
        cells[k] = held ? (signed char)0 : unknown[k];
    }
});

// kernel gradients.held: Split z by bounds: it stays where the lower bound holds an unknown, moves
// to `upper` where the upper bound does, and is 0 elsewhere. The sums of both parts
//   compute    float64
//   reads      int8 side
//   writes     float64 z, upper?
//   sums       of_lower, of_upper
T of_lower = 0, of_upper = 0;
SIMD for (int k = 0; k < n; ++k) {
    const T at_l = side[k] == 1 ? z[k] : (T)0, at_u = side[k] == 2 ? z[k] : (T)0;
    of_lower += at_l;
    of_upper += at_u;
    if (upper) upper[k] = at_u;
    z[k] = at_l;
}
