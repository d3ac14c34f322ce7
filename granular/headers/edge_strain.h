// Twice the shear rate of an edge, times dx.
#include "shape.h"
#include "span.h"
const T* u[3] = XYZ(u);
T* out[3] = XYZ(edge);
for (int d = 0; d < SHEARS; ++d) {
    const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
    const T* ua = u[ALPHA[d]]; const T* ub = u[BETA[d]]; T* rate = out[d];
    MASKED for (int i = begin; i < end; ++i) rate[i] = (ua[i] - ua[i - sb]) + (ub[i] - ub[i - sa]);
}
