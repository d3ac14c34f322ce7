// Of the unknowns: values that are not finite, NaN among the bounds, crossed bounds, bounds that no x can meet
double bad = 0, nan_lower = 0, nan_upper = 0, crossed = 0, no_lower = 0, no_upper = 0; const double inf = (double)INFINITY;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const double l = lower(k), u = upper(k), one = unknown[k] == 1 ? 1.0 : 0.0, v = b[k] - b[k];
        bad += v == 0 ? 0.0 : one; nan_lower += l == l ? 0.0 : one; nan_upper += u == u ? 0.0 : one;
        crossed += l > u ? one : 0.0; no_lower += l == inf ? one : 0.0; no_upper += u == -inf ? one : 0.0; } });
