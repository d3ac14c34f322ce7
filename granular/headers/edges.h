// What edges read and change of the velocity.
#include "light.h"
const float* share[3] = FIELDS(share); T* u[3] = FIELDS(u);
auto rate = [&](int d, long long o) {
    const int a = ALPHA[d], b = BETA[d];
    return (u[a][o] - u[a][o - s[b]]) + (u[b][o] - u[b][o - s[a]]);
};
auto shear = [&](int d, long long o, T by) {  // what a change of an edge's stress does to the velocity
    const int a = ALPHA[d], b = BETA[d];
    u[a][o] -= (T)inverse[a][o]*by; u[a][o - s[b]] += (T)inverse[a][o - s[b]]*by;
    u[b][o] -= (T)inverse[b][o]*by; u[b][o - s[a]] += (T)inverse[b][o - s[a]]*by;
};
