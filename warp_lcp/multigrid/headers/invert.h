// Columns of the inverse from the factors L D L' (L has ones on its diagonal, where it stores the pivots), if a row of cells has changed.
const auto due = [&]() { for (int r = 0; r < flags; ++r) if (changed[r]) return true; return false; };
if (due()) {
    const int first = (int)p, end = first + n; const double* factors = matrix; double* X = inverse;
    for (int r = 0; r < m; ++r) {
        SIMD8 for (int c = first; c < end; ++c) X[r*m + c] = r == c ? 1.0 : 0.0;
        for (int s = 0; s < r; ++s) { const double l = factors[r*m + s]; SIMD8 for (int c = first; c < end; ++c) X[r*m + c] -= l*X[s*m + c]; } }
    for (int r = m - 1; r >= 0; --r) {
        const double pivot = factors[r*m + r];
        SIMD8 for (int c = first; c < end; ++c) X[r*m + c] = pivot > 0 ? X[r*m + c]/pivot : 0.0;
        for (int s = r + 1; s < m; ++s) {
            const double l = pivot > 0 ? factors[s*m + r] : 0.0; SIMD8 for (int c = first; c < end; ++c) X[r*m + c] -= l*X[s*m + c]; } } }
