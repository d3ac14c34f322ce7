// Project the open faces that touch FLUID and mark them 1; other faces become 0, or -1 inside solids of whole cells.
#include "pressure_face.h"
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
const int edge = (axis == 1 && j == 0) || (axis == 2 && k == 0) ? last : (axis == 0 && first == 0 ? 1 : first);
for (int i = first; i < edge; ++i) known[i] = -1;  // the ring's own lower faces lie in the wall
SIMD8 for (int i = edge; i < last; ++i) {
    const int here = kind[i], below = kind[i - s], wet = (here == FLUID) | (below == FLUID);
    const float open = fraction(axis, i, s);
    const float inverse = !GHOST ? 1.0f : (here == AIR ? inverse_theta(i - s, i) : (below == AIR ? inverse_theta(i, i - s) : 1.0f));
    const int projected = wet & (open > 0.0f) & (here != SOLID) & (below != SOLID);  // a source's cells are SOLID, their faces open
    field[i] -= projected ? (float)(x[i] - x[i - s])*inverse : 0.0f;
    const int hidden = CUT ? 0 : (here == SOLID) & (below == SOLID);
    known[i] = projected ? 1 : (hidden ? -1 : 0);
}
