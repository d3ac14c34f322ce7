// What of the last stresses has a place now: pressure where there is sand, shear where a cell carries it, copies where they have a share.
#include "shape.h"
const float* share[3] = XYZ(share);
auto put = [&](long long at, float value) { now[at] = value; before[at] = value; point[at] = value; };
for (int i = first; i < last; ++i) {
    const int sand = flags[i] & HOLDS, sheared = (flags[i] & SHEARS_HERE) && stiff[i] > 0.0f;
    put(i, sand ? now[i]*ratio : 0.0f);
    for (int c = 0; c < NORMALS; ++c) put((1 + c)*layer + i, sheared ? now[(1 + c)*layer + i]*ratio : 0.0f);
    for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q) {
        const float weight = share[d][i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]]];
        const long long at = (FIRST + 4*d + q)*layer + i;
        put(at, (weight > 0.0f && sheared) || (weight < 0.0f && sand) ? now[at]*ratio : 0.0f);
    }
    if (CUT) for (int c = FIRST + 4*SHEARS; c < FIRST + 4*SHEARS + DIM; ++c) put(c*layer + i, sand ? now[c*layer + i]*ratio : 0.0f);
}
