// Friction on a wall face of a cell: the copies on its edges, two of each shear, within `wall_bound` of the normal load, in the metric
// sum b_q^2 / 2. The load is that of the face: x - n and the weight of the half cell before it, or of all of it where there is no
// pressure. `rate` and `light` tell an edge's rate of shear and the sum of 1 / mass around it; `from` tells where a copy's step starts,
// `store` gets its new value and the face's diagonal.
#include "wall_bound.h"
const float* shares[3] = XYZ(share);
auto face = [&](int entry, auto from, const float* now, const float* weight, T omega, auto light, auto rate, auto store) {
    const long long cell = cells[entry];
    const int axis = sides[entry] >> 1, side = sides[entry] & 1;
    const float x = now[cell], n = DIM == 3 ? now[(1 + axis)*layer + cell] : (axis == 0 ? 1.0f : -1.0f)*now[layer + cell];
    const float toward = (side ? 1.0f : -1.0f)*weight[axis], load = x - n + (x > 0.0f ? 0.5f : 1.0f)*toward*fraction[cell];
    const T bound = wall_bound(friction[walls[entry]], load > 0.0f ? load : 0.0f);
    T b[2][2], most[2] = {0, 0}, sum[2] = {0, 0}, stiffest = 0, share[2][2]; long long slot[2][2], at[2][2]; int shear[2] = {0, 0};
    for (int t = 0; t < DIM - 1; ++t) {
        const int d = DIM == 2 ? 0 : (axis == 0 ? t : axis == 1 ? 2*t : 1 + t);
        shear[t] = d;
        for (int m = 0; m < 2; ++m) {
            const int q = ALPHA[d] == axis ? side + 2*m : m + 2*side;
            at[t][m] = cell + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
            slot[t][m] = (FIRST + 4*d + q)*layer + cell;
            share[t][m] = shares[d][at[t][m]] < 0.0f ? -(T)shares[d][at[t][m]] : (T)0;
            if (share[t][m] > (T)0) {
                const T stiff = (T)2*share[t][m]*light(d, at[t][m]);
                stiffest = stiff > stiffest ? stiff : stiffest;
            }
        }
    }
    if (!(stiffest > (T)0)) return;
    for (int t = 0; t < DIM - 1; ++t) for (int m = 0; m < 2; ++m) {
        b[t][m] = share[t][m] > (T)0 ? from(slot[t][m]) + omega*(T)2/stiffest*share[t][m]*rate(shear[t], at[t][m]) : (T)0;
        const T size = b[t][m] < (T)0 ? -b[t][m] : b[t][m];
        sum[t] += size; most[t] = size > most[t] ? size : most[t];
    }
    T cap[2] = {0, 0}, total = 0, slope = 0, mu = 0, onto = 0;
    auto cut_at = [&]() {
        total = 0; slope = 0;
        for (int t = 0; t < DIM - 1; ++t) {
            const T one = most[t]/((T)1 + (T)2*mu), two = sum[t]/((T)2 + (T)2*mu);
            cap[t] = one > two ? one : two;
            total += cap[t]*cap[t];
            slope += cap[t]*cap[t]*(T)2/((one > two ? (T)1 : (T)2) + (T)2*mu);
        }
    };
    cut_at();
    if (bound > (T)LEAST_RADIUS) {
        for (int iteration = 0; iteration < NEWTON && total > bound*bound; ++iteration) {
            mu += (sqrt(total)/bound - (T)1)*total/slope;
            cut_at();
        }
        onto = total > bound*bound ? bound/sqrt(total) : (T)1;
    }
    for (int t = 0; t < DIM - 1; ++t) for (int m = 0; m < 2; ++m) {
        if (!(share[t][m] > (T)0)) continue;
        const T limit = cap[t]*onto, cut = b[t][m] > limit ? limit : b[t][m] < -limit ? -limit : b[t][m];
        store(shear[t], at[t][m], slot[t][m], share[t][m], cut, stiffest);
    }
};
