// Where the last step began, as far as no bound has cut it.
const T step = scalars[STEP];
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T v = x[k] - step*(T)q[k], c = clipped(v, lower(k), upper(k));
        before[k] = ((unknown[k] == 1) & (q[k] != 0) & (v - v == 0)) ? c : x[k]; } });
