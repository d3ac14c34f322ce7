"""What sand can bear, as native code: the shape of a field of stresses, the yield set of a cell, friction on a wall.

All stresses are impulses over rho dx [m/s]: x = kick_dt p / (rho dx) and the like, so that spacing and time step appear nowhere. A field of
stresses has layers of the grid's shape: x, the normal parts of the deviator (2-D: a = s_xx = -s_yy; 3-D: s_xx, s_yy, s_zz), and for each
shear four *copies*, which belong to the cell: copy q of the shear of axes (alpha, beta) lies on the cell's edge at the low (0) or high
(1) side along alpha, q & 1, and along beta, q >> 1. Shears are ordered xy, xz, yz. An edge, stored at the cell whose low side it is, has
the mean of the copies of the cells that take part in it; `share` holds the weight of a copy there: > 0 between cells, < 0 (and its
absolute value the weight) on a wall, 0 where there is no shear. Where solids cut cells DIM layers follow: the traction of the wall in a
cell, see `granular.cut_walls`.
"""

import re
from typing import Any

from warp_lcp.native import C_TYPES, simd

NEWTON = 4  # iterations for the multiplier of a yielding cell: 3 are exact to 2e-6 of the bound, 4 to rounding
COLUMNS = 8  # of a row's sums, see `granular.stress_kernels`

# what kernels read: the yield set, dt g [m/s] (three entries), the steps of a method relative to the diagonal, how far beyond the
# stresses, in units of the momentum's displacement, it takes its gradient, dt / dx [s/m], and what friction gains with the rate, see RATE
FRICTION, COHESION, TENSION, WEIGHT, PRESSURE_STEP, SHEAR_STEP, LOOKAHEAD, STEP_OF_CELL = 0, 1, 2, 3, 6, 7, 8, 9
GAIN, HALFWAY, NUMBERS = 10, 11, 12

HOLDS = 1  # bits of a cell: it holds sand, and so a pressure,
SHEARS_HERE = 2  # enough of it to carry shear,
FIRM = 4  # so much that cohesion may hold it together,
PARTLY = 8  # and a solid cuts it, or a cell beside it
NEARLY = 0.05  # of a cell free, below which what passes its faces counts as volume, whatever its neighbors hold, see FLUX
LEAST_RADIUS = 1e-30  # [m/s], of a yield set that holds only zero

CONSTANTS = {
    "NEWTON": NEWTON, "COLUMNS": COLUMNS, "LEAST_RADIUS": LEAST_RADIUS, "FRICTION": FRICTION, "COHESION": COHESION,
    "TENSION": TENSION, "WEIGHT": WEIGHT, "PRESSURE_STEP": PRESSURE_STEP, "SHEAR_STEP": SHEAR_STEP, "LOOKAHEAD": LOOKAHEAD,
    "HOLDS": HOLDS, "SHEARS_HERE": SHEARS_HERE, "FIRM": FIRM, "PARTLY": PARTLY, "STEP_OF_CELL": STEP_OF_CELL, "NEARLY": NEARLY,
    "GAIN": GAIN, "HALFWAY": HALFWAY,
}  # fmt: skip

SHAPE = """
    enum { NORMALS = DIM == 3 ? 3 : 1, SHEARS = DIM == 3 ? 3 : 1, FIRST = 1 + NORMALS };
    constexpr int ALPHA[3] = {0, 0, 1}, BETA[3] = {1, 2, 2};
    const long long nx = share_x.shape[2], layer = nx*share_x.shape[1]*share_x.shape[0];
    const long long s[3] = {1, nx, nx*share_x.shape[1]}, row = k*s[2] + j*s[1];
"""

# What passes a face counts by the face's mass: div(m u). A full cell cannot be compressed: it counts volume, div u, or else a block that
# falls would be squeezed at its front, where lighter faces let less out than comes in from behind. `passes` goes from one to the other.
FLUX = """
    auto passes = [](T mass, T full) INLINE { return mass + full*((T)1 - mass); };
    auto fullness = [](T free) INLINE { const T c = (T)1 - free*(T)(1.0/NEARLY); return c < (T)0 ? (T)0 : c > (T)1 ? (T)1 : c; };
"""

# Friction that grows with the rate of shear [Jop, Forterre & Pouliquen 2006]: the radius is r + gain e/(e + half), with e the cell's rate
# of shear times dx [m/s] and half the one at which half of the gain is there, both functions of the pressure.
RATE_BOUND = """
    auto gain_at = [&](T x) INLINE { return RATE && x > (T)0 ? (T)numbers.data[GAIN]*x : (T)0; };
    auto half_at = [&](T x) INLINE { return RATE && x > (T)0 ? (T)numbers.data[HALFWAY]*sqrt(x) : (T)0; };
    auto gained = [](T e, T gain, T half) INLINE { return e > (T)0 ? gain*e/(e + half) : (T)0; };
"""

# Nearest point of { |n|^2 / 2 + sum over shears of max_q b_q^2 <= r^2 } in the metric |n|^2 / 2 + sum of b_q^2 / 4. With a multiplier mu
# n shrinks by 1 + mu and the largest |b_q| of a shear are cut to m = max_n S_n / (n + 4 mu), S_n the sum of the n largest of the four;
# mu is the root of 1/r - 1/sqrt(|n|^2/2 + sum m^2), nearly linear in mu. The box of Narain et al.
# bounds each part by itself instead: |n|^2 / 2 <= r^2, |b_q| <= r.
# RATE: a step of `soft` leaves the rate of shear e = mu r / soft, by which r itself grows: the step is backward Euler's, and what it comes
# to rest at does not depend on its length. Newton's line for 1/size then meets 1/r(e) where r(e) (size - slope mu) + slope soft e = size^2:
# a quadratic for e.
YIELD = """
    auto larger = [](T a, T b) INLINE { return a > b ? a : b; };
    auto smaller = [](T a, T b) INLINE { return a < b ? a : b; };
    auto magnitude = [](T a) INLINE { return a < (T)0 ? -a : a; };
    // how much n shrinks, and the largest |b| of each shear
    auto yield = [&](T normal2, const T (&largest)[SHEARS][4], T static_, T gain, T half, T soft, T (&cap)[SHEARS]) INLINE {
        T r = static_, e = 0;
        if (BOX) {
            for (int d = 0; d < SHEARS; ++d) cap[d] = r;
            return smaller(r/larger(sqrt(normal2), (T)LEAST_RADIUS), (T)1);
        }
        const T inverse_r = (T)1/(RATE ? r + gain : r), all = sqrt(normal2);
        T mu = all*inverse_r - (T)1, size = 0;  // a lower bound: each part by itself must fit
        UNROLL for (int d = 0; d < SHEARS; ++d) UNROLL for (int n = 0; n < 4; ++n)
            mu = larger(mu, (T)0.25*(largest[d][n]*inverse_r - (T)(n + 1)));
        mu = larger(mu, (T)0);
        T shrink = 0;
        UNROLL for (int iteration = 0; iteration <= NEWTON; ++iteration) {
            shrink = (T)1/((T)1 + mu);
            T by[4];
            UNROLL for (int n = 0; n < 4; ++n) by[n] = (T)1/((T)(n + 1) + (T)4*mu);
            const T a2 = normal2*shrink*shrink;
            T total = a2, slope = a2*shrink;
            UNROLL for (int d = 0; d < SHEARS; ++d) {
                T m = largest[d][0]*by[0], rate = by[0];
                UNROLL for (int n = 1; n < 4; ++n) {
                    const T other = largest[d][n]*by[n];
                    rate = other > m ? by[n] : rate;
                    m = larger(m, other);
                }
                cap[d] = m;
                total += m*m;
                slope += m*m*(T)4*rate;
            }
            size = sqrt(total);
            if (RATE && iteration < NEWTON) {
                const T along = slope/larger(total, (T)LEAST_RADIUS), rest = (T)1 - along*mu, by_rate = along*soft, q = size - rest*static_;
                const T p = by_rate*half + rest*gain - q, root = sqrt(p*p + (T)4*larger(by_rate*q*half, (T)0));
                const T above = p > (T)0 ? (T)2*q*half : root - p, below = p > (T)0 ? p + root : larger((T)2*by_rate, (T)LEAST_RADIUS);
                e = q > (T)0 ? above/below : (T)0;
                mu = e > (T)0 ? soft*e*(e + half)/(static_*(e + half) + gain*e) : (T)0;
            } else if (iteration < NEWTON) {
                const T step = (size*inverse_r - (T)1)*total/larger(slope, (T)LEAST_RADIUS);
                mu = larger(mu + step, (T)0);
            }
        }
        if (RATE) r += gained(e, gain, half);
        const T onto = smaller(r/larger(size, (T)LEAST_RADIUS), (T)1);
        UNROLL for (int d = 0; d < SHEARS; ++d) cap[d] *= onto;
        return onto*shrink;
    };
    // sums of the one, two, three, four largest
    auto sums = [&](T a, T b, T c, T d, T (&out)[4]) INLINE {
        const T ab = larger(a, b), ba = smaller(a, b), cd = larger(c, d), dc = smaller(c, d);
        const T low = smaller(ab, cd), high = larger(ba, dc);
        out[0] = larger(ab, cd); out[1] = out[0] + larger(low, high); out[2] = out[1] + smaller(low, high);
        out[3] = out[2] + smaller(ba, dc);
    };
"""

# Coulomb friction on a wall face of a cell: the copies on its edges, two of each shear, within mu times the normal load, in the metric
# sum b_q^2 / 2. The load is that of the face: x - n and the weight of the half cell before it, or of all of it where there is no
# pressure. `rate` and `light` tell an edge's rate of shear and the sum of 1 / mass around it; `from` tells where a copy's step starts,
# `store` gets its new value and the face's diagonal.
WALL_FACE = """
    const float* shares[3] = {share_x.data, share_y.data, share_z.data};
    auto face = [&](int entry, auto from, const float* now, const float* weight, T omega, auto light, auto rate, auto store) {
        const long long cell = cells.data[entry];
        const int axis = sides.data[entry] >> 1, side = sides.data[entry] & 1;
        const float x = now[cell], n = DIM == 3 ? now[(1 + axis)*layer + cell] : (axis == 0 ? 1.0f : -1.0f)*now[layer + cell];
        const float toward = (side ? 1.0f : -1.0f)*weight[axis], load = x - n + (x > 0.0f ? 0.5f : 1.0f)*toward*fraction_.data[cell];
        const T bound = friction.data[walls.data[entry]]*(load > 0.0f ? load : 0.0f);
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
"""

# Vectorized loops may call nothing: small functions inside them must vanish, however large the loop grows.
INLINE = """
#ifdef __CUDA_ARCH__
#define INLINE
#else
#define INLINE __attribute__((always_inline))
#endif
"""


# Where solids cut cells (CUT): the open part of a cell's lower faces, and how much of a cell its differences along an axis stand for.
OPENINGS = """
#if CUT
    auto open = [&](int axis, long long i) INLINE { return (T)cut_.data[axis*layer + row + i]; };
    auto counted = [&](int axis, long long i) INLINE { return (T)cut_.data[(DIM + axis)*layer + row + i]; };
#else
    auto open = [](int, long long) INLINE { return (T)1; };
    auto counted = open;
#endif
"""


def native(source: str, dimension: int, real: Any, *, box: bool = False, rate: bool = False, cut: bool = False, **numbers: int) -> str:
    """Return the body of a native function for 2 or 3 dimensions and velocities of `real`; words in `numbers` become their values.

    `UNROLL for` becomes a loop that is unrolled: a vectorized loop may have no other inside.

    Args:
        source: of the body.
        dimension: 2 or 3.
        real: wp.float32 or wp.float64.
        box: Narain's box instead of the cone.
        rate: friction grows with the rate of shear.
        cut: solids cut cells.
        numbers: more words and their values.
    """
    source = INLINE + f"typedef {C_TYPES[real]} T;\n" + source
    for word, value in (CONSTANTS | {"DIM": dimension, "BOX": int(box), "RATE": int(rate), "CUT": int(cut)} | numbers).items():
        source = re.sub(rf"\b{word}\b", str(value), source)
    return simd(source.replace("UNROLL ", "\n#ifndef __CUDA_ARCH__\n#pragma clang loop unroll(full)\n#endif\n"))
