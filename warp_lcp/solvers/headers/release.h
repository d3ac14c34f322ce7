// x moved along the chopped step, onto the bounds; what moves is free. The right-hand side g loses `part` q and gains rows: e step = -y / size.
const S share = (S)part;
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const T a = diagonal(k), e = a == 0 ? (T)1 : a, v = x[k] + length*(T)step[k], c = clipped(v, lower(k), upper(k));
        const S s = step[k], own = (S)(e*(T)s), before = s != 0 ? own : g[k]; const bool now = (s != 0) | (free[k] != 0);
        to[k] = ((s != 0) & (v - v == 0)) ? c : x[k]; g[k] = now ? before - share*q[k] : (S)0; } });
SIMD64 for (int k = 0; k < n; ++k) free[k] = free[k] | (unsigned char)(step[k] != 0);
