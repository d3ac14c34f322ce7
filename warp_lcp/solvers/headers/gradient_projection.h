// Kernels of gradient projection methods: MPRGP, NNCG, subspace minimization, accelerated
// gradients; and of staggering.

// kernel mprgp.split: From y = A x + b, which is not stored: the natural residual and its parts on
// held and free unknowns, the free set, g = -y / size on it, and the chopped step
//   compute    float64
//   stencil    D, W
//   bounds
//   reads      float64 x, b; int8 unknown
//   writes     uint8 free; S g, step
//   numbers    float64 inverse, slack
//   sums       norm, chopped, reduced, release, moved, active, energy
const auto reach = [&](T v) -> T { return slack * (v < 0 ? -v : v); };
T norm = 0, chopped = 0, reduced = 0, release = 0, energy = 0;
int moved = 0, active = 0;
unsigned char now[M];
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M;
    T y[M];
    unsigned char any = 0, count = 0;
    fetch(begin, end, x + zp, b, g, step, d, unknown, free);
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    with_bounds([&](auto lower, auto upper) {
        SIMD8 for (int k = begin; k < end; ++k) {
            const T e = diagonal(k), f = e != 0 ? e : (T)1, l = lower(k), u = upper(k),
                    v = y[k - begin];
            const bool in = unknown[k] == 1,
                       held = in & ((x[k] <= l + reach(l)) | (x[k] >= u - reach(u)));
            const T r0 = natural_residual(v, f * (x[k] - l), f * (x[k] - u)), r = in ? r0 : (T)0,
                    h = held ? r : (T)0;
            // the division would take longest in float64
            const S w = (S)(-h * inverse) / (S)f;
            norm += r * r;
            chopped += h * h;
            reduced += held ? (T)0 : r * v;
            release -= (held ? v : (T)0) * inverse * (T)w;
            energy += in ? (T)0.5 * x[k] * (v + b[k]) : (T)0;
            now[k - begin] = in & !held;
            g[k] = (S)((in & !held) ? -v * inverse : (T)0);
            step[k] = w;
        }
    });
    SIMD64 for (int k = begin; k < end; ++k) {
        const unsigned char one = now[k - begin] != free[k],
                            two = (unknown[k] == 1) & !now[k - begin];
        any |= one;
        count += two;
        free[k] = now[k - begin];
    }
    moved += any;
    active += count;
}

// kernel mprgp.split_known: As mprgp.split, with y known; the chopped step is not rounded before it
// is summed
//   compute    float64
//   stencil    D, W
//   bounds
//   reads      float64 x, b; int8 unknown
//   writes     uint8 free; S g, step
//   numbers    float64 inverse, slack
//   sums       norm, chopped, reduced, release, moved, active, energy
const auto reach = [&](T v) -> T { return slack * (v < 0 ? -v : v); };
T norm = 0, chopped = 0, reduced = 0, release = 0, moved = 0, active = 0, energy = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = diagonal(k), f = a < 0 ? -a : a, e = f == 0 ? (T)1 : f, v = known[k],
                l = lower(k), u = upper(k);
        const bool in = unknown[k] == 1,
                   held = in & ((x[k] <= l + reach(l)) | (x[k] >= u - reach(u)));
        const T r0 = natural_residual(v, e * (x[k] - l), e * (x[k] - u)),
                r = in ? r0 + (T)0 * x[k] : (T)0, h = held ? r : (T)0;
        const unsigned char now = in & !held;
        norm += r * r;
        chopped += h * h;
        reduced += held ? (T)0 : r * v;
        release += (held ? v : (T)0) * h / e * inverse * inverse;
        moved += now != free[k] ? (T)1 : (T)0;
        active += held ? (T)1 : (T)0;
        free[k] = now;
        g[k] = now ? (S)(-v * inverse) : (S)0;
        step[k] = (S)(-h / e * inverse);
    }
});
SIMD for (int k = 0; k < n; ++k) energy +=
    unknown[k] == 1 ? (T)0.5 * x[k] * (known[k] + b[k]) : (T)0;

// kernel mprgp.release: Move x along the chopped step and clip it to the bounds; unknowns that move
// are free. The right-hand side g loses `part` q and gains the rows of these unknowns: e step = -y
// / size
//   compute    float64
//   stencil    D, W
//   bounds
//   reads      float64 x; S step, q
//   writes     float64 to; uint8 free; S g
//   numbers    float64 part, length
const S share = (S)part;
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const T a = diagonal(k), e = a == 0 ? (T)1 : a, v = x[k] + length * (T)step[k],
                c = clipped(v, lower(k), upper(k));
        const S s = step[k], own = (S)(e * (T)s), before = s != 0 ? own : g[k];
        const bool now = (s != 0) | (free[k] != 0);
        to[k] = ((s != 0) & (v - v == 0)) ? c : x[k];
        g[k] = now ? before - share * q[k] : (S)0;
    }
});
SIMD64 for (int k = 0; k < n; ++k) free[k] = free[k] | (unsigned char)(step[k] != 0);

// kernel mprgp.gain: Products of a direction p with q = A p: the decrease g'p and the curvature p'q
//   compute    float64
//   reads      S along, q, g
//   sums       gain, curvature
T gain = 0, curvature = 0;
SIMD for (int k = 0; k < n; ++k) {
    gain += (T)g[k] * (T)along[k];
    curvature += (T)q[k] * (T)along[k];
}

// kernel nncg.taken: g holds x before a sweep; it becomes the gradient, x before - x. The sum of
// its squares
//   compute    float64
//   reads      float64 x; int8 unknown
//   writes     float64 g
//   sums       square
T square = 0;
SIMD for (int k = 0; k < n; ++k) {
    const T v = unknown[k] == 1 ? g[k] - x[k] : (T)0;
    g[k] = v;
    square += v * v;
}

// kernel nncg.carry_on: Restart if the gradient has grown, else x += beta p and p = beta p - g.
// `squares`: of the present and the previous gradient (0: none)
//   compute    float64
//   bounds
//   reads      float64 g; int8 unknown
//   writes     float64 x, along
//   whole      float64 squares
//   by_cell
const double fresh = squares[0], old = squares[1];
#include "snippets.h:fletcher_reeves"
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T q = beta * along[k], c = clipped(x[k] + q, lower(k), upper(k));
        const bool in = unknown[k] == 1;
        x[k] = in ? c : x[k];
        along[k] = in ? q - keep * g[k] : (T)0;
    }
});

// kernel subspace.between: Free set: unknowns between their bounds ([Book] eq. 2.92). Counts:
// unknowns that entered or left it, and held ones
//   compute    float64
//   bounds
//   reads      float64 x; int8 unknown
//   writes     uint8 free
//   sums       moved, held
T moved = 0, held = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const bool inside = unknown[k] == 1, now = inside & (x[k] > lower(k)) & (x[k] < upper(k));
        moved += now != (free[k] != 0) ? (T)1 : (T)0;
        held += (inside & !now) ? (T)1 : (T)0;
        free[k] = now;
    }
});

// kernel subspace.follow: Move x with its bounds: an unknown that was at a bound stays at it, the
// others are projected
//   compute    float64
//   bounds
//   reads      float64 old_lower, old_upper
//   writes     float64 x
with_bounds([&](auto lower, auto upper) {
    SIMD8 for (int k = 0; k < n; ++k) {
        const T l = lower(k), u = upper(k), was_l = old_lower[k], was_u = old_upper[k], v = x[k],
                c = clipped(v, l, u);
        const T low = ((was_l != l) & (v <= was_l)) ? l : c;
        x[k] = ((was_u != u) & (v >= was_u)) ? u : low;
    }
});

// kernel accelerated.progress: s'(y - y_z), s'D s, -s'D (x - x_old) and x'D x with s = x - z
//   compute    float64
//   reads      float64 x, x_old, y, z, y_z, d; int8 unknown
//   sums       curvature, metric, turned, size
T curvature = 0, metric = 0, turned = 0, size = 0;
SIMD for (int k = 0; k < n; ++k) {
    const T one = unknown[k] == 1 ? (T)1 : (T)0, s = one * (x[k] - z[k]);
    curvature += s * (y[k] - y_z[k]);
    metric += d[k] * s * s;
    turned -= d[k] * s * (x[k] - x_old[k]);
    size += one * d[k] * x[k] * x[k];
}

// kernel accelerated.extrapolate: Extrapolate x and y to z and y_z, and take the projected gradient
// step from there
//   compute    float64
//   bounds
//   reads      float64 y, d; int8 unknown
//   writes     float64 x, x_old, y_old, z, y_z
//   numbers    float64 beta, lipschitz
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = x[k] + beta * (x[k] - x_old[k]), s = y[k] + beta * (y[k] - y_old[k]);
        const T c = clipped(a - s / (lipschitz * d[k]), lower(k), upper(k));
        x_old[k] = x[k];
        y_old[k] = y[k];
        z[k] = a;
        y_z[k] = s;
        x[k] = unknown[k] == 1 ? c : x[k];
    }
});

// kernel partition.select: x on the members, minus `less` if given; elsewhere the previous value,
// or 0
//   compute    float64
//   reads      float64 x, less?; uint8 member
//   writes     float64 target
//   numbers    bool kept
//   by_cell
const auto select = [&](auto value) {
    SIMD for (int k = 0; k < n; ++k) {
        const double v = value(k), rest = kept ? target[k] : 0.0;
        target[k] = member[k] ? v : rest;
    }
};
if (less)
    select([&](int k) { return x[k] - less[k]; });
else
    select([&](int k) { return x[k]; });
