// Solve for all cells of a row at once, if it has the color.
if (P.j % 2 == color) {
    const T *before = weights + 3*size + p;
    SIMD for (int k = 0; k < n; ++k) { const T e = diagonal(k); t[k] = e != 0 ? b[k] - e*x[k] + neighbors(x, k) : (T)0; }
    T z = 0;
    for (int k = 0; k < n; ++k) { z = (t[k] + before[k]*z)*pivots[k]; t[k] = z; }
    z = 0;
    for (int k = n - 1; k >= 0; --k) { z = t[k] + multiples[k]*z; t[k] = z; }
    SIMD for (int k = 0; k < n; ++k) x[k] += t[k]; }
