// Free unknowns: those that are off their bounds by more than the tolerance and what rounding leaves. `cells`, a copy of `unknown`, is 0
// where one is held, by the `side` 1, lower, or 2, upper: the nearer bound, of two that are one that which y's sign names. Degenerate: held,
// though y is 0 as far as can be told, and not by two bounds that are one.
T free = 0, degenerate = 0, wrong = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = unit*(T)d[k], f = a < 0 ? -a : a, e = f == 0 ? (T)1 : f, moved = e*x[k], below = x[k] - lower(k), above = upper(k) - x[k];
        const T t = tolerance + rounding*((moved < 0 ? -moved : moved)*2 + (b[k] < 0 ? -b[k] : b[k])), size = y[k] < 0 ? -y[k] : y[k];
        const bool inside = unknown[k] == 1, held = inside & ((e*below <= t) | (e*above <= t)), now = inside & !held;
        const bool low = (below < above) | ((below == above) & (y[k] >= 0));
        free += now ? (T)1 : (T)0; degenerate += (held & (size <= t) & (lower(k) < upper(k))) ? (T)1 : (T)0;
        wrong += (inside & !(g[k] - g[k] == 0)) ? (T)1 : (T)0;
        side[k] = held ? (low ? (signed char)1 : (signed char)2) : (signed char)0; cells[k] = held ? (signed char)0 : unknown[k]; } });
