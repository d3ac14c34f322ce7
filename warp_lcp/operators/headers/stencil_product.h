// y = A x, or A x + b.
if (b) SIMD for (int k = 0; k < n; ++k) y[k] = affine(x, b, k);
else SIMD for (int k = 0; k < n; ++k) y[k] = product(x, k);
