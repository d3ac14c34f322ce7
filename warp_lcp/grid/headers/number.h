// Number the stored cell that each particle lies in; in 2-D its plane is k = 1 whatever z is.
#include "origin.h"
const T* position = (const T*)given.position.data;
auto cell_of = [](T x, int count) { x = x > 1 ? x : (T)1; const T e = count; return (int)(x < e ? x : e); };
SIMD for (int p = first; p < last; ++p) {
    const long long q = 3*(long long)p;
    const int i = cell_of(grid_coordinate(position[q], origin[0]), nx), j = cell_of(grid_coordinate(position[q + 1], origin[1]), ny);
    const int k = planes == 2 ? cell_of(grid_coordinate(position[q + 2], origin[2]), nz) : 1;
    key[p] = (k*(ny + 2) + j)*(nx + 2) + i;
}
