// A x, or the residual b - A x.
#include "viscous_stencil.h"
SIMD for (int i = low; i < high; ++i) {
    const T v = diagonal[i]*x[i] - around(i);
    out[i] = diagonal[i] > 0 ? (RESIDUAL ? right[RESIDUAL ? i : 0] - v : v) : 0;
}
