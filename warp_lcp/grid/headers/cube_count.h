// Count the points that a row's nodes own and the triangles of its cells.
#include "cube_cases.h"
int points = 0, elements = 0;
each([&](int i, int code) {
    const int here = code & 1;
    points += (here ^ (code >> 1 & 1)) + (here ^ (code >> 2 & 1)) + (here ^ (code >> 4 & 1));
    elements += table[(code & mask)*wide];
});
owned[P.row] = points;
made[P.row] = elements;
