#include "entries.h"
// A row of P A P + P D P into a pattern with a whole diagonal, and what follows from it
ROWS {
    const bool own = free[i]; const double extra = own && shift ? shift[k] : 0.0; double sum = 0, mid = 0;
    ENTRIES {
        const int j = col[e], from = order ? order[e] : e;
        double v = (own && free[j] && from >= 0) ? (double)a[from] : 0.0;
        if (j == i) { v += extra; mid = v; }
        m[e] = (T)v; sum += v < 0 ? -v : v; }
    const double size = (double)d[k] < 0 ? -(double)d[k] : (double)d[k];
    inverse[k] = sum > 0 ? (T)(1.0/sum) : (T)0;
    scale[k] = own ? (extra > 0 ? (T)(size/(size + extra)) : (T)1) : (T)0;
    weight[k] = mid > 0 ? (T)(1.0/mid) : (mid < 0 ? (T)(-1.0/mid) : (T)(own ? 1 : 0)); }
