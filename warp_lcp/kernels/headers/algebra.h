// Vectors of 3 and matrices of 3 x 3 numbers, for loops on the host.

// snippet algebra: Products of vectors and 3 x 3 matrices. Sums are taken in the order of NumPy and
// OpenBLAS, so that results equal those of array code to the last bit. `along`: the order of a
// matrix product, a dot product and A'x. `across`: the order of A x. Adding 0 turns -0 into 0.
const auto along = [&](const double* a, int s, const double* b, int t) {
    return fused(a[2 * s], b[2 * t], fused(a[s], b[t], a[0] * b[0])) + 0.0;
};
const auto across = [&](const double* a, const double* b) {
    return fused(a[2], b[2], fused(a[0], b[0], a[1] * b[1])) + 0.0;
};
const auto apply = [&](const double* A, const double* x, double* y) {
    for (int i = 0; i < 3; ++i) y[i] = across(A + 3 * i, x);
};
const auto apply_transposed = [&](const double* A, const double* x, double* y) {
    for (int i = 0; i < 3; ++i) y[i] = along(A + i, 3, x, 1);
};
const auto product = [&](const double* A, const double* B, double* C) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) C[3 * i + j] = along(A + 3 * i, 1, B + j, 3);
};
const auto length = [&](const double* a) {
    return sqrt((a[0] * a[0] + a[1] * a[1]) + a[2] * a[2]);
};
