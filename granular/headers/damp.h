// A part of the pattern that alternates in all directions, found in `source`, is taken from `now`, which holds the same.
#include "shape.h"
const float* share[3] = XYZ(share);
for (int i = first; i < last; ++i) {
    if (!(flags[i] & SHEARS_HERE) || flags[i] & PARTLY) continue;
    bool deep = true; float pattern = 0.0f;
    for (int c = DIM == 3 ? -1 : 0; c <= (DIM == 3 ? 1 : 0); ++c) for (int b = -1; b <= 1; ++b) for (int a = -1; a <= 1; ++a) {
        const long long o = i + a + b*s[1] + c*s[2];
        deep = deep && (flags[o] & SHEARS_HERE);
        const float weight = (a ? -0.25f : 0.5f)*(b ? -0.25f : 0.5f)*(DIM == 2 ? 1.0f : c ? -0.25f : 0.5f);
        pattern += weight*source[o];
    }
    for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q)
        deep = deep && share[d][i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]]] > 0.0f;
    const float by = (float)DAMPED*pattern;
    if (!deep || source[i] < by) continue;
    now[i] = source[i] - by;
    for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q)
        now[(FIRST + 4*d + q)*layer + i] += (DIM == 3 ? 0.5f : 1.0f)*((q == 0 || q == 3) ? by : -by);
}
