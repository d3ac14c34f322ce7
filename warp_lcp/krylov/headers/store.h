// A field of a basis = x over the root of x'x; 0 where that is 0
auto* v = basis + place*size + p; const double xx = sums[last], scale = xx > 0 ? 1.0/sqrt(xx) : 0.0;
SIMD for (int k = 0; k < n; ++k) v[k] = scale*x[k];
