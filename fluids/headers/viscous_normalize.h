// The reciprocal sum of the weights by which a face interpolates from coarse faces that are unknowns, or are held at 0 by a wall.
#include "viscous_carry.h"
for (int i = first; i < last; ++i) {
    float sum = 0.0f;
    places(0, i, mx, tx, wx);
    for (int c = 0; c < 2; ++c) for (int b = 0; b < 2; ++b) for (int a = 0; a < 2; ++a) {
        const long long at = ((long long)tz[c]*my + ty[b])*mx + tx[a];
        sum += wz[c]*wy[b]*wx[a]*(coarse[at] > 0.0f ? 1.0f : (h[at] > 0.0f ? h[at] : 0.0f));
    }
    norm[i] = diagonal[i] > 0.0f && sum > 0.0f ? 1.0f/sum : 0.0f;
}
