// Sums of columns of partial sums.
for (int k = 0; k < n; ++k) {
    const double* v = partials + (P.first + k)*(long long)count; double s = 0;
    SIMD8 for (int i = 0; i < count; ++i) s += v[i];
    scalars[slot + P.first + k] = s; }
