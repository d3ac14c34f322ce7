// x = base + scale e, onto the bounds if projected.
if (projected) with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double v = base[i] + scale*(double)e[i], c = clipped(v, lower(i), upper(i)); x[i] = unknown[i] == 1 ? c : 0.0; } });
else SIMD for (int i = 0; i < n; ++i) x[i] = base[i] + scale*(double)e[i];
