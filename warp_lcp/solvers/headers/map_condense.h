// Newton's system over q: D = d p / q, on top of A's diagonal if FUSED, and -scale f / q; sums of f^2, of the natural residual and of the
// right-hand side in the norm of its system.
#include "map_numbers.h"
#if FUSED
double square = 0; S merit = 0, weighted = 0; const S least_q = (S)least;
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M; T y[M];
    fetch(begin, end, x + zp, b, r, D, d, unknown);
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    with_bounds([&](auto lower, auto upper) { SIMD for (int i = begin; i < end; ++i) {
#include "map.h"
        const S qs = q > least_q ? q : least_q, inverse = (S)1/qs; const bool solved = inside & !(drop & kink);
        const S shifted = solved ? (S)at_ + (S)size*p*inverse : (S)0, right = solved ? -f*inverse : (S)0;
        merit += f*f; D[i] = shifted; r[i] = right; weighted += right*right/(shifted > 0 ? shifted : (S)1); } }); }
#else
double merit = 0, square = 0, weighted = 0; const double least_q = least;
with_bounds([&](auto lower, auto upper) { SIMD for (int i = 0; i < n; ++i) {
#include "map.h"
    const double qs = q > least_q ? q : least_q; const bool solved = inside & !(drop & kink);
    merit += f*f; D[i] = solved ? size*p/qs : 0.0; r[i] = solved ? -scale*f/qs : 0.0; free[i] = solved; } });
#endif
