// The inverse of a small level's matrix, transposed, by Gauss-Jordan elimination of its rows; pivots that rounding leaves pin their cells at 0.
const int m = lines*cells; const auto* e = diagonals;
for (int r = 0; r < m; ++r) {
    const long long at = first + (long long)(r / cells)*row + r % cells;
    for (int c = 0; c < m; ++c) { matrix[r*m + c] = 0; inverse[c*m + r] = r == c && e[at] != 0; }
    if (e[at] == 0) { matrix[r*m + r] = 1; continue; }
    matrix[r*m + r] = e[at];
    for (int o = 0; o < 9; ++o) {
        const int j = r / cells + o / 3 - 1, i = r % cells + o % 3 - 1;
        if (o != 4 && j >= 0 && j < lines && i >= 0 && i < cells) matrix[r*m + j*cells + i] -= weights[(o < 4 ? o : o - 1)*size + at]; } }
for (int c = 0; c < m; ++c) {
    const double own = e[first + (long long)(c / cells)*row + c % cells], pivot = matrix[c*m + c], f = pivot > least*own ? 1/pivot : 0.0;
    for (int j = 0; j < m; ++j) { matrix[c*m + j] *= f; inverse[j*m + c] *= f; }
    for (int r = 0; r < m; ++r) if (r != c) {
        const double g = matrix[r*m + c];
        if (g != 0) { for (int j = 0; j < m; ++j) { matrix[r*m + j] -= g*matrix[c*m + j]; inverse[j*m + r] -= g*inverse[j*m + c]; } } } }
