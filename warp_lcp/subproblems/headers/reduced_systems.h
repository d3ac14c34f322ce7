// Kernels of reduced systems: active sets and the systems of their free unknowns, conjugate
// gradients on a grid in fused passes, the Woodbury preconditioner for a term of low rank.

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
// finite. `saved_x` receives x.
//   compute    float64
//   bounds
//   reads      float64 x?; S z?
//   writes     S along; float64 to?, saved_x?
//   numbers    float64 beta, step; bool guarded
const S part = (S)beta;
const bool fresh = part == 0, open = !guarded;
// two roundings, because of the selection
if (z && (to || fresh))
    SIMD for (int k = 0; k < n; ++k) along[k] = fresh ? z[k] : z[k] + part * along[k];
else if (z)
    SIMD for (int k = 0; k < n; ++k) along[k] = z[k] + part * along[k];  // one rounding
if (saved_x) SIMD8 for (int k = 0; k < n; ++k) saved_x[k] = x[k];
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

// kernel grid_conjugate_gradient.direct: Direction q = z + beta q
//   compute    S
//   reads      S z
//   writes     S q
//   whole      float64 scalars
//   constants  BETA
const S beta = (S)scalars[BETA];
fetch(0, n, z, q);
if (beta == 0) {
    SIMD for (int k = 0; k < n; ++k) q[k] = z[k];
} else {
    SIMD for (int k = 0; k < n; ++k) q[k] = z[k] + beta * q[k];
}

// kernel grid_conjugate_gradient.step: Move x along the direction q, subtract A q from the
// residual; the residual's square, weighted by 1 / d or not
//   compute    S
//   stencil    F, S
//   reads      S q
//   writes     S x, r
//   whole      float64 scalars
//   numbers    bool weighted
//   sums       square
//   constants  STEP, ITERATIONS
const S alpha = (S)scalars[STEP];
T square = 0;
fetch(0, n, x, r);
const auto each = [&](auto from, auto weigh) {
    SIMD for (int k = 0; k < n; ++k) {
        const T c = diagonal(k), w = r[k] - alpha * product(q, k);
        x[k] = from(k) + alpha * q[k];
        r[k] = w;
        square += w * w * weigh(c);
    }
};
const auto one = [](T) { return (T)1; };
const auto zero = [](int) { return (T)0; };
const auto old = [&](int k) { return x[k]; };
const auto inverse = [](T c) {
    const T a = c < 0 ? -c : c;
    return (T)1 / (a > 0 ? a : (T)1);
};
if (scalars[ITERATIONS] == 0) {
    if (weighted)
        each(zero, inverse);
    else
        each(zero, one);
} else {
    if (weighted)
        each(old, inverse);
    else
        each(old, one);
}

// kernel low_rank_correction.squares: Diagonal of U'U on the unknowns, then the rows of each block
//   compute    float64
//   whole      int32 entry_rows, blocks; V values; int32 count; D d; float64 squares
//   numbers    int width, rank
//   by_cell
for (int q = 0; q < rank + rank / width; ++q) squares[q] = 0;
for (int e = 0; e < count[0]; ++e) {
    if (d[entry_rows[e]] == 0) continue;
    squares[rank + blocks[e]] += 1;
    for (int q = 0; q < width; ++q) {
        EXACT_MATH const double u = (double)values[(long long)e * width + q];
        squares[blocks[e] * width + q] += u * u;
    }
}

// kernel low_rank_correction.squares_by_turns: As low_rank_correction.squares, by many threads, a
// column of sums each
//   compute    float64
//   whole      int32 entry_rows, blocks; V values; int32 count; D d
//   numbers    int width, rank
//   sums       first
//   by_cell
double* sums = given.out.data + P.t;
const int last = count[0], all = rank + rank / width;
if (!P.more)
    for (int q = 0; q < all; ++q) sums[q * places] = 0;
for (int k = 0; k < n && p + k < last; ++k) {
    const long long e = p + k;
    if (d[entry_rows[e]] == 0) continue;
    sums[(rank + blocks[e]) * places] += 1;
    for (int q = 0; q < width; ++q) {
        EXACT_MATH const double u = (double)values[e * width + q];
        sums[((long long)blocks[e] * width + q) * places] += u * u;
    }
}
const double first = P.more ? 0 : sums[0];

// kernel low_rank_correction.dots: Products of r with the fields in slots, a column of sums each
//   compute    S
//   reads      S r
//   whole      S Z
//   numbers    int slots; int64 size
//   sums       first
//   by_cell
T first = 0;
for (int s = 0; s < slots; ++s) {
    const T* v = Z + s * size + p;
    double* column = given.out.data + s * places + P.t;
    T sum = 0;
    SIMD for (int k = 0; k < n; ++k) sum += v[k] * r[k];
    if (s == 0)
        first = sum;
    else
        *column = P.more ? *column + (double)sum : (double)sum;
}

// kernel low_rank_correction.subtract: z -= sum_s factors_s Z_s on the unknowns
//   compute    S
//   reads      D d
//   writes     S z
//   whole      S Z; float64 factors
//   numbers    int slots; int64 size
//   by_cell
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M;
    T sum[M];
    SIMD for (int k = begin; k < end; ++k) sum[k - begin] = 0;
    for (int s = 0; s < slots; ++s) {
        const T f = (T)factors[s];
        const T* v = Z + s * size + p;
        SIMD for (int k = begin; k < end; ++k) sum[k - begin] += f * v[k];
    }
    SIMD for (int k = begin; k < end; ++k) {
        const T v = z[k] - sum[k - begin];
        z[k] = d[k] != 0 ? v : z[k];
    }
}
