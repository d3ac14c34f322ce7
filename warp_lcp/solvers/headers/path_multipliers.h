// s and t at y's sides, at least `least`; the sum of w s and v t, and how many there are.
const double none = (double)INFINITY; double total = 0, count = 0;
SIMD for (int i = 0; i < n; ++i) {
    const bool low = w[i] < none; const double a = y[i] > least ? y[i] : least;
    s[i] = low ? a : 0.0; total += low ? w[i]*a : 0.0; count += low ? 1.0 : 0.0;
    if constexpr (UPPER) {
        const bool high = v[i] < none; const double c = -y[i] > least ? -y[i] : least;
        t[i] = high ? c : 0.0; total += high ? v[i]*c : 0.0; count += high ? 1.0 : 0.0; } }
