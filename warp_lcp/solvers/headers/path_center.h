// The corrector's right-hand side, what the predictor has left of its own and the terms of second order; a keeps the predictor's e.
#include "path_cells.h"
const double inverse = 1/scale; double weighted = 0;
fetch(0, n, w, s, e, r, a);
EACH_CELL(
    const double dp = scale*(double)e[i], iw = 1.0/w[i], dsp = -s[i] - s[i]*iw*dp;
    double g = (tau - dp*dsp)*iw;
    if constexpr (UPPER) { const double iv = 1.0/v[i], dtp = -t[i] + t[i]*iv*dp; g = (tau - dp*dsp)*iw - (tau + dp*dtp)*iv; }
    a[i] = e[i];
    if constexpr (FUSED) {
        const S at = D[i], now = at != 0 ? (S)((double)r[i] + g*inverse) : r[i];
        r[i] = now; weighted += (double)(now*now/(at > 0 ? at : (S)1));
    } else {
        const double old = carried ? (double)r[i] : -y[i]/scale;
        r[i] = free[i] ? old + g/scale : 0.0; })
