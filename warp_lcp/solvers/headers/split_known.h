// What `split.h` finds, where y is known; the chopped step is not rounded before it is summed.
const auto reach = [&](T v) -> T { return slack*(v < 0 ? -v : v); };
T norm = 0, chopped = 0, reduced = 0, release = 0, moved = 0, active = 0, energy = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = diagonal(k), f = a < 0 ? -a : a, e = f == 0 ? (T)1 : f, v = known[k], l = lower(k), u = upper(k);
        const bool in = unknown[k] == 1, held = in & ((x[k] <= l + reach(l)) | (x[k] >= u - reach(u)));
        const T r0 = natural_residual(v, e*(x[k] - l), e*(x[k] - u)), r = in ? r0 + (T)0*x[k] : (T)0, h = held ? r : (T)0;
        const unsigned char now = in & !held;
        norm += r*r; chopped += h*h; reduced += held ? (T)0 : r*v; release += (held ? v : (T)0)*h/e*inverse*inverse;
        moved += now != free[k] ? (T)1 : (T)0; active += held ? (T)1 : (T)0;
        free[k] = now; g[k] = now ? (S)(-v*inverse) : (S)0; step[k] = (S)(-h/e*inverse); } });
SIMD for (int k = 0; k < n; ++k) energy += unknown[k] == 1 ? (T)0.5*x[k]*(known[k] + b[k]) : (T)0;
