// Which bounds are finite, as bits, and how many finite ones are not the given number, or NaN
const double inf = (double)INFINITY; const unsigned char below = least > -inf, above = most < inf ? 2 : 0; double others = 0;
if (lower && upper) { SIMD for (int k = 0; k < n; ++k) {
    const bool a = lower[k] == least, b = upper[k] == most;
    others += ((a | (lower[k] == -inf)) & (b | (upper[k] == inf))) ? 0.0 : 1.0; code[k] = (a ? 1 : 0) | (b ? 2 : 0); }
} else if (lower) { SIMD for (int k = 0; k < n; ++k) {
    const bool a = lower[k] == least; others += (a | (lower[k] == -inf)) ? 0.0 : 1.0; code[k] = (a ? 1 : 0) | above; }
} else { SIMD for (int k = 0; k < n; ++k) {
    const bool b = upper[k] == most; others += (b | (upper[k] == inf)) ? 0.0 : 1.0; code[k] = below | (b ? 2 : 0); } }
