// The cells of one color, red or black, of a sweep of projected SOR.
for (int k = (P.k + P.j + P.first + color) % 2; k < n; k += 2) {
    const T e = diagonal(k);
    if (e != 0) {
        T v = x[k] - omega*(b[k] + e*x[k] - neighbors(x, k)) / e;
        v = v > lower[k] ? v : lower[k]; x[k] = v < upper[k] ? v : upper[k]; } }
