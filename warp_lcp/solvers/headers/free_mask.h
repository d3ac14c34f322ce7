// 1 where the masked diagonal is not 0.
SIMD for (int k = 0; k < n; ++k) mask[k] = free[k] != 0;
