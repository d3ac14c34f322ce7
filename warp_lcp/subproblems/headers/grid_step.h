// Kernels of the projected multigrid method.

// kernel projected_multigrid.update: Direction q = z + beta q; move x along it and clip it to the
// bounds
//   compute    float64
//   bounds
//   reads      S z
//   writes     float64 x; S q
//   whole      float64 scalars
//   constants  SIZE, BETA, STEP, PER_SIZE
//   module     projected_multigrid.steps
const S beta = (S)scalars[BETA];
const T step = scalars[STEP], inverse = step != 0 ? reciprocal(step) : 0;
const bool fresh = beta == 0;  // q may hold anything then, also NaN
fetch(0, n, x, z, q);
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        // the direction of held unknowns is 0
        const auto s = (fresh | (z[k] == 0)) ? z[k] : z[k] + beta * q[k];
        const T v = x[k] + step * (T)s, c = clipped(v, lower(k), upper(k));
        // a step that is NaN or infinite leaves x unchanged
        const bool moves = (s != 0) & (v - v == 0), cut = moves & (c != v);
        const T left = (c - x[k]) * inverse;
        q[k] = cut ? left : (T)s;
        x[k] = moves ? c : x[k];
    }
});

// snippet mark: Marker in a right-hand side, whose entries are of order one: a held unknown that is
// not at its bound, below 0 for the lower one.
const S mark = (S)1e30f;

// kernel projected_multigrid.assess: y = A x + b: natural residual, energy, free set, and on it the
// right-hand side g = -y / SIZE. An unknown is held if it is at a bound and y has the right sign;
// with MINIMUM_MAP if x - y / d lies outside the bounds. If such an unknown is not at its bound
// yet, g is a marker and its row is flagged in `away`.
//   compute    float64
//   stencil    D, W
//   bounds
//   reads      float64 x, b; int8 unknown
//   writes     F free; S g
//   by_row     uint8 changed, away?
//   whole      float64 scalars
//   numbers    bool classify
//   sums       norm, moved, active, energy
//   constants  SIZE, BETA, STEP, PER_SIZE, MINIMUM_MAP = 0, ROUNDED = 0
#include "mark"
// A bound as x can represent it.
const auto near = [](T v) -> T { return ROUNDED ? (T)(float)v : v; };
// a number of faces, or the value that it stands for
const auto stored = [&](int k) -> F { return sizeof(F) > sizeof(*d) ? (F)diagonal(k) : (F)d[k]; };
const T inverse = scalars[PER_SIZE];
T norm = 0, energy = 0;
int moved = 0, active = 0, off = 0;
unsigned char hold[M];
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M;
    T y[M];
    unsigned char any = 0, count = 0, far = 0;
    fetch(begin, end, x + zp, b, g, d, unknown, free);
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    if (unbounded) {
        SIMD8 for (int k = begin; k < end; ++k) {
            const T v = y[k - begin], r = unknown[k] == 1 ? v : (T)0;
            norm += r * r;
            g[k] = d[k] != 0 ? -v * inverse : (T)0;
        }
        SIMD for (int k = begin; k < end; ++k) {
            const F now = stored(k);
            any |= (unsigned char)(free[k] != now);
            free[k] = now;
        }
        moved += any;
        continue;
    }
    with_bounds([&](auto lower, auto upper) {
        SIMD8 for (int k = begin; k < end; ++k) {
            const T e = diagonal(k), f = e != 0 ? e : (T)1, l = lower(k), u = upper(k),
                    v = y[k - begin];
            const T below = f * (x[k] - l), above = f * (x[k] - u),
                    r0 = natural_residual(v, below, above), r = unknown[k] == 1 ? r0 : (T)0;
            norm += r * r;
            energy += unknown[k] == 1 ? x[k] * (v + b[k]) : (T)0;
            if constexpr (MINIMUM_MAP) {
                const bool low = below<v, high = above> v,
                           held = classify & (unknown[k] == 1) & (low | high);
                const bool there = x[k] == (low ? near(l) : near(u));
                const S at = ((e != 0) & !held) ? (S)(-v * inverse) : (S)0;
                hold[k - begin] = held ? (there ? 1 : 3) : 0;
                g[k] = (held & !there) ? (low ? -mark : mark) : at;
            } else {
                const bool held =
                    classify & (((x[k] <= near(l)) & (v >= 0)) | ((x[k] >= near(u)) & (v <= 0)));
                hold[k - begin] = held;
                g[k] = ((e != 0) & !held) ? -v * inverse : (T)0;
            }
        }
    });
    SIMD for (int k = begin; k < end; ++k) {  // bytes only, if the diagonal is a byte
        const unsigned char h = hold[k - begin];
        const F now = h ? (F)0 : stored(k);
        const unsigned char one = free[k] != now, two = h & unknown[k];
        any |= one;
        count += two;
        free[k] = now;
        if constexpr (MINIMUM_MAP) far |= h;
    }
    moved += any;
    active += count;
    off |= far & 2;
}
if (moved) changed[P.row] = 1;
if constexpr (MINIMUM_MAP) {
    if (off) away[P.row] = 1;
}

// kernel projected_multigrid.measure: Products of a correction z for beta and the step length
//   compute    S
//   stencil    F, S
//   reads      S z, q, g
//   sums       zaz, zap, gz, gp
T zaz = 0, zap = 0, gz = 0, gp = 0;
fetch(0, n, z + zp, q, g);
SIMD for (int k = 0; k < n; ++k) {
    const T w = product(z, k);
    zaz += z[k] * w;
    zap += q[k] * w;
    gz += g[k] * z[k];
    gp += g[k] * q[k];
}

// kernel projected_multigrid.measure_again: As projected_multigrid.measure, for some rows, into
// their places among those of all
//   compute    S
//   stencil    F, S
//   reads      S z, q, g
//   whole      float64 sums
//   numbers    int place, lines, places
//   by_cell
#include "projected_multigrid.measure"
double* sum = sums + place + P.k * lines + P.j;
sum[0] = (double)zaz;
sum[places] = (double)zap;
sum[2 * places] = (double)gz;
sum[3 * places] = (double)gp;

// kernel projected_multigrid.hold: Move the marked unknowns of flagged rows onto their bounds
//   compute    float64
//   bounds
//   reads      S g
//   writes     float64 x
//   by_row     uint8 away
//   constants  ROUNDED = 0
#include "mark"
if (!away[P.row]) continue;
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const T l = lower(k), u = upper(k);
        const bool low = g[k] <= -mark, high = g[k] >= mark;
        x[k] = low ? (ROUNDED ? (T)(float)l : l) : high ? (ROUNDED ? (T)(float)u : u) : x[k];
    }
});

// kernel projected_multigrid.right_side: g = -(A x + b) / SIZE on the free set, in flagged rows and
// rows beside them
//   compute    float64
//   stencil    D, W
//   reads      float64 x, b; F free
//   writes     S g
//   by_row     uint8 away
//   whole      float64 scalars
//   numbers    bool around_y, around_z
//   constants  SIZE, BETA, STEP, PER_SIZE
const auto flagged = [&](int k, int j) -> bool {
    if (around_z) k = (k + L.planes) % L.planes;
    if (around_y) j = (j + L.rows) % L.rows;
    return k >= 0 && k < L.planes && j >= 0 && j < L.rows && away[k * L.rows + j];
};
if (!(flagged(P.k, P.j) || flagged(P.k - 1, P.j) || flagged(P.k + 1, P.j) ||
      flagged(P.k, P.j - 1) || flagged(P.k, P.j + 1)))
    continue;
const T inverse = reciprocal(scalars[SIZE]);
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M;
    T y[M];
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    SIMD8 for (int k = begin; k < end; ++k) {
        const T v = y[k - begin] * inverse;
        g[k] = free[k] != 0 ? -v : (T)0;
    }
}

// kernel projected_multigrid.gaps: Bounds of a correction in units of SIZE: finite, 0 where there
// is no unknown
//   compute    float64
//   bounds
//   reads      float64 x; int8 unknown
//   writes     S lo, hi?
//   whole      float64 scalars
//   constants  SIZE, BETA, STEP, PER_SIZE
//   module     projected_multigrid.steps
const T inverse = reciprocal(scalars[SIZE]), big = 1e30;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = (lower(k) - x[k]) * inverse, l = a < -big ? -big : (a > 0 ? (T)0 : a);
        lo[k] = unknown[k] == 1 ? l : (T)0;
    }
    if (hi) SIMD for (int k = 0; k < n; ++k) {
            const T c = (upper(k) - x[k]) * inverse, u = c > big ? big : (c < 0 ? (T)0 : c);
            hi[k] = unknown[k] == 1 ? u : (T)0;
        }
});

// kernel projected_multigrid.mask: 1 where the masked diagonal is not 0
//   compute    uint8
//   reads      F free
//   writes     uint8 mask
SIMD for (int k = 0; k < n; ++k) mask[k] = free[k] != 0;

// kernel projected_multigrid.undo: Undo the last step, as far as no bound has cut it
//   compute    float64
//   bounds
//   reads      float64 x; S q; int8 unknown
//   writes     float64 before
//   whole      float64 scalars
//   constants  SIZE, BETA, STEP, PER_SIZE
const T step = scalars[STEP];
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T v = x[k] - step * (T)q[k], c = clipped(v, lower(k), upper(k));
        before[k] = ((unknown[k] == 1) & (q[k] != 0) & (v - v == 0)) ? c : x[k];
    }
});
