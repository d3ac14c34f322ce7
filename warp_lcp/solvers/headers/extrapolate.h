// x and y extrapolated to z and y_z, and the projected gradient step from there.
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = x[k] + beta*(x[k] - x_old[k]), s = y[k] + beta*(y[k] - y_old[k]);
        const T c = clipped(a - s/(lipschitz*d[k]), lower(k), upper(k));
        x_old[k] = x[k]; y_old[k] = y[k]; z[k] = a; y_z[k] = s; x[k] = unknown[k] == 1 ? c : x[k]; } });
