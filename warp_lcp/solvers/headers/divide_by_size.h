// z = r / |d|, r where d is 0
SIMD for (int k = 0; k < n; ++k) { const double v = r[k]/(d[k] < 0 ? -d[k] : d[k]); z[k] = d[k] != 0 ? v : r[k]; }
