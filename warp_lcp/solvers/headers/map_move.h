// x += step e.
fetch(0, n, x, e);
SIMD8 for (int k = 0; k < n; ++k) x[k] += step*(double)e[k];
