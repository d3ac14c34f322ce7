// Copies between vectors of PETSc and fields.

// kernel vector_copies.enter: Copy a vector into a field: x = scale v. Rows with diagonal 0 are no
// unknowns and get 0.
//   compute    S
//   reads      D d
//   writes     S x
//   other      float64 v
//   numbers    float64 scale
SIMD for (int k = 0; k < n; ++k) {
    const T e = (T)(scale * v[k]);
    x[k] = d[k] != 0 ? e : (T)0;
}

// kernel vector_copies.leave: Copy a field into a vector: v = scale x. Rows with diagonal 0 get the
// value of the vector `others`, or 0 if there is none.
//   compute    S
//   reads      D d; S x
//   other      float64 v, others?
//   numbers    float64 scale
if (others) {
    SIMD for (int k = 0; k < n; ++k) {
        const double e = scale * (double)x[k], held = others[k];
        v[k] = d[k] != 0 ? e : held;
    }
} else {
    SIMD for (int k = 0; k < n; ++k) {
        const double e = scale * (double)x[k];
        v[k] = d[k] != 0 ? e : 0.0;
    }
}
