// Move particles from cell to cell.
#include "particle_blocks.h"
#include "sample.h"
const long long stride[3] = {1, s2, s1};
const int counts[3] = {nx, ny, nz};
int begin[M], end[M], cells[M];
auto prepare = [](int) {};
#include "walk.h"
#include "runge_kutta.h"
