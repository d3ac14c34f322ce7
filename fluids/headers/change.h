// the first guess becomes what the solve changed
SIMD for (int k = 0; k < n; ++k) guess[k] = x[k] - guess[k];
