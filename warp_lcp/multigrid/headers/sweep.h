// y = x + omega (b - A x) / diagonal, clipped to the bounds if projected; from_zero: as if x were 0.
#include "relax.h"
const auto from_b = [&](int k, T e) -> T { return omega*b[k] / e; };
const auto from_x = [&](int k, T e) -> T { return relaxed(x[k], around(x, k, down, up), omega, k, e); };
const auto sweep = [&](auto value, auto clip) {
    SIMD for (int k = 0; k < n; ++k) { const T e = diagonal(k), u = value(k, e != 0 ? e : (T)1), v = e != 0 ? u : (T)0; y[k] = clip(k, v); } };
const auto clips = [&](auto value) {
    if (!projected) sweep(value, [](int, T v) { return v; });
    else if (upper) sweep(value, [&](int k, T v) { return clipped(v, lower[k], upper[k]); });
    else sweep(value, [&](int k, T v) { return v < lower[k] ? lower[k] : v; }); };
if (from_zero) clips(from_b); else clips(from_x);
