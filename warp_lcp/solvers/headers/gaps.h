// Bounds of a correction in units of SIZE; finite, and 0 off the unknowns.
const T inverse = reciprocal(scalars[SIZE]), big = 1e30;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = (lower(k) - x[k])*inverse, l = a < -big ? -big : (a > 0 ? (T)0 : a); lo[k] = unknown[k] == 1 ? l : (T)0; }
    if (hi) SIMD for (int k = 0; k < n; ++k) {
        const T c = (upper(k) - x[k])*inverse, u = c > big ? big : (c < 0 ? (T)0 : c); hi[k] = unknown[k] == 1 ? u : (T)0; } });
