// The planes (rows in 2-D) of a field that some particles may add to: the first, one past the last.
#include "grid_coordinate.h"
const T* position = (const T*)given.position.data + (planes == 2 ? 2 : 1);
const int before = planes == 2 ? before_z : before_y;
T low = (T)1e9, high = (T)-1e9;
SIMD for (int p = first; p < last; ++p) {
    const T x = grid_coordinate(position[3*(long long)p], before), from = x > (T)-1e6 ? x : (T)-1e6, at = from < (T)1e6 ? from : (T)1e6;
    low = at < low ? at : low; high = at > high ? at : high;
}
touched[2*c_] = (int)low - 1; touched[2*c_ + 1] = (int)high + 2;
