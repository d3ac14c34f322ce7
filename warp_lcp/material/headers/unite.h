// Cells with a face between them that particles gave weight belong together.
#include "trees.h"
auto weighs = [](float weight) { return weight > (float)TINY_WEIGHT; };
for (int i = first; i < last; ++i) {  // a face with weight is none of the array's edge: the cell below it is there
    const int c = (int)(q + i), x = weighs(u[i]);
    if (x) {
#ifndef __CUDA_ARCH__
        if (P[c] == c) P[c] = P[c - 1]; else
#endif
        unite(c, c - 1);
    }
    // where the cells to the left of both are joined to them, and to each other, there is no need
    if (weighs(v[i]) && !(x && weighs(v[i - 1]) && weighs(u[i - s2]))) unite(c, c - s2);
    if (w && weighs(w[i]) && !(x && weighs(w[i - 1]) && weighs(u[i - s1]))) unite(c, c - s1);
}
