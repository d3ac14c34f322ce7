// f.
#include "map_numbers.h"
with_bounds([&](auto lower, auto upper) { SIMD for (int i = 0; i < n; ++i) {
#include "map.h"
    values[i] = f; } });
