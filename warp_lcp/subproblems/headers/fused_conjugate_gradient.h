// Kernels of conjugate gradients on a grid in fused passes.

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
