// The sum of f^2.
#include "map_numbers.h"
double merit = 0;
with_bounds([&](auto lower, auto upper) { SIMD for (int i = 0; i < n; ++i) {
#include "map.h"
    merit += f*f; } });
