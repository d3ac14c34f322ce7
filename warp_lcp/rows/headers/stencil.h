// The 7-point stencil at cell k of the piece: e x - sum of w x_neighbor where e != 0, else 0; `affine`: plus b, or as computed before.
const auto diagonal = [&](int k) -> T { return unit*(T)d[k]; };
const auto around = [&](const auto* x, int k, long long down, long long up) {  // of a field with other planes around it; unrounded
    if constexpr (STENCIL == 'v') return wx[k]*x[k-1] + wx[k+1]*x[k+1] + wy[k]*x[k+ym] + wy[k+yp]*x[k+yp] + wz[k]*x[k+down] + wz[k+zp]*x[k+up];
    else return cx*(x[k-1] + x[k+1]) + cy*(x[k+ym] + x[k+yp]) + cz*(x[k+down] + x[k+up]); };
const auto neighbors = [&](const auto* x, int k) { return around(x, k, zm, zp); };
const auto product = [&](const auto* x, int k) -> T { const T e = diagonal(k), v = e*x[k] - neighbors(x, k); return e != 0 ? v : (T)0; };
const auto affine = [&](const auto* x, const auto* b, int k) -> T { if constexpr (STENCIL == 'k') return known[k]; else return product(x, k) + b[k]; };
