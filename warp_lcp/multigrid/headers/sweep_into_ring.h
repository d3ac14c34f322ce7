// As sweep.h, of a ring of planes: what the plane that was here before had may be wider, where rows beside this one look.
if (L.spans.data) {
    int from = P.first, to = P.first + n;
    const auto look = [&](int k, int j) {
        const auto span = L.spans.data[(k + L.planes) % L.planes*L.rows + (j + L.rows) % L.rows];
        if (span[1] > span[0]) { from = span[0] < from ? span[0] : from; to = span[1] > to ? span[1] : to; } };
    look(P.k - 1, P.j); look(P.k + 1, P.j); look(P.k, P.j - 1); look(P.k, P.j + 1);
    for (int k = (from > 0 ? from - 1 : 0) - P.first; k < 0; ++k) y[k] = 0;
    for (int k = n; k < (to < L.nx ? to + 1 : L.nx) - P.first; ++k) y[k] = 0; }
#include "sweep.h"
