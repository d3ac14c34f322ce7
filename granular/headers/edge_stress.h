// The shear of an edge: the mean of its copies.
#include "shape.h"
#include "span.h"
const float* share[3] = XYZ(share);
T* out[3] = XYZ(edge);
for (int d = 0; d < SHEARS; ++d) {
    const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
    const float* c0 = y + (FIRST + 4*d)*layer; const float* c1 = c0 + layer - sa;
    const float* c2 = c0 + 2*layer - sb; const float* c3 = c0 + 3*layer - sa - sb;
    const float* weight = share[d]; T* b = out[d];
    MASKED for (int i = begin; i < end; ++i) {
        const T w = weight[i] < 0.0f ? -weight[i] : weight[i];
        b[i] = w*(((T)c0[i] + (T)c1[i]) + ((T)c2[i] + (T)c3[i]));
    }
}
