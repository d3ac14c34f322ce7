// Whether a wall holds a coarse face: the mean of the finer ones that lie on it, -1 if one of those is not in a wall.
#include "viscous_levels.h"
const int mx = given.fine.shape[2], my = given.fine.shape[1], mz = given.fine.shape[0];
for (int i = first; i < last; ++i) {
    float sum = 0.0f, least = 1.0f; int count = 0;
    for (int c = 0; c < (axis == 2 || planes == 1 ? 1 : 2); ++c) for (int b = 0; b < (axis == 1 ? 1 : 2); ++b) for (int a = 0; a < (axis == 0 ? 1 : 2); ++a) {
        const long long z = planes == 1 ? k : clamped(2*k - 1 + c + shift[2], mz);
        const long long y = clamped(2*j - 1 + b + shift[1], my), x = clamped(2*i - 1 + a + shift[0], mx);
        const float value = fine[(z*my + y)*mx + x];
        sum += value; least = value < least ? value : least; ++count;
    }
    out[i] = least < 0.0f ? -1.0f : sum/(float)count;
}
