// Kernels of active sets and of the systems of their free unknowns.

// kernel active_set.classify: Free set of the minimum map: unknowns with x - y / d within the
// bounds. The others move onto their bounds; g = -scale y on the free set
//   compute    float64
//   stencil    D, W
//   bounds
//   reads      int8 unknown
//   writes     float64 x; uint8 free; S g
//   numbers    float64 scale
//   sums       moved, active, shifted, square
T moved = 0, active = 0, shifted = 0, square = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const T a = diagonal(k), f = a < 0 ? -a : a, e = f == 0 ? (T)1 : f, v = x[k] - known[k] / e,
                l = lower(k), u = upper(k);
        const bool low = v<l, high = v> u, inside = unknown[k] == 1, held = inside & (low | high);
        const unsigned char now = inside & !held;
        const T at = held ? (low ? l : u) : x[k], y = now ? known[k] : (T)0;
        shifted += at != x[k] ? (T)1 : (T)0;
        x[k] = at;
        g[k] = (S)(-y * scale);
        square += y * y;
        moved += now != free[k] ? (T)1 : (T)0;
        active += held ? (T)1 : (T)0;
        free[k] = now;
    }
});

// kernel active_set.all_free: All unknowns are free
//   compute    float64
//   reads      int8 unknown
//   writes     uint8 free
SIMD64 for (int k = 0; k < n; ++k) free[k] = unknown[k] == 1;

// kernel active_set.on_free: g = -scale y on the free set, 0 elsewhere; the sum of y^2 on the free
// set
//   compute    float64
//   reads      float64 y; uint8 free
//   writes     S g
//   numbers    float64 scale
//   sums       square
T square = 0;
SIMD for (int k = 0; k < n; ++k) {
    const T v = free[k] ? y[k] : (T)0;
    g[k] = (S)(free[k] ? -y[k] * scale : (T)0);
    square += v * v;
}

// kernel active_set.step: `along` = z + beta `along` if z is given; `to` = x + step `along`,
// clipped to the bounds where `along` is not 0. With `guarded`, x stays where the step is not
// finite. `kept` receives x.
//   compute    float64
//   bounds
//   reads      float64 x?; S z?
//   writes     S along; float64 to?, kept?
//   numbers    float64 beta, step; bool guarded
const S part = (S)beta;
const bool fresh = part == 0, open = !guarded;
// two roundings, because of the selection
if (z && (to || fresh))
    SIMD for (int k = 0; k < n; ++k) along[k] = fresh ? z[k] : z[k] + part * along[k];
else if (z)
    SIMD for (int k = 0; k < n; ++k) along[k] = z[k] + part * along[k];  // one rounding
if (kept) SIMD8 for (int k = 0; k < n; ++k) kept[k] = x[k];
if (to)
    with_bounds([&](auto lower, auto upper) {
        SIMD8 for (int k = 0; k < n; ++k) {
            const T v = x[k] + step * (T)along[k], c = clipped(v, lower(k), upper(k));
            to[k] = ((along[k] != 0) & (open | (v - v == 0))) ? c : x[k];
        }
    });

// kernel principal_system.shift: diagonal = unit d + shift on the free set, 0 elsewhere; weight = 1
// / |diagonal|, 1 where the diagonal is 0, 0 off the free set
//   compute    S
//   reads      D d; uint8 free; float64 shift?
//   writes     S diagonal, weight
//   numbers    float64 unit
if (shift) {
    SIMD for (int k = 0; k < n; ++k) diagonal[k] =
        free[k] ? (T)(unit * (double)d[k] + shift[k]) : (T)0;
} else {
    SIMD for (int k = 0; k < n; ++k) diagonal[k] = free[k] ? (T)(unit * (double)d[k]) : (T)0;
}
SIMD for (int k = 0; k < n; ++k) {
    const T a = diagonal[k] < 0 ? -diagonal[k] : diagonal[k];
    weight[k] = a > 0 ? (T)1 / a : (T)(free[k] != 0);
}

// kernel principal_system.mask: q + D direction on the free set, 0 elsewhere
//   compute    float64
//   reads      float64 direction; uint8 free; float64 shift?
//   writes     float64 q
if (shift) {
    SIMD for (int k = 0; k < n; ++k) {
        EXACT_MATH const double v = shift[k] * direction[k], s = q[k] + v;
        q[k] = free[k] ? s : 0.0;
    }
} else {
    SIMD for (int k = 0; k < n; ++k) q[k] = free[k] ? q[k] : 0.0;
}

// kernel principal_system.divide: z = r / d; z = r where d is 0
//   compute    float64
//   reads      float64 r, d
//   writes     float64 z
SIMD for (int k = 0; k < n; ++k) {
    const double v = r[k] / d[k];
    z[k] = d[k] != 0 ? v : r[k];
}

// kernel equilibrated.units: Multiply a field by units, or divide it. Units are powers of 2, so
// that nothing is rounded; infinities do not change
//   compute    float64
//   reads      float64 x, units
//   writes     float64 scaled
//   numbers    bool inverse
SIMD for (int k = 0; k < n; ++k) {
    const double times = x[k] * units[k], over_ = x[k] / units[k];
    scaled[k] = inverse ? over_ : times;
}
