// s'(y - y_z), s'D s, -s'D (x - x_old) and x'D x with s = x - z.
T curvature = 0, metric = 0, turned = 0, size = 0;
SIMD for (int k = 0; k < n; ++k) {
    const T one = unknown[k] == 1 ? (T)1 : (T)0, s = one*(x[k] - z[k]);
    curvature += s*(y[k] - y_z[k]); metric += d[k]*s*s; turned -= d[k]*s*(x[k] - x_old[k]); size += one*d[k]*x[k]*x[k]; }
