// mu_i x_(i + o), or mu_i x_i where that neighbor is SOLID: what its coefficient counts for, and their sum.
const long long to = step + (row < 0 ? ym : row > 0 ? yp : 0) + (plane < 0 ? zm : plane > 0 ? zp : 0);
const auto value = [&](int k) -> T { return cells[k] == 1 ? multiplier[k]*(cells[k + to] == 2 ? x[k] : x[k + to]) : (T)0; };
T sum = 0;
SIMD for (int k = 0; k < n; ++k) sum += value(k);
if (part) SIMD for (int k = 0; k < n; ++k) part[k] = value(k);
