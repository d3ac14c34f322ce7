// Gauss-Seidel over the rows of one color, or over what lies before and behind their cores: no two of them meet in the component. Even cells
// of a row go first, or odd ones; what other rows and components add is found before, for all of a row together.
#include "viscous_stencil.h"
const auto relax = [&](const int low, const int high) {
#ifdef __CUDA_ARCH__
    for (int i = low + ((low + only) & 1); i < high; i += 2) x[i] = diagonal[i] > 0 ? (b[i] + around(i))/diagonal[i] : 0;
#else
    if (axis == 0) { SIMD for (int i = low; i < high; ++i) scratch[i] = b[i] + pair(xb, sb, i) + others(i); }
    else { SIMD for (int i = low; i < high; ++i) scratch[i] = b[i] + along(i) + others(i); }
    for (int half = 0; half < 2; ++half) {
        const int start = low + ((low + (half ^ order)) & 1);
        if (axis == 0) {
            SIMD for (int i = start; i < high; i += 2) {
                const T by = diagonal[i];
                x[i] = by > 0 ? (scratch[i] + cell[i]*x[i + 1] + cell[i - 1]*x[i - 1])/by : 0;
            }
        } else {
            SIMD for (int i = start; i < high; i += 2) {
                const T by = diagonal[i];
                x[i] = by > 0 ? (scratch[i] + xb[i + 1]*x[i + 1] + xb[i]*x[i - 1])/by : 0;
            }
        }
    }
#endif
};
if (((j + k) & 1) == color) {
    relax(low, band && reach[2] < high ? reach[2] : high);
    if (band) relax(reach[3] > low ? reach[3] : low, high);
}
