SIMD for (int k = 0; k < n; ++k) to[k] = source[k];
