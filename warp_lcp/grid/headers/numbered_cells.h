// Cells of fields of a SHAPE have the numbers of the larger grid where this is a part of one, from `first_cell` to `nx`, `ny`, `nz`; a
// stored field begins `back` elements before the first one of the larger grid's. So coordinates are rounded alike in all parts.
const int nx = SHAPE[2] - 2 + origin[0], ny = SHAPE[1] - 2 + origin[1], nz = SHAPE[0] - 2 + origin[2];
const long long s2 = SHAPE[2], s1 = s2*SHAPE[1], up = planes == 2 ? s1 : 0, back = origin[2]*s1 + origin[1]*s2 + origin[0];
const int first_cell[3] = {1 + origin[0], 1 + origin[1], 1 + origin[2]};
#include "floor.h"
const T lx = first_cell[0], ly = first_cell[1], lz = first_cell[2];
