// The system of the next step: D = s / w + t / v, without A's diagonal unless FUSED, and the right-hand side.
#include "path_cells.h"
T square = 0, weighted = 0;
if constexpr (FUSED) {
    for (int begin = 0; begin < n; begin += M) {
        const int end = n - begin < M ? n : begin + (int)M; T y[M];
        fetch(begin, end, x + zp, b, r, D, d, unknown, free);
        SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
        with_bounds([&](auto lower, auto upper) {
            SIMD8 for (int i = begin; i < end; ++i) {
                const T e = diagonal(i), size = e != 0 ? e : (T)1, yi = y[i - begin];
                const T natural = unknown[i] == 1 ? natural_residual(yi, size*(x[i] - lower(i)), size*(x[i] - upper(i))) + 0.0*x[i] : (T)0;
                T shift = e + s[i]/w[i]; if constexpr (UPPER) shift = shift + t[i]/v[i];
                const S diagonal = free[i] ? (S)shift : (S)0, right = free[i] ? (S)(-scale*yi) : (S)0, root = right*right;
                D[i] = diagonal; r[i] = right; square += natural*natural;
                weighted += (T)(root/(diagonal > 0 ? diagonal : (S)1)); } }); }
} else {
    EACH_CELL(
        const double iw = 1.0/w[i]; double sides = iw, shift = s[i]*iw;
        if constexpr (UPPER) { const double iv = 1.0/v[i]; sides = iw - iv; shift = s[i]*iw + t[i]*iv; }
        const double g = -affine(x, b, i) + tau*sides;
        D[i] = free[i] ? shift : 0.0; r[i] = free[i] ? scale*g : 0.0;) }
