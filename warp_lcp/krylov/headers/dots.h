// Products of the first fields of a basis with x, a column of sums each
double first = 0;
for (int j = 0; j < count; ++j) {
    const auto* v = basis + j*size + p; double vx = 0, *sum = given.out.data + j*places + P.t;
    SIMD for (int k = 0; k < n; ++k) vx += (double)v[k]*x[k];
    if (j == 0) first = vx; else *sum = P.more ? *sum + vx : vx; }
