// Products of the fields in slots with r, a column of sums each
T first = 0;
for (int s = 0; s < slots; ++s) {
    const T* v = Z + s*size + p; double* column = given.out.data + s*places + P.t; T sum = 0;
    SIMD for (int k = 0; k < n; ++k) sum += v[k]*r[k];
    if (s == 0) first = sum; else *column = P.more ? *column + (double)sum : (double)sum; }
