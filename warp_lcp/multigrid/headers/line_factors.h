// Elimination along a line of cells, `step` apart: one over the pivots, and the multiples by which they are coupled to the next cell.
const int before = step == 1 ? 3 : 1, after = step == 1 ? 4 : 6;
for (int k = 0; k < n; k += step == 1 ? n : 1) {
    T q = 0;
    for (int i = 0; i < count; ++i) {
        const long long at = p + k + i*step; const T e = diagonals[at], m = e - weights[before*size + at]*q, whole = m > (T)1e-6*e ? m : e;
        pivots[at] = e != 0 ? 1/whole : (T)0; q = e != 0 ? weights[after*size + at]/whole : (T)0; multiples[at] = q; } }
