// Find the released cells, their number, and the largest |outflow| of the other FLUID cells [m/s], `worst`.
#include "pressure_face.h"
if (planes != 2) w = u;
int found = 0; double rest[M]; unsigned char leaves[M];
for (int from = first; from < last; from += M) {
    const int n = last - from < M ? last - from : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = from + m, fluid = kind[i] == FLUID;
        const double y = outflow(u, v, w, i), size = y < 0.0 ? -y : y;
        const int leaving = BOUNDED & fluid & ((touch[i] & LETS_GO) != 0) & (x[i] <= 0.0) & (y > threshold);
        contact[i] = leaving ? RELEASED : ((fluid & (touch[i] & TOUCHES)) ? HELD : 0);
        leaves[m] = leaving;
        rest[m] = (fluid & !leaving) ? size : 0.0;
    }
    for (int m = 0; m < n; ++m) { found += leaves[m]; worst = rest[m] > worst ? rest[m] : worst; }
}
released = found;
