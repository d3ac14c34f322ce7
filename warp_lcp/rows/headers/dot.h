double ab = 0;
SIMD for (int k = 0; k < n; ++k) ab += (double)a[k]*(double)b[k];
