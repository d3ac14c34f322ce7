// Kernels of the interior-point method. UPPER: whether there are upper bounds.

// snippet path_cells: Macro of a loop over the cells of the piece: the compiler orders factors by
// what it sees in a loop. Sums keep the order that they have on grids and elsewhere.
#define EACH_CELL(...)                      \
    if constexpr (FUSED) {                  \
        SIMD8 for (int i = 0; i < n; ++i) { \
            __VA_ARGS__                     \
        }                                   \
    } else {                                \
        SIMD for (int i = 0; i < n; ++i) {  \
            __VA_ARGS__                     \
        }                                   \
    }

// kernel interior_point.inside: x at least width / d inside its bounds, its distances w and v to
// them, and which unknowns move
//   compute    float64
//   bounds
//   reads      int8 unknown; D d
//   writes     float64 x, w, v; uint8 free
//   numbers    float64 unit, width
//   constants  UPPER = 0, FUSED = 0
const double none = (double)INFINITY;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double e = unit * (double)d[i], least_d = e < 0 ? -e : e,
                     size = least_d == 0 ? 1.0 : least_d, l = lower(i), u = upper(i);
        const bool moves = (unknown[i] == 1) & (l < u), low = moves & (l > -none),
                   high = moves & (u < none);
        const double span = u - l, below = x[i] - l, least = width / size,
                     c = below < least ? least : below, k0 = c < 0.5 * span ? c : 0.5 * span;
        free[i] = moves;
        if constexpr (UPPER) {
            const double above = u - x[i], o = above < least ? least : above,
                         g0 = o < 0.5 * span ? o : 0.5 * span;
            const bool near = below <= above;
            const double g = (low & near) ? span - k0 : g0, k = (high & !near) ? span - g0 : k0;
            w[i] = low ? k : none;
            v[i] = high ? g : none;
            x[i] = low ? l + k : (high ? u - g : x[i]);
        } else {
            w[i] = low ? k0 : none;
            x[i] = low ? l + k0 : x[i];
        }
    }
});

// kernel interior_point.multipliers: Multipliers s and t from the signs of y, at least `least`; the
// sum of w s and v t, and the number of multipliers
//   compute    float64
//   reads      float64 y, w, v
//   writes     float64 s, t
//   numbers    float64 least
//   sums       total, count
//   constants  UPPER = 0, FUSED = 0
const double none = (double)INFINITY;
double total = 0, count = 0;
SIMD for (int i = 0; i < n; ++i) {
    const bool low = w[i] < none;
    const double a = y[i] > least ? y[i] : least;
    s[i] = low ? a : 0.0;
    total += low ? w[i] * a : 0.0;
    count += low ? 1.0 : 0.0;
    if constexpr (UPPER) {
        const bool high = v[i] < none;
        const double c = -y[i] > least ? -y[i] : least;
        t[i] = high ? c : 0.0;
        total += high ? v[i] * c : 0.0;
        count += high ? 1.0 : 0.0;
    }
}

// kernel interior_point.condense: System of the next step: D = s / w + t / v, with A's diagonal
// only if FUSED, and the right-hand side
//   compute    float64
//   stencil    F, W
//   bounds
//   reads      float64 x, b; int8 unknown; uint8 free; float64 w, v, s, t
//   writes     Q D; S r
//   numbers    float64 scale, tau
//   sums       square, weighted
//   constants  UPPER = 0, FUSED = 0
#include "path_cells"
T square = 0, weighted = 0;
if constexpr (FUSED) {
    for (int begin = 0; begin < n; begin += M) {
        const int end = n - begin < M ? n : begin + (int)M;
        T y[M];
        fetch(begin, end, x + zp, b, r, D, d, unknown, free);
        SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
        with_bounds([&](auto lower, auto upper) {
            SIMD8 for (int i = begin; i < end; ++i) {
                const T e = diagonal(i), size = e != 0 ? e : (T)1, yi = y[i - begin];
                const T natural = unknown[i] == 1 ? natural_residual(yi, size * (x[i] - lower(i)),
                                                                     size * (x[i] - upper(i))) +
                                                        0.0 * x[i]
                                                  : (T)0;
                T shift = e + s[i] / w[i];
                if constexpr (UPPER) shift = shift + t[i] / v[i];
                const S diagonal = free[i] ? (S)shift : (S)0,
                        right = free[i] ? (S)(-scale * yi) : (S)0, root = right * right;
                D[i] = diagonal;
                r[i] = right;
                square += natural * natural;
                weighted += (T)(root / (diagonal > 0 ? diagonal : (S)1));
            }
        });
    }
} else {
    EACH_CELL(
        const double iw = 1.0 / w[i]; double sides = iw, shift = s[i] * iw; if constexpr (UPPER) {
            const double iv = 1.0 / v[i];
            sides = iw - iv;
            shift = s[i] * iw + t[i] * iv;
        } const double g = -affine(x, b, i) + tau * sides;
        D[i] = free[i] ? shift : 0.0; r[i] = free[i] ? scale * g : 0.0;)
}

// snippet path_direction: Directions ds and dt of the step dx = scale e + joined dp, on top of the
// predictor's dp = scale a. A product with an infinite w or v is 0. Macros, see snippet path_cells.
#define LOWER_DIRECTION                                                                       \
    const double dp = second * scale * (double)a[i], dx = scale * (double)e[i] + joined * dp; \
    const double iw = 1.0 / w[i], dsp = -s[i] - s[i] * iw * dp,                               \
                 ds = (tau - dp * dsp) * iw - s[i] - s[i] * iw * dx;
#define UPPER_DIRECTION                                         \
    const double iv = 1.0 / v[i], dtp = -t[i] + t[i] * iv * dp, \
                 dt = (tau + dp * dtp) * iv - t[i] + t[i] * iv * dx;
#include "path_cells"

// kernel interior_point.move: Move x, w, v, s and t along the direction; the sum of w s and v t
// there
//   compute    float64
//   bounds
//   reads      S a, e
//   writes     float64 x, w, v, s, t
//   numbers    float64 scale, second, joined, tau, length
//   sums       total
//   constants  UPPER = 0, FUSED = 0
#include "path_direction"
double total = 0;
fetch(0, n, w, s, x, e, a);
if constexpr (UPPER) fetch(0, n, v, t);
with_bounds([&](auto lower, auto upper) {
    if constexpr (UPPER) {
        EACH_CELL(
            LOWER_DIRECTION UPPER_DIRECTION const double wn = w[i] + length * dx,
            sn = s[i] + length * ds, vn = v[i] - length * dx, tn = t[i] + length * dt;
            const double below = lower(i) + wn, free = x[i] + length * dx, above = upper(i) - vn;
            x[i] = vn < wn ? above : (wn < (double)INFINITY ? below : free);
            total += (sn > 0 ? wn * sn : 0.0) + (tn > 0 ? vn * tn : 0.0); w[i] = wn; s[i] = sn;
            v[i] = vn; t[i] = tn;)
    } else {
        EACH_CELL(LOWER_DIRECTION const double wn = w[i] + length * dx, sn = s[i] + length * ds,
                  below = lower(i) + wn, free = x[i] + length * dx;
                  x[i] = wn < (double)INFINITY ? below : free; total += sn > 0 ? wn * sn : 0.0;
                  w[i] = wn; s[i] = sn;)
    }
});

// kernel interior_point.ratios: Reciprocal of the longest step that keeps w, v, s and t positive,
// and the sum of dw ds + dv dt
//   compute    float64
//   reads      S a, e; float64 w, v, s, t
//   whole      float64 longest
//   numbers    float64 scale, second, joined, tau
//   sums       products
//   constants  UPPER = 0, FUSED = 0
#include "path_direction"
long long most = 0;
double products = 0;
// The bits of positive numbers have the order of these numbers; compilers vectorize only this form.
const auto note = [&](double m) {
    const double positive = m > 0 ? m : 0.0;
    const long long bits = __builtin_bit_cast(long long, positive);
    most = bits > most ? bits : most;
};
fetch(0, n, w, s, e);
if constexpr (UPPER) fetch(0, n, v, t);
if (FUSED && second == 0) {  // the predictor: ds = -s (1 + dx / w), dt = -t (1 - dx / v)
    EACH_CELL(
        const double dx = scale * (double)e[i], q = dx / w[i], next = s[i] > 0 ? 1 + q : 0.0,
        m = -q > next ? -q : next;
        if constexpr (UPPER) {
            const double o = dx / v[i], last = t[i] > 0 ? 1 - o : 0.0, k = o > last ? o : last;
            note(m > k ? m : k);
            products += dx * (t[i] * (1 - o) - s[i] * (1 + q));
        } else {
            note(m);
            products += dx * (-s[i] * (1 + q));
        })
} else if constexpr (UPPER) {
    EACH_CELL(LOWER_DIRECTION UPPER_DIRECTION const double first = -dx * iw,
              next = s[i] > 0 ? -ds / s[i] : 0.0, m = first > next ? first : next;
              const double third = dx * iv, last = t[i] > 0 ? -dt / t[i] : 0.0,
              k = third > last ? third : last;
              note(m > k ? m : k); products += dx * ds - dx * dt;)
} else {
    EACH_CELL(LOWER_DIRECTION const double first = -dx * iw, next = s[i] > 0 ? -ds / s[i] : 0.0,
              m = first > next ? first : next;
              note(m); products += dx * ds;)
}
make_at_least(longest, __builtin_bit_cast(double, most));

// kernel interior_point.center: Right-hand side of the corrector: the remainder of the predictor's,
// and the terms of second order; a keeps the predictor's e
//   compute    float64
//   reads      S e; float64 y?; uint8 free; S D?; float64 w, v, s, t
//   writes     S a, r
//   numbers    float64 scale, tau; bool carried
//   sums       weighted
//   constants  UPPER = 0, FUSED = 0
#include "path_cells"
const double inverse = 1 / scale;
double weighted = 0;
fetch(0, n, w, s, e, r, a);
EACH_CELL(
    const double dp = scale * (double)e[i], iw = 1.0 / w[i], dsp = -s[i] - s[i] * iw * dp;
    double g = (tau - dp * dsp) * iw; if constexpr (UPPER) {
        const double iv = 1.0 / v[i], dtp = -t[i] + t[i] * iv * dp;
        g = (tau - dp * dsp) * iw - (tau + dp * dtp) * iv;
    } a[i] = e[i];
    if constexpr (FUSED) {
        const S at = D[i], now = at != 0 ? (S)((double)r[i] + g * inverse) : r[i];
        r[i] = now;
        weighted += (double)(now * now / (at > 0 ? at : (S)1));
    } else {
        const double old = carried ? (double)r[i] : -y[i] / scale;
        r[i] = free[i] ? old + g / scale : 0.0;
    })
