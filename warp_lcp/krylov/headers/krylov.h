// Kernels of Krylov methods: conjugate gradients and GMRES.

// kernel krylov.norm: r'r, or with weights r'W r
//   compute    S
//   reads      S r, w?
//   sums       rr
double rr = 0;
if (w) {
    SIMD for (int k = 0; k < n; ++k) rr += (double)w[k] * r[k] * r[k];
} else {
    SIMD for (int k = 0; k < n; ++k) rr += (double)r[k] * (double)r[k];
}

// kernel conjugate_gradient.direction: direction = z + beta direction, beta = r'z / (r'z)_old
//   compute    S
//   reads      S z
//   writes     S direction
//   whole      float64 scalars
//   constants  RZ, RZ_OLD, PQ
const T beta = scalars[RZ_OLD] > 0 ? (T)(scalars[RZ] / scalars[RZ_OLD]) : (T)0;
SIMD for (int k = 0; k < n; ++k) direction[k] = z[k] + beta * direction[k];

// kernel conjugate_gradient.update: x += alpha direction, r -= alpha q, alpha = r'z / direction'q;
// r'r of the new r, or with weights r'W r
//   compute    S
//   reads      S direction, q, w?
//   writes     S x, r
//   whole      float64 scalars
//   sums       rr
//   constants  RZ, RZ_OLD, PQ
const T alpha = scalars[PQ] > 0 ? (T)(scalars[RZ] / scalars[PQ]) : (T)0;
double rr = 0;
const auto update = [&](auto weight) {
    SIMD for (int k = 0; k < n; ++k) {
        const T v = r[k] - alpha * q[k];
        x[k] += alpha * direction[k];
        r[k] = v;
        rr += weight(k) * v * v;
    }
};
if (w)
    update([&](int k) { return (double)w[k]; });
else
    update([](int) { return 1.0; });

// kernel gmres.residual: q = w^(1/2) (b - q); w = 1 without weights
//   compute    S
//   reads      S b, w?
//   writes     S q
if (w) {
    SIMD for (int k = 0; k < n; ++k) q[k] = sqrt(w[k]) * (b[k] - q[k]);
} else {
    SIMD for (int k = 0; k < n; ++k) q[k] = b[k] - q[k];
}

// kernel gmres.weigh: q = w^(1/2) q; `inverse`: q = w^(-1/2) q
//   compute    S
//   reads      S w
//   writes     S q
//   numbers    bool inverse
if (inverse) {
    SIMD for (int k = 0; k < n; ++k) q[k] = w[k] > 0 ? q[k] / sqrt(w[k]) : 0;
} else {
    SIMD for (int k = 0; k < n; ++k) q[k] *= sqrt(w[k]);
}

// kernel gmres.weighed: q = w^(1/2) r; q'q
//   compute    S
//   reads      S r, w
//   writes     S q
//   sums       qq
double qq = 0;
SIMD for (int k = 0; k < n; ++k) {
    q[k] = sqrt(w[k]) * r[k];
    qq += (double)q[k] * q[k];
}

// kernel gmres.load: r = w^(-1/2) times a field of a basis
//   compute    S
//   reads      S w
//   writes     S r
//   whole      S basis
//   numbers    int64 size, place
//   by_cell
const auto* v = basis + place * size + p;
SIMD for (int k = 0; k < n; ++k) r[k] = w[k] > 0 ? v[k] / sqrt(w[k]) : 0;

// kernel gmres.keep: Store z as a field of a basis; q = w^(1/2) q
//   compute    S
//   reads      S w, z
//   writes     S q
//   whole      S basis
//   numbers    int64 size, place
//   by_cell
auto* v = basis + place * size + p;
SIMD for (int k = 0; k < n; ++k) {
    v[k] = z[k];
    q[k] *= sqrt(w[k]);
}

// kernel gmres.dots: Products v_j'x of the first fields of a basis with x, a column of sums each
//   compute    S
//   reads      S x
//   whole      S basis
//   numbers    int64 size; int count
//   sums       first
//   by_cell
double first = 0;
for (int j = 0; j < count; ++j) {
    const auto* v = basis + j * size + p;
    double vx = 0, *sum = given.out.data + j * places + P.t;
    SIMD for (int k = 0; k < n; ++k) vx += (double)v[k] * x[k];
    if (j == 0)
        first = vx;
    else
        *sum = P.more ? *sum + vx : vx;
}

// kernel gmres.column: Store the sums of an iteration as a column of H
//   compute    float64
//   reads      float64 sums
//   whole      float64 columns
//   numbers    int64 size, place
//   by_cell
auto* column = columns + place * size + p;
for (int k = 0; k < n; ++k) column[k] = sums[k];

// kernel gmres.combine: x += sign times sum_j factors_j v_j; x'x
//   compute    S
//   writes     S x
//   whole      S basis; float64 factors
//   numbers    int64 size; int count; float64 sign
//   sums       xx
//   by_cell
for (int j = 0; j < count; ++j) {
    const auto* v = basis + j * size + p;
    const T c = (T)(sign * factors[j]);
    SIMD for (int k = 0; k < n; ++k) x[k] += c * v[k];
}
double xx = 0;
SIMD for (int k = 0; k < n; ++k) xx += (double)x[k] * x[k];

// kernel gmres.store: Store x / sqrt(x'x) as a field of a basis; 0 if x'x = 0
//   compute    S
//   reads      S x
//   whole      S basis; float64 sums
//   numbers    int64 size, place; int last
//   by_cell
auto* v = basis + place * size + p;
const double xx = sums[last], scale = xx > 0 ? 1.0 / sqrt(xx) : 0.0;
SIMD for (int k = 0; k < n; ++k) v[k] = scale * x[k];
