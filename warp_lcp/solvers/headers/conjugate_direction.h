// The direction q = z + beta q.
const S beta = (S)scalars[BETA];
fetch(0, n, z, q);
if (beta == 0) { SIMD for (int k = 0; k < n; ++k) q[k] = z[k]; }
else { SIMD for (int k = 0; k < n; ++k) q[k] = z[k] + beta*q[k]; }
