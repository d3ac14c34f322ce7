// q = w^(1/2) (b - q); without weights they are 1
if (w) { SIMD for (int k = 0; k < n; ++k) q[k] = sqrt(w[k])*(b[k] - q[k]); }
else { SIMD for (int k = 0; k < n; ++k) q[k] = b[k] - q[k]; }
