SIMD for (int k = 0; k < n; ++k) b[k] = a[k];
