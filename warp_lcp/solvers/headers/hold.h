// Marked unknowns of flagged rows go onto their bounds.
#include "mark.h"
if (!away[P.row]) continue;
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const T l = lower(k), u = upper(k); const bool low = g[k] <= -mark, high = g[k] >= mark;
        x[k] = low ? (ROUNDED ? (T)(float)l : l) : high ? (ROUNDED ? (T)(float)u : u) : x[k]; } });
