// What the steps of particles see. Cells have the numbers of the larger grid where this is a part of one, from `first_cell` to `nx`, `ny`,
// `nz`; a stored field begins `back` elements before the first one of the larger grid's. So coordinates are rounded alike in all parts.
#include "origin.h"
typedef T Block[3][M];
const T margin = (T)MARGIN;
T* position = (T*)given.position.data;
const int nx = given.u.shape[2] - 2 + origin[0], ny = given.u.shape[1] - 2 + origin[1], nz = given.u.shape[0] - 2 + origin[2];
const long long s2 = given.u.shape[2], s1 = s2*given.u.shape[1], up = planes == 2 ? s1 : 0, back = origin[2]*s1 + origin[1]*s2 + origin[0];
const int first_cell[3] = {1 + origin[0], 1 + origin[1], 1 + origin[2]};
const T lx = first_cell[0], ly = first_cell[1], lz = first_cell[2];
Block from, to, k1, k2, k3;
int hit[M], list[M];
auto abs_of = [](T x) { return x < 0 ? -x : x; };
