// The square of a field over the unknowns.
double square = 0;
SIMD for (int i = 0; i < n; ++i) square += unknown[i] == 1 ? b[i]*b[i] : 0.0;
