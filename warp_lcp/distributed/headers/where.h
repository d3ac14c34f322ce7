// Where particles are: a box begins at the grid coordinates `low` and ends at `high`; `reach` is in cells.
#include "grid_coordinate.h"
const T* position = (const T*)given.position.data;
const T low[3] = {low_x, low_y, low_z}, high[3] = {high_x, high_y, high_z};
SIMD for (int p = first; p < last; ++p) {
    const long long q = 3*(long long)p;
    const T x = grid_coordinate(position[q]), y = grid_coordinate(position[q + 1]), z = grid_coordinate(position[q + 2]);
    const int in = (int)(x >= low[0]) & (int)(x < high[0]) & (int)(y >= low[1]) & (int)(y < high[1])
        & (int)(z >= low[2]) & (int)(z < high[2]);
    const int away = (int)(x >= low[0] + reach) & (int)(x < high[0] - reach) & (int)(y >= low[1] + reach) & (int)(y < high[1] - reach)
        & (int)(z >= low[2] + reach) & (int)(z < high[2] - reach);
    where[p] = (unsigned char)(2 - in - away);
}
