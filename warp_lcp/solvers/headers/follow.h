// x moved with bounds that have moved: what was at one stays at it, the rest is projected.
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const T l = lower(k), u = upper(k), was_l = old_lower[k], was_u = old_upper[k], v = x[k], c = clipped(v, l, u);
        const T low = ((was_l != l) & (v <= was_l)) ? l : c; x[k] = ((was_u != u) & (v >= was_u)) ? u : low; } });
