// The sum of every stride-th of n partials from `start` on.
const double* v = partials.data + offset; double s = 0;
if (stride == 1) { SIMD8 for (int i = start; i < n; ++i) s += v[i]; }
else for (int i = start; i < n; i += stride) s += v[i];
return s;
