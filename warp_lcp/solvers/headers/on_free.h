// g = -scale y on the free set, 0 off it, and the square of y there.
T square = 0;
SIMD for (int k = 0; k < n; ++k) { const T v = free[k] ? y[k] : (T)0; g[k] = (S)(free[k] ? -y[k]*scale : (T)0); square += v*v; }
