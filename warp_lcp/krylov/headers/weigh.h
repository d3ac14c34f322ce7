// q = w^(1/2) q, or w^(-1/2) q
if (inverse) { SIMD for (int k = 0; k < n; ++k) q[k] = w[k] > 0 ? q[k]/sqrt(w[k]) : 0; }
else { SIMD for (int k = 0; k < n; ++k) q[k] *= sqrt(w[k]); }
