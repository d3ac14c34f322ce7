#include "joined.h"
// Mark the roots of what AIR or a shift holds
if (uniform && !shift) {
    const unsigned char ax = cx > 0, ay = cy > 0, az = cz > 0; unsigned char hit[M];
    for (int begin = 0; begin < n; begin += M) {
        const int m = n - begin < M ? n - begin : (int)M; const signed char* e = c + begin; unsigned char any = 0;
        SIMD for (int k = 0; k < m; ++k) {
            const unsigned char h = (ax & ((e[k-1] == 0) | (e[k+1] == 0))) | (ay & ((e[k-s2] == 0) | (e[k+s2] == 0)))
                | (az & ((e[k-s1] == 0) | (e[k+s1] == 0)));
            hit[k] = e[k] == 1 ? h : (unsigned char)0; any |= hit[k]; }
        for (int k = 0; any && k < m; ++k) if (hit[k]) grounded[find((int)(p + begin + k))] = 1; }
    continue; }
for (int k = 0; k < n; ++k) {
    if (c[k] != 1) continue;
    bool hit = (c[k-1] == 0 && x(k)) || (c[k+1] == 0 && x(k+1)) || (c[k-s2] == 0 && y(k)) || (c[k+s2] == 0 && y(k+s2))
        || (c[k-s1] == 0 && z(k)) || (c[k+s1] == 0 && z(k+s1));
    if (shift) hit = hit || shift[k] > 0;
    if (hit) grounded[find((int)(p + k))] = 1; }
