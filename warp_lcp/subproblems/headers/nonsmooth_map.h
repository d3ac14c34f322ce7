// Kernels of nonsmooth Newton methods: maps, derivatives and steps. Constants say which
// parts of the maps a problem needs; other parts are not computed.

// snippet map_numbers: Type R of a map's values, its constants, and a square root that is
// vectorized in this type.
#if FUSED
typedef S R;
const R part = (R)share, over_b = (R)(over / scale), tiny = (R)(kinks * scale);
#else
typedef double R;
const R part = share, over_b = over, tiny = kinks;
#endif
const auto root = [](R v) -> R {
#ifdef __CUDA_ARCH__
    return sqrt(v);
#else
    if constexpr (sizeof(R) == 4)
        return (R)__builtin_sqrtf((float)v);
    else
        return sqrt(v);
#endif
};

// snippet fischer: f, p, q and the kink of a row, from the values of `map`. The Fischer-Burmeister
// function is psi(a, b) = a + b - rho, rho = sqrt(a^2 + b^2), here of a and h = -psi(-w, c). Its
// derivatives are 1 - a / rho and 1 - b / rho, penalized or not. Forms without cancellation are 2 a
// b / (a + b + rho) and b^2 / (rho (rho + a)). HOST: rho^2 is greater by 2 mu, and a derivative is
// 0 where b is below the rounding error of a, so that factorizations detect a singular Jacobian.
#if HOST
#define SMOOTHED(v) ((v) + twice_mu)
#define LOWERED(v) ((v) - twice_mu)
const bool exact = false;
#else
#define SMOOTHED(v) (v)
#define LOWERED(v) (v)
const bool exact = true;
#endif
const R c0 = c > 0 ? c : (R)0, w0 = -w > 0 ? -w : (R)0;
#if UPPER
const R e = root(SMOOTHED(w * w + c * c)), es = e > tiny ? e : (R)1, n = c - w;
const R below = n > 0 ? LOWERED(-2 * w * c) / (n + e) : n - e, h = high ? -below : w;
const bool kink2 = high & (e <= tiny);
const R p2 =
    high ? (kink2 ? kp : ((exact & (c > 0)) ? w * w / (es * (es + c0)) : 1 - c / es)) : (R)0;
const R q2 =
    high ? (kink2 ? kq : ((exact & (w < 0)) ? c * c / (es * (es + w0)) : 1 + w / es)) : (R)1;
#else
const R h = w, p2 = 0, q2 = 1;
const bool kink2 = false;
#endif
const R rho = root(SMOOTHED(a * a + h * h)), rs = rho > tiny ? rho : (R)1, t = a + h;
const R a0 = a > 0 ? a : (R)0, h0 = h > 0 ? h : (R)0;
const bool kink1 = low & (rho <= tiny), flat1 = exact & (a > 0), flat2 = exact & (h > 0);
const R f1 = low ? (t > 0 ? LOWERED(2 * a * h) : t - rho) / (t > 0 ? t + rho : (R)1) : h;
const R p1 = low ? (kink1 ? kp : (flat1 ? h * h : rs - a) / (rs * (flat1 ? rs + a0 : (R)1))) : (R)0;
const R q1 = low ? (kink1 ? kq : (flat2 ? a * a : rs - h) / (rs * (flat2 ? rs + h0 : (R)1))) : (R)1;
const bool kink = inside & (kink1 | kink2);
#if PENALIZED
const R yp = w > 0 ? w : (R)0, g = (1 - part) * over_b;
const R extra = (low ? a0 * yp : (R)0) - (high ? c0 * w0 : (R)0);
const R ep = ((low & (a > 0)) ? yp : (R)0) + ((high & (c > 0)) ? w0 : (R)0);
const R eq = ((low & (w > 0)) ? a0 : (R)0) + ((high & (w < 0)) ? c0 : (R)0);
const R f = inside ? part * f1 + g * extra : (R)0;
const R p = part * (p1 + q1 * p2) + g * ep, q = part * q1 * q2 + g * eq;
#else
const R f = inside ? f1 : (R)0, p = p1 + q1 * p2, q = q1 * q2;
#endif
#undef SMOOTHED
#undef LOWERED

// snippet map: f, p, q of cell i, whether it has a kink, and the values that these are computed
// from; R is their type. FUSED: in units of `scale`, which makes them of order one; the map is free
// of cancellation.
#if FUSED
const double at_ = diagonal(i), size = at_ != 0 ? at_ : 1.0, low_ = lower(i), high_ = upper(i),
             value = y[i - begin];
const bool inside = unknown[i] == 1,
           low = low_ > -(double)INFINITY, high = high_ < (double)INFINITY;
const double below_ = size * (x[i] - low_), above_ = size * (x[i] - high_);
const double natural = inside ? natural_residual(value, below_, above_) + 0.0 * x[i] : 0.0;
square += natural * natural;
const R w = (R)(scale * value), a = low ? (R)(scale * below_) : (R)0,
        c = high ? (R)(-scale * above_) : (R)0;
#else
const double at_ = unit * (double)d[i], above_ = at_ < 0 ? -at_ : at_,
             size = above_ == 0 ? 1.0 : above_, low_ = lower(i), high_ = upper(i);
const bool inside = unknown[i] == 1,
           low = low_ > -(double)INFINITY, high = high_ < (double)INFINITY;
const R a = low ? size * (x[i] - low_) : 0.0, c = high ? size * (high_ - x[i]) : 0.0, w = y[i];
#endif
#if RANDOM  // element of the unit disc's first quadrant for each kink, from a hash of its index
const unsigned long long z0 = ((unsigned long long)(p + i) + seed) * 0x9E3779B97F4A7C15ull,
                         z1 = (z0 ^ (z0 >> 29)) * 0xBF58476D1CE4E5B9ull;
const R first = (double)(unsigned int)(z1 >> 32) * 2.3283064365386963e-10;
const R second =
    (double)(unsigned int)((z1 * 0x94D049BB133111EBull) >> 32) * 2.3283064365386963e-10;
const R kp = 1 - 0.7071067811865476 * first, kq = 1 - 0.7071067811865476 * second;
#else
const R kp = (R)0, kq = (R)1;
#endif
#if NATURAL
const R least = (low & (a < w)) ? a : w;
const bool top = high & (-c > least), bottom = low & (a < w), kink = false;
const R f = inside ? (top ? -c : least) : (R)0, p = (top | bottom) ? (R)1 : (R)0, q = (R)1 - p;
#else
#include "fischer"
#endif

// kernel nonsmooth_map.merit: Sum of f^2
//   compute    float64
//   bounds
//   reads      float64 x, y; int8 unknown; D d
//   numbers    float64 share, over, kinks; int64 seed; float64 unit
//   sums       merit
//   constants  NATURAL = 0, UPPER = 0, PENALIZED = 0, RANDOM = 0, FUSED = 0
#include "map_numbers"
double merit = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
#include "map"
        merit += f * f;
    }
});

// kernel nonsmooth_map.values: Values f of the map
//   compute    float64
//   bounds
//   reads      float64 x, y; int8 unknown; D d
//   writes     float64 values
//   numbers    float64 share, over, kinks; int64 seed; float64 unit
//   constants  NATURAL = 0, UPPER = 0, PENALIZED = 0, RANDOM = 0, FUSED = 0
#include "map_numbers"
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
#include "map"
        values[i] = f;
    }
});

// kernel nonsmooth_map.condense: Newton's system over q: D = d p / q, added to A's diagonal if
// FUSED, and the right-hand side -scale f / q. Sums of f^2, of the natural residual, and of the
// right-hand side in the norm of its system.
//   compute    float64
//   bounds
//   reads      float64 x, y; int8 unknown; D d
//   writes     float64 D; S r; uint8 free
//   numbers    float64 share, over, kinks; int64 seed; float64 unit, scale, least; bool drop
//   sums       merit
//   constants  NATURAL = 0, UPPER = 0, PENALIZED = 0, RANDOM = 0, FUSED = 0
#include "map_numbers"
#if FUSED
double square = 0;
S merit = 0, weighted = 0;
const S least_q = (S)least;
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M;
    T y[M];
    fetch(begin, end, x + zp, b, r, D, d, unknown);
    SIMD8 for (int k = begin; k < end; ++k) y[k - begin] = affine(x, b, k);
    with_bounds([&](auto lower, auto upper) {
        SIMD for (int i = begin; i < end; ++i) {
#include "map"
            const S qs = q > least_q ? q : least_q, inverse = (S)1 / qs;
            const bool solved = inside & !(drop & kink);
            const S shifted = solved ? (S)at_ + (S)size * p * inverse : (S)0,
                    right = solved ? -f * inverse : (S)0;
            merit += f * f;
            D[i] = shifted;
            r[i] = right;
            weighted += right * right / (shifted > 0 ? shifted : (S)1);
        }
    });
}
#else
double merit = 0, square = 0, weighted = 0;
const double least_q = least;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
#include "map"
        const double qs = q > least_q ? q : least_q;
        const bool solved = inside & !(drop & kink);
        merit += f * f;
        D[i] = solved ? size * p / qs : 0.0;
        r[i] = solved ? -scale * f / qs : 0.0;
        free[i] = solved;
    }
});
#endif

// kernel nonsmooth_map.condense_at_rows: As nonsmooth_map.condense, with y = A x + b computed in
// the same pass
//   compute    float64
//   stencil    F, W
//   bounds
//   reads      float64 x, b; int8 unknown
//   writes     S D, r
//   numbers    float64 share, over, kinks; int64 seed; float64 scale, least; bool drop
//   sums       square, merit, weighted
//   constants  NATURAL = 0, UPPER = 0, PENALIZED = 0, RANDOM = 0, FUSED = 1
#include "nonsmooth_map.condense"

// kernel nonsmooth_map.weighted: d p f and q f, the parts of the gradient, and the sum of f^2
//   compute    float64
//   bounds
//   reads      float64 x, y; int8 unknown; D d
//   writes     float64 by_x, by_y
//   numbers    float64 share, over, kinks; int64 seed; float64 unit
//   sums       merit
//   constants  NATURAL = 0, UPPER = 0, PENALIZED = 0, RANDOM = 0, FUSED = 0
#include "map_numbers"
double merit = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
#include "map"
        by_x[i] = inside ? size * p * f : 0.0;
        by_y[i] = inside ? q * f : 0.0;
        merit += f * f;
    }
});

// kernel nonsmooth_map.gradient: Gradient over d^2, from its stored part and A' q f; its square
// over d, and its product with the previous gradient
//   compute    float64
//   reads      float64 product, last; int8 unknown; D d
//   writes     float64 gradient
//   numbers    float64 unit
//   sums       square, inner
double square = 0, inner = 0;
SIMD for (int i = 0; i < n; ++i) {
    const double e = unit * (double)d[i], least = e < 0 ? -e : e, size = least == 0 ? 1.0 : least;
    const double g = unknown[i] == 1 ? (gradient[i] + product[i]) / size : 0.0;
    gradient[i] = g / size;
    square += g * g;
    inner += g * size * last[i];
}

// kernel nonsmooth_map.advance: x = base + scale e, clipped to the bounds if projected
//   compute    float64
//   bounds
//   reads      float64 base; S e; int8 unknown
//   writes     float64 x
//   numbers    float64 scale; bool projected
if (projected)
    with_bounds([&](auto lower, auto upper) {
        SIMD for (int i = 0; i < n; ++i) {
            const double v = base[i] + scale * (double)e[i], c = clipped(v, lower(i), upper(i));
            x[i] = unknown[i] == 1 ? c : 0.0;
        }
    });
else
    SIMD for (int i = 0; i < n; ++i) x[i] = base[i] + scale * (double)e[i];

// kernel nonsmooth_map.move: x += step e
//   compute    float64
//   reads      S e
//   writes     float64 x
//   numbers    float64 step
fetch(0, n, x, e);
SIMD8 for (int k = 0; k < n; ++k) x[k] += step * (double)e[k];

// kernel nonsmooth_map.host: f, p, q and the kink of rows first <= i < last on the host. `reals`
// holds x, y, d, the bounds, and the element (kp, kq) that is used at each kink.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 value, by_x, by_y, kinked
//   numbers    int count; float64 share, over, kinks, twice_mu
//   constants  UPPER = 1, PENALIZED = 1, HOST = 1, FUSED = 0
EXACT_MATH
#include "map_numbers"
const double *x = reals, *y = x + count, *d = y + count, *lower = d + count, *upper = lower + count,
             *element = upper + count;
for (int i = first; i < last; ++i) {
    const bool inside = true, low = lower[i] > -(double)INFINITY,
               high = upper[i] < (double)INFINITY;
    const R a = low ? d[i] * (x[i] - lower[i]) : 0.0, c = high ? d[i] * (upper[i] - x[i]) : 0.0,
            w = y[i];
    const R kp = element[i], kq = element[count + i];
#include "fischer"
    value[i] = f;
    by_x[i] = p;
    by_y[i] = q;
    kinked[i] = kink;
}

// kernel finite_difference.difference: Difference quotient: over (q - f) on the free unknowns, 0
// elsewhere
//   compute    float64
//   reads      uint8 free; float64 f
//   writes     float64 q
//   numbers    float64 over
SIMD for (int k = 0; k < n; ++k) {
    const double v = over * (q[k] - f[k]);
    q[k] = free[k] ? v : 0.0;
}

// kernel finite_difference.scale: z = r / |d|; z = r where d is 0
//   compute    float64
//   reads      float64 r, d
//   writes     float64 z
SIMD for (int k = 0; k < n; ++k) {
    const double v = r[k] / (d[k] < 0 ? -d[k] : d[k]);
    z[k] = d[k] != 0 ? v : r[k];
}
