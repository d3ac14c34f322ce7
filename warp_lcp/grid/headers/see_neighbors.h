// Add up the neighbors of each point. A closed surface has each edge once in either direction, so that each neighbor is added once; an
// outline's points have two neighbors.
#include "add.h"
const int size = given.corners.shape[1];
const float* points = (const float*)given.points.data;
auto see = [&](long long here, long long there) {
    for (int a = 0; a < 3; ++a) add(sums[4*here + a], points[3*there + a]);
    add(sums[4*here + 3], 1.0f);
};
for (long long t = first; t < last; ++t) {
    const int* c = corners + size*t;
    see(c[0], c[1]);
    if (size == 2) { see(c[1], c[0]); continue; }
    see(c[1], c[2]);
    see(c[2], c[0]);
}
