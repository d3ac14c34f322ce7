SIMD64 for (int k = 0; k < n; ++k) x[k] = 0;
