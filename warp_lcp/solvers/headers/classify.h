// The free set of the minimum map: unknowns with x - y / d within the bounds. The others go onto them; g = -scale y on the free set.
T moved = 0, active = 0, shifted = 0, square = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = diagonal(k), f = a < 0 ? -a : a, e = f == 0 ? (T)1 : f, v = x[k] - known[k]/e, l = lower(k), u = upper(k);
        const bool low = v < l, high = v > u, inside = unknown[k] == 1, held = inside & (low | high);
        const unsigned char now = inside & !held; const T at = held ? (low ? l : u) : x[k], y = now ? known[k] : (T)0;
        shifted += at != x[k] ? (T)1 : (T)0; x[k] = at; g[k] = (S)(-y*scale); square += y*y;
        moved += now != free[k] ? (T)1 : (T)0; active += held ? (T)1 : (T)0; free[k] = now; } });
