// What the steps of particles see.
#include "origin.h"
typedef T Block[3][M];
const T margin = (T)MARGIN;
T* position = (T*)given.position.data;
#define SHAPE given.u.shape
#include "numbered_cells.h"
Block from, to, k1, k2, k3;
int hit[M], list[M];
auto abs_of = [](T x) { return x < 0 ? -x : x; };
