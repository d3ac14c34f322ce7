// Gauss-Seidel over the rows of one color: no two of them meet in the component. Even cells of a row go first, or odd ones.
#include "viscous_stencil.h"
if (((j + k) & 1) == color) for (int half = 0; half < 2; ++half) {
    const int parity = half ^ order;
    if (only >= 0 && only != parity) continue;
    SIMD for (int i = low + ((low + parity) & 1); i < high; i += 2) {
        const T by = diagonal[i];
        x[i] = by > 0 ? (b[i] + around(i))/by : 0;
    }
}
