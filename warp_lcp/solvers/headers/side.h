// Take the products with the ghost cells beyond a side, which have been filled meanwhile, off the sums of the rows beside it.
const long long step = axis == 0 ? 1 : axis == 1 ? yp : zp, beyond = end ? step : -step;
const T c = axis == 0 ? cx : axis == 1 ? cy : cz; T zaz = 0, zap = 0;
for (int k = 0; k < n; ++k) {
    EXACT_MATH
    const long long face = k + end*step; T w = c;
    if constexpr (STENCIL == 'v') w = axis == 0 ? wx[face] : axis == 1 ? wy[face] : wz[face];
    const T v = d[k] != 0 ? w*z[k + beyond] : (T)0; zaz += z[k]*v; zap += q[k]*v; }
double* sum = sums + place + P.k*lines + P.j; sum[0] -= (double)zaz; sum[places] -= (double)zap;
