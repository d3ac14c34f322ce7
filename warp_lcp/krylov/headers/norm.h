// r'r, weighted where there are weights
double rr = 0;
if (w) { SIMD for (int k = 0; k < n; ++k) rr += (double)w[k]*r[k]*r[k]; }
else { SIMD for (int k = 0; k < n; ++k) rr += (double)r[k]*(double)r[k]; }
