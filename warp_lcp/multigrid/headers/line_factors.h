// Elimination along lines of cells, `step` apart: one over the pivots, and the multiples by which they are coupled to the next cell.
const int before = step == 1 ? 3 : 1, after = step == 1 ? 4 : 6, side = step == 1 ? 1 : n;  // lines that go side by side
const T *e = diagonals + p, *w = weights + before*size + p, *v = weights + after*size + p; T *f = pivots + p, *q = multiples + p;
for (int i = 0; i < count; ++i, e += step, w += step, v += step, f += step, q += step)
    SIMD for (int k = 0; k < side; ++k) {
        const T m = e[k] - (i ? w[k]*q[k - step] : (T)0), whole = m > (T)1e-6*e[k] ? m : e[k], inverse = 1/(whole != 0 ? whole : (T)1);
        f[k] = e[k] != 0 ? inverse : (T)0; q[k] = e[k] != 0 ? v[k]*inverse : (T)0; }
