// Add the coarse correction.
#include "viscous_carry.h"
const int* reach = span + 2*(k*(int)(s1/s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
const float* rows[4]; float weight[4]; int count = 0;
for (int c = 0; c < 2; ++c) for (int b = 0; b < 2; ++b) if (wz[c]*wy[b] > 0.0f) {
    rows[count] = coarse + ((long long)tz[c]*my + ty[b])*mx; weight[count++] = wz[c]*wy[b];
}
for (int i = low; i < high; ++i) {
    if (!(norm[i] > 0.0f)) continue;
    places(0, i, mx, tx, wx);
    float sum = 0.0f;
    for (int r = 0; r < count; ++r) sum += weight[r]*(wx[0]*rows[r][tx[0]] + wx[1]*rows[r][tx[1]]);
    x[i] += norm[i]*sum;
}
