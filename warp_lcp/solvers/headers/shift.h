// diagonal = unit d + shift on the free set, 0 elsewhere; weight = 1 / |diagonal|, 1 where that is 0, 0 off the free set
if (shift) { SIMD for (int k = 0; k < n; ++k) diagonal[k] = free[k] ? (T)(unit*(double)d[k] + shift[k]) : (T)0; }
else { SIMD for (int k = 0; k < n; ++k) diagonal[k] = free[k] ? (T)(unit*(double)d[k]) : (T)0; }
SIMD for (int k = 0; k < n; ++k) { const T a = diagonal[k] < 0 ? -diagonal[k] : diagonal[k]; weight[k] = a > 0 ? (T)1/a : (T)(free[k] != 0); }
