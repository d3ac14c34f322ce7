// d p f and q f, of which the gradient is made, and the sum of f^2.
#include "map_numbers.h"
double merit = 0;
with_bounds([&](auto lower, auto upper) { SIMD for (int i = 0; i < n; ++i) {
#include "map.h"
    by_x[i] = inside ? size*p*f : 0.0; by_y[i] = inside ? q*f : 0.0; merit += f*f; } });
