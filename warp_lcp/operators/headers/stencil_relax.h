// The cells of one color of a sweep of projected SOR: red or black, of a compact stencil those whose indices are even or odd as its bits say.
const bool compact = STENCIL == 'c'; const int bits = compact ? color : 0;
const int start = compact ? (P.first + bits) % 2 : (P.k + P.j + P.first + color) % 2;
const bool ours = !compact || (P.j % 2 == bits / 2 % 2 && P.k % 2 == bits / 4);
for (int k = ours ? start : n; k < n; k += 2) {
    const T e = diagonal(k);
    if (e != 0) {
        T v = x[k] - omega*(b[k] + e*x[k] - neighbors(x, k)) / e;
        v = v > lower[k] ? v : lower[k]; x[k] = v < upper[k] ? v : upper[k]; } }
