// over (q - f) on the free unknowns, 0 elsewhere
SIMD for (int k = 0; k < n; ++k) { const double v = over*(q[k] - f[k]); q[k] = free[k] ? v : 0.0; }
