// The diagonal of a component's rows, 0 where there is no unknown; what walls add to it; and for faces in a wall whether it holds, else -1.
#include "viscous_walls.h"
const int nx = given.d.shape[2] - 2, ny = given.d.shape[1] - 2, nz = given.d.shape[0] - 2;
for (int i = first; i < last; ++i) {
    const int at = axis == 0 ? i : (axis == 1 ? j : k);
    diagonal[i] = drag[i] = 0.0f;
    held[i] = -1.0f;
    if (solid(d, i)) {  // head on where a cell beside it is liquid
        const bool here = kind[i] == FLUID, below = kind[i - sa] == FLUID;
        const bool holds = (here && contact[i] != RELEASED) || (below && contact[i - sa] != RELEASED) || (!here && !below && h[i] < INFINITY);
        held[i] = holds ? 1.0f : 0.0f;
    }
    if (at == 1 || solid(d, i) || i > nx || j > ny || (deep && k > nz)) continue;
    float free = volume[i], wall = 0.0f;
    const auto link = [&](long long q, long long c) { if (solid(d, q)) wall += head_on(i, q, c); else free += cell[c]; };
    const auto side = [&](long long q, float weight) { if (solid(d, q)) wall += beside(i, q, weight); else free += weight; };
    link(i + sa, i); link(i - sa, i - sa);
    side(i + sb, xb[i + sb]); side(i - sb, xb[i]);
    if (deep) { side(i + sc, xc[i + sc]); side(i - sc, xc[i]); }
    drag[i] = wall;
    diagonal[i] = free + wall;
}
