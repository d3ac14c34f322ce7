// The reciprocal of the longest step that keeps w, v, s and t positive, and the sum of dw ds + dv dt.
#include "path_direction.h"
long long most = 0; double products = 0;
const auto note = [&](double m) {  // bits of numbers above 0 are ordered as these are; compilers vectorize only this
    const double positive = m > 0 ? m : 0.0; const long long bits = __builtin_bit_cast(long long, positive);
    most = bits > most ? bits : most; };
fetch(0, n, w, s, e);
if constexpr (UPPER) fetch(0, n, v, t);
if (FUSED && second == 0) {  // the predictor: ds = -s (1 + dx / w), dt = -t (1 - dx / v)
    EACH_CELL(
        const double dx = scale*(double)e[i], q = dx/w[i], next = s[i] > 0 ? 1 + q : 0.0, m = -q > next ? -q : next;
        if constexpr (UPPER) {
            const double o = dx/v[i], last = t[i] > 0 ? 1 - o : 0.0, k = o > last ? o : last;
            note(m > k ? m : k); products += dx*(t[i]*(1 - o) - s[i]*(1 + q));
        } else { note(m); products += dx*(-s[i]*(1 + q)); })
} else if constexpr (UPPER) {
    EACH_CELL(
        LOWER_DIRECTION UPPER_DIRECTION
        const double first = -dx*iw, next = s[i] > 0 ? -ds/s[i] : 0.0, m = first > next ? first : next;
        const double third = dx*iv, last = t[i] > 0 ? -dt/t[i] : 0.0, k = third > last ? third : last;
        note(m > k ? m : k); products += dx*ds - dx*dt;)
} else {
    EACH_CELL(
        LOWER_DIRECTION
        const double first = -dx*iw, next = s[i] > 0 ? -ds/s[i] : 0.0, m = first > next ? first : next;
        note(m); products += dx*ds;) }
make_at_least(longest, __builtin_bit_cast(double, most));
