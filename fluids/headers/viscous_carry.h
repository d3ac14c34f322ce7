// Interpolation weights along an axis: of the two coarse places beside fine place n of a component.
#include "viscous_levels.h"
const auto places = [&](int other, int n, int size, int* to, float* weight) {
    if (other == 2 && planes == 1) { to[0] = to[1] = n; weight[0] = 1.0f; weight[1] = 0.0f; return; }
    const int odd = n & 1, half = (n + 1)/2;
    to[0] = other == axis ? n/2 + odd : half;
    to[1] = clamped(other == axis ? n/2 + 1 : (odd ? half - 1 : half + 1), size);
    weight[0] = other == axis ? (odd ? 1.0f : 0.5f) : 0.75f; weight[1] = 1.0f - weight[0];
};
const int mx = given.coarse.shape[2], my = given.coarse.shape[1], mz = given.coarse.shape[0];
int tz[2], ty[2], tx[2]; float wz[2], wy[2], wx[2];
places(2, k, mz, tz, wz); places(1, j, my, ty, wy);
