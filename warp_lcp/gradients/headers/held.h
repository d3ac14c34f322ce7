// z = g + A'mu on the unknowns that are held, in its own place for lower and in that of y for upper bounds, else 0. The nearer bound holds; of
// two that are one, that which y's sign names.
T of_lower = 0, of_upper = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T below = x[k] - lower(k), above = upper(k) - x[k]; const bool low = (below < above) | ((below == above) & (y[k] >= 0));
        const T v = ((unknown[k] == 1) & (cells[k] == 0)) ? z[k] : (T)0, at_l = low ? v : (T)0, at_u = low ? (T)0 : v;
        of_lower += at_l; of_upper += at_u; z[k] = at_l; y[k] = at_u; } });
