// t = b - A x
SIMD for (int k = 0; k < n; ++k) { const T e = diagonal(k), v = b[k] - e*x[k] + neighbors(x, k); t[k] = e != 0 ? v : (T)0; }
