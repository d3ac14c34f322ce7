// x, w, v, s and t moved along the direction; the sum of w s and v t there.
#include "path_direction.h"
double total = 0;
fetch(0, n, w, s, x, e, a);
if constexpr (UPPER) fetch(0, n, v, t);
with_bounds([&](auto lower, auto upper) {
    if constexpr (UPPER) { EACH_CELL(
        LOWER_DIRECTION UPPER_DIRECTION
        const double wn = w[i] + length*dx, sn = s[i] + length*ds, vn = v[i] - length*dx, tn = t[i] + length*dt;
        const double below = lower(i) + wn, free = x[i] + length*dx, above = upper(i) - vn;
        x[i] = vn < wn ? above : (wn < (double)INFINITY ? below : free);
        total += (sn > 0 ? wn*sn : 0.0) + (tn > 0 ? vn*tn : 0.0); w[i] = wn; s[i] = sn; v[i] = vn; t[i] = tn;) }
    else { EACH_CELL(
        LOWER_DIRECTION
        const double wn = w[i] + length*dx, sn = s[i] + length*ds, below = lower(i) + wn, free = x[i] + length*dx;
        x[i] = wn < (double)INFINITY ? below : free; total += sn > 0 ? wn*sn : 0.0; w[i] = wn; s[i] = sn;) } });
