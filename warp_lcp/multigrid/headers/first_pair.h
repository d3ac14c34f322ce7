// y = two sweeps from x = 0: the first one, which needs no neighbors, is made again wherever the second looks, instead of stored.
#include "relax.h"
const auto first = [&](int k, int rows, int planes) -> T {
    const long long i = k + beside(rows, planes, zm, zp); const T e = unit*(T)d[i]; return e != 0 ? omega*b[i] / e : (T)0; };
for (int k = 0; k < n; ++k) {
    const T e = diagonal(k), v = relaxed(first(k, 0, 0), around_of(first, k), second, k, e != 0 ? e : (T)1); y[k] = e != 0 ? v : (T)0; }
