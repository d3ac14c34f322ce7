// Add the coarse correction, or (NORM) find the reciprocal of what the interpolation makes of 1 where there is something, 0 elsewhere.
#include "viscous_levels.h"
const int mx = given.coarse.shape[2], my = given.coarse.shape[1], mz = given.coarse.shape[0];
const int* reach = span + 4*(k*(int)(s1/s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
if (NORM) for (int i = first; i < last; ++i) norm[i] = 0.0f;
int z[2], y[2]; float wz[2], wy[2];
const auto places = [&](int other, int n, int size, int* to, float* weight) {  // the two coarse places beside place n along an axis
    const int odd = n & 1, half = (n + 1)/2;
    to[0] = other == axis ? n/2 + odd : half;
    to[1] = clamped(other == axis ? n/2 + 1 : (odd ? half - 1 : half + 1), size);
    weight[0] = other == axis ? (odd ? 1.0f : 0.5f) : 0.75f; weight[1] = 1.0f - weight[0];
    if (other == 2 && planes == 1) { to[0] = to[1] = n; weight[0] = 1.0f; weight[1] = 0.0f; }
};
places(2, k - shift[2], mz, z, wz); places(1, j - shift[1], my, y, wy);
const float* row[4]; float weight[4];
for (int n = 0; n < 4; ++n) { row[n] = coarse + ((long long)z[n >> 1]*my + y[n & 1])*mx; weight[n] = wz[n >> 1]*wy[n & 1]; }
float line[M/2 + 3];
for (int start = low; start < high; start += M) {
    const int end = start + M < high ? start + M : high, half = (start - shift[0])/2, base = half > 0 ? half - 1 : 0;
    const int most = clamped((end - shift[0])/2 + 2, mx) - base, count = most < (int)M/2 + 3 ? most + 1 : (int)M/2 + 3;
    SIMD for (int n = 0; n < count; ++n) {
        line[n] = weight[0]*row[0][base + n] + weight[1]*row[1][base + n] + weight[2]*row[2][base + n] + weight[3]*row[3][base + n];
    }
    for (int i = start; i < end; ++i) {
        const int odd = (i - shift[0]) & 1, n = (i - shift[0] + 1)/2 - base;
        const float value = axis == 0 ? (odd ? line[n] : 0.5f*(line[n] + line[n + 1])) : 0.75f*line[n] + 0.25f*line[odd ? n - 1 : n + 1];
        if (NORM) norm[i] = diagonal[i] > 0.0f && value > 0.0f ? 1.0f/value : 0.0f;
        else x[NORM ? 0 : i] += norm[i]*value;
    }
}
