SIMD64 for (int k = 0; k < n; ++k) changed[k] = 0;
