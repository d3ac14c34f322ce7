// Every unknown is free.
SIMD64 for (int k = 0; k < n; ++k) free[k] = unknown[k] == 1;
