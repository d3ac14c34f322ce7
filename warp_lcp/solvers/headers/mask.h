// q + D direction on the free set, 0 off it
if (shift) { SIMD for (int k = 0; k < n; ++k) { EXACT_MATH const double v = shift[k]*direction[k], s = q[k] + v; q[k] = free[k] ? s : 0.0; } }
else { SIMD for (int k = 0; k < n; ++k) q[k] = free[k] ? q[k] : 0.0; }
