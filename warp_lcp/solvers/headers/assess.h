// y = A x + b: the natural residual, the energy, the free set, and g = -y / SIZE on it, a right-hand side.
// An unknown is held if it sits at a bound with y of the right sign; by the MINIMUM_MAP, if x - y / d lies outside the bounds: where such
// a one is not at its bound yet, g is a mark and its row is flagged in `away`.
#include "mark.h"
const auto near = [](T v) -> T { return ROUNDED ? (T)(float)v : v; };  // a bound as x can hold it
const auto stored = [&](int k) -> F { return sizeof(F) > sizeof(*d) ? (F)diagonal(k) : (F)d[k]; };  // a count of faces, or what it is worth
const T inverse = scalars[PER_SIZE];
T norm = 0, energy = 0; int moved = 0, active = 0, off = 0; unsigned char hold[M];
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M; T y[M]; unsigned char any = 0, count = 0, far = 0;
    fetch(begin, end, x + zp, b, g, d, unknown, free);
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    if (unbounded) {
        SIMD8 for (int k = begin; k < end; ++k) {
            const T v = y[k - begin], r = unknown[k] == 1 ? v : (T)0; norm += r*r; g[k] = d[k] != 0 ? -v*inverse : (T)0; }
        SIMD for (int k = begin; k < end; ++k) { const F now = stored(k); any |= (unsigned char)(free[k] != now); free[k] = now; }
        moved += any;
        continue;
    }
    with_bounds([&](auto lower, auto upper) {
        SIMD8 for (int k = begin; k < end; ++k) {
            const T e = diagonal(k), f = e != 0 ? e : (T)1, l = lower(k), u = upper(k), v = y[k - begin];
            const T below = f*(x[k] - l), above = f*(x[k] - u), r0 = natural_residual(v, below, above), r = unknown[k] == 1 ? r0 : (T)0;
            norm += r*r; energy += unknown[k] == 1 ? x[k]*(v + b[k]) : (T)0;
            if constexpr (MINIMUM_MAP) {
                const bool low = below < v, high = above > v, held = classify & (unknown[k] == 1) & (low | high);
                const bool there = x[k] == (low ? near(l) : near(u));
                const S at = ((e != 0) & !held) ? (S)(-v*inverse) : (S)0;
                hold[k - begin] = held ? (there ? 1 : 3) : 0; g[k] = (held & !there) ? (low ? -mark : mark) : at;
            } else {
                const bool held = classify & (((x[k] <= near(l)) & (v >= 0)) | ((x[k] >= near(u)) & (v <= 0)));
                hold[k - begin] = held; g[k] = ((e != 0) & !held) ? -v*inverse : (T)0;
            } } });
    SIMD for (int k = begin; k < end; ++k) {  // bytes only, where the diagonal is one
        const unsigned char h = hold[k - begin]; const F now = h ? (F)0 : stored(k); const unsigned char one = free[k] != now, two = h & unknown[k];
        any |= one; count += two; free[k] = now; if constexpr (MINIMUM_MAP) far |= h; }
    moved += any; active += count; off |= far & 2; }
if (moved) changed[P.row] = 1;
if constexpr (MINIMUM_MAP) { if (off) away[P.row] = 1; }
