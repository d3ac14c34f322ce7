// The inverse, transposed, of a small level's matrix by Gauss-Jordan elimination; where there is no unknown, or a pivot is what rounding left
// of its diagonal, the inverse has a row of zeros.
for (int r = 0; r < m; ++r) { own[r] = matrix[r*m + r]; for (int c = 0; c < m; ++c) inverse[c*m + r] = r == c; }
for (int c = 0; c < m; ++c) {
    const double pivot = matrix[c*m + c], f = own[c] > 0 && pivot > least*own[c] ? 1/pivot : 0.0;
    for (int j = 0; j < m; ++j) { matrix[c*m + j] *= f; inverse[j*m + c] *= f; }
    for (int r = 0; r < m; ++r) if (r != c) {
        const double g = matrix[r*m + c];
        if (g != 0) { for (int j = 0; j < m; ++j) { matrix[r*m + j] -= g*matrix[c*m + j]; inverse[j*m + r] -= g*inverse[j*m + c]; } } } }
