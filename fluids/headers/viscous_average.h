// The mean over the finer level, times `scale`: of two cells an axis, or of three faces where bit n of `faces` is set for axis n.
#include "viscous_levels.h"
const int mx = given.fine.shape[2], my = given.fine.shape[1], mz = given.fine.shape[0];
const auto part = [&](int axis, int n, int c, int size, float& weight) {
    if (axis == 2 && planes == 1) { weight = c == 0 ? 1.0f : 0.0f; return n; }
    const bool face = faces >> axis & 1;
    weight = face ? (c == 1 ? 0.5f : 0.25f) : (c < 2 ? 0.5f : 0.0f);
    return clamped(2*n - 1 - (int)face + c + shift[axis], size);
};
for (int i = first; i < last; ++i) {
    float sum = 0.0f, wz, wy, wx;
    for (int c = 0; c < 3; ++c) for (int b = 0; b < 3; ++b) for (int a = 0; a < 3; ++a) {
        const long long z = part(2, k, c, mz, wz), y = part(1, j, b, my, wy), x = part(0, i, a, mx, wx);
        sum += wz*wy*wx*fine[(z*my + y)*mx + x];
    }
    out[i] = scale*sum;
}
