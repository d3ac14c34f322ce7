// Kernels of vectors.

// kernel vectors.dot: Dot product a'b
//   compute    float64
//   reads      A a; B b
//   sums       ab
double ab = 0;
SIMD for (int k = 0; k < n; ++k) ab += (double)a[k] * (double)b[k];

// kernel vectors.add: x += z
//   compute    S
//   reads      S z
//   writes     S x
SIMD for (int k = 0; k < n; ++k) x[k] += z[k];

// snippet add_up: Sum of every `stride`-th of n partial sums, from `start` on.
const double* v = partials.data + offset;
double s = 0;
if (stride == 1) {
    SIMD8 for (int i = start; i < n; ++i) s += v[i];
} else {
    int i = start;
    // Eight loads at a time, so that a thread of a GPU waits once for all; added in their order.
    for (; i + 7 * (long long)stride < n; i += 8 * stride) {
        double a[8];
        for (int k = 0; k < 8; ++k) a[k] = v[i + k * stride];
        for (int k = 0; k < 8; ++k) s += a[k];
    }
    for (; i < n; i += stride) s += v[i];
}
return s;

// kernel vectors.add_up: Sums of the columns of partial sums
//   compute    float64
//   whole      float64 partials, scalars
//   numbers    int count, slot
//   module     problem
//   by_cell
for (int k = 0; k < n; ++k) {
    const double* v = partials + (P.first + k) * (long long)count;
    double s = 0;
    SIMD8 for (int i = 0; i < count; ++i) s += v[i];
    scalars[slot + P.first + k] = s;
}

// kernel vectors.convert: b = a, converted to another type
//   compute    B
//   reads      A a
//   writes     B b
SIMD for (int k = 0; k < n; ++k) b[k] = a[k];
