// Mark the segment of a row that each particle lies in.
#include "grid_coordinate.h"
const float* position = (const float*)given.position.data;
const auto cell_of = [](float coordinate, int count) { const int at = coordinate > 0.0f ? (int)coordinate : 0; return at < count ? at : count - 1; };
for (int p = first; p < last; ++p) {
    const float* at = position + 3*(long long)p;
    const int k = planes == 2 ? cell_of(grid_coordinate(at[2], before_z), in_z) : 1;
    const int j = cell_of(grid_coordinate(at[1], before_y), in_y), i = cell_of(grid_coordinate(at[0], before_x), in_x*segment);
    marks[((long long)k*in_y + j)*in_x + i / segment] = 1;
}
