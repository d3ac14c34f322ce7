// As sweep.h, of a ring of planes: what the plane that was here before had may be wider.
if (L.spans.data) {
    for (int k = -P.first; k < 0; ++k) y[k] = 0;
    for (int k = n; k < L.nx - P.first; ++k) y[k] = 0; }
#include "sweep.h"
