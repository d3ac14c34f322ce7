// clip(x, l, u), or clip(0, l, u), on the unknowns; 0 elsewhere.
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double v = keep ? x[i] : 0.0, c = clipped(v, lower(i), upper(i)); x[i] = unknown[i] == 1 ? c : 0.0; } });
