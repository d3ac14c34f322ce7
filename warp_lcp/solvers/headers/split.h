// y = A x + b: the natural residual and its parts on held and free unknowns, the free set, g = -y / size on it, and the chopped step.
const auto reach = [&](T v) -> T { return slack*(v < 0 ? -v : v); };
T norm = 0, chopped = 0, reduced = 0, release = 0, energy = 0; int moved = 0, active = 0; unsigned char now[M];
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M; T y[M]; unsigned char any = 0, count = 0;
    fetch(begin, end, x + zp, b, g, step, d, unknown, free);
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    with_bounds([&](auto lower, auto upper) {
        SIMD8 for (int k = begin; k < end; ++k) {
            const T e = diagonal(k), f = e != 0 ? e : (T)1, l = lower(k), u = upper(k), v = y[k - begin];
            const bool in = unknown[k] == 1, held = in & ((x[k] <= l + reach(l)) | (x[k] >= u - reach(u)));
            const T r0 = natural_residual(v, f*(x[k] - l), f*(x[k] - u)), r = in ? r0 : (T)0, h = held ? r : (T)0;
            const S w = (S)(-h*inverse)/(S)f;  // division is what would take longest in double precision
            norm += r*r; chopped += h*h; reduced += held ? (T)0 : r*v; release -= (held ? v : (T)0)*inverse*(T)w;
            energy += in ? (T)0.5*x[k]*(v + b[k]) : (T)0;
            now[k - begin] = in & !held; g[k] = (S)((in & !held) ? -v*inverse : (T)0); step[k] = w; } });
    SIMD64 for (int k = begin; k < end; ++k) {
        const unsigned char one = now[k - begin] != free[k], two = (unknown[k] == 1) & !now[k - begin];
        any |= one; count += two; free[k] = now[k - begin]; }
    moved += any; active += count; }
