// y = a sweep of what x is with `scale` times the correction of its aggregate, which is added wherever the sweep looks.
#include "relax.h"
const auto aggregate = [&](int i, int j, int k) { return over(k, L.fz)*L.o1 + over(j, L.fy)*L.o2 + over(i, L.fx); };
const auto corrected = [&](int k, int rows, int planes) -> T {
    const long long i = k + beside(rows, planes, zm, zp);
    const long long c = aggregate(P.first + k, P.j + rows, P.k + planes) - aggregate(P.first, P.j, P.k);
    return x[i] + (d[i] != 0 ? scale*coarse[c] : (T)0); };
for (int k = 0; k < n; ++k) {
    const T e = diagonal(k), v = relaxed(corrected(k, 0, 0), around_of(corrected, k), omega, k, e != 0 ? e : (T)1); y[k] = e != 0 ? v : (T)0; }
