// The gradient over d^2, from what stands in it and A' q f; squares of it over d, and its product with the last one.
double square = 0, inner = 0;
SIMD for (int i = 0; i < n; ++i) {
    const double e = unit*(double)d[i], least = e < 0 ? -e : e, size = least == 0 ? 1.0 : least;
    const double g = unknown[i] == 1 ? (gradient[i] + product[i])/size : 0.0;
    gradient[i] = g/size; square += g*g; inner += g*size*last[i]; }
