// x += sign times the sum of factors_j v_j, and x'x
for (int j = 0; j < count; ++j) {
    const auto* v = basis + j*size + p; const T c = (T)(sign*factors[j]);
    SIMD for (int k = 0; k < n; ++k) x[k] += c*v[k]; }
double xx = 0;
SIMD for (int k = 0; k < n; ++k) xx += (double)x[k]*x[k];
