// g holds x before a sweep; it becomes the gradient, what the sweep took away. Its square.
T square = 0;
SIMD for (int k = 0; k < n; ++k) { const T v = unknown[k] == 1 ? g[k] - x[k] : (T)0; g[k] = v; square += v*v; }
