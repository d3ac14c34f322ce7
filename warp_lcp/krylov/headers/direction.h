// direction = z + beta direction, beta = r'z / (r'z)_old
const T beta = scalars[RZ_OLD] > 0 ? (T)(scalars[RZ]/scalars[RZ_OLD]) : (T)0;
SIMD for (int k = 0; k < n; ++k) direction[k] = z[k] + beta*direction[k];
