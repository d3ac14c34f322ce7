// Push the faces that the surface crosses by the pressure's jump on it over their distance from the liquid's cell; see pressure_face.h.
#include "pressure_face.h"
const int nx = given.kind.shape[2], ny = given.kind.shape[1], nz = given.kind.shape[0];
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
const int lowest[3] = {axis == 0 ? 2 : 1, axis == 1 ? 2 : 1, planes != 2 ? 0 : (axis == 2 ? 2 : 1)};  // no cell of the ring has a surface
const bool inside = j >= lowest[1] && j + 1 < ny && k >= lowest[2] && (planes != 2 || k + 1 < nz);
const int low = first > lowest[0] ? first : lowest[0], high = last < nx - 1 ? last : nx - 1;
for (int i = low; i < high && inside; ++i) {
    const bool wet = kind[i] == FLUID && kind[i - s] == AIR, dry = kind[i] == AIR && kind[i - s] == FLUID;
    if (!wet && !dry) continue;
    const long long liquid = wet ? i : i - s, air = wet ? i - s : i;
    const float over = jump[liquid]*(inverse_theta(liquid, air) - 1.0f) + jump[air];  // of linear interpolation, over theta
    field[i] += wet ? over : -over;
}
