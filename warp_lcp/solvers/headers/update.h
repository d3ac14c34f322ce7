// The direction q = z + beta q, and x moved along it, onto the bounds.
const S beta = (S)scalars[BETA]; const T step = scalars[STEP], inverse = step != 0 ? reciprocal(step) : 0;
const bool fresh = beta == 0;  // then q may hold anything, a NaN too
fetch(0, n, x, z, q);
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const auto s = (fresh | (z[k] == 0)) ? z[k] : z[k] + beta*q[k];  // held unknowns leave the direction
        const T v = x[k] + step*(T)s, c = clipped(v, lower(k), upper(k));
        const bool moves = (s != 0) & (v - v == 0), cut = moves & (c != v);  // a NaN or infinite step leaves x as it was
        const T left = (c - x[k])*inverse;
        q[k] = cut ? left : (T)s; x[k] = moves ? c : x[k]; } });
