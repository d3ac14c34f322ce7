// x moved at least width / d inside its bounds, w and v its distances to them, and which unknowns move.
const double none = (double)INFINITY;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double e = unit*(double)d[i], least_d = e < 0 ? -e : e, size = least_d == 0 ? 1.0 : least_d, l = lower(i), u = upper(i);
        const bool moves = (unknown[i] == 1) & (l < u), low = moves & (l > -none), high = moves & (u < none);
        const double span = u - l, below = x[i] - l, least = width/size, c = below < least ? least : below, k0 = c < 0.5*span ? c : 0.5*span;
        free[i] = moves;
        if constexpr (UPPER) {
            const double above = u - x[i], o = above < least ? least : above, g0 = o < 0.5*span ? o : 0.5*span;
            const bool near = below <= above; const double g = (low & near) ? span - k0 : g0, k = (high & !near) ? span - g0 : k0;
            w[i] = low ? k : none; v[i] = high ? g : none; x[i] = low ? l + k : (high ? u - g : x[i]);
        } else { w[i] = low ? k0 : none; x[i] = low ? l + k0 : x[i]; } } });
