// Add the kernels of particles that have few others around them, the more the fewer these are. A particle looks at the share in its own
// lattice cell; few have to go on.
#include "origin.h"
#include "weigh.h"
#include "add.h"
const T* position = (const T*)given.position.data;
const int nx = given.thin.shape[2] - 2, ny = given.thin.shape[1] - 2, nz = given.thin.shape[0] - 2;
const long long s2 = nx + 2, s1 = s2*(ny + 2);
for (long long p = first; p < last; ++p) {
    auto cell = [&](int axis, int n) {
        const T x = grid_coordinate(position[3*p + axis], origin[axis]), from = x > 1 ? x : (T)1, e = n; return (int)(from < e ? from : e);
    };
    const int i = cell(0, nx), j = cell(1, ny), k = planes == 2 ? cell(2, nz) : 1;
    const long long at = k*s1 + j*s2 + i;
    T share = smooth[at];
    if (capacity) share /= capacity[at] > (T)LEAST_OPEN ? capacity[at] : (T)LEAST_OPEN;
    if (share >= (T)THIN) continue;
    const T wanted = gain*((T)pow((T)THIN/(share > (T)1e-3 ? share : (T)1e-3), (T)POWER) - 1);
    const T boost = each*(wanted < most ? wanted : most);
    T wx[3], wy[3], wz[3] = {0, 1, 0};
    weigh(grid_coordinate(position[3*p], origin[0]), nx, wx);
    weigh(grid_coordinate(position[3*p + 1], origin[1]), ny, wy);
    if (planes == 2) weigh(grid_coordinate(position[3*p + 2], origin[2]), nz, wz);
    for (int c = 2 - planes; c <= planes; ++c) for (int b = 0; b < 3; ++b) for (int a = 0; a < 3; ++a)
        add(thin[at + (c - 1)*s1 + (b - 1)*s2 + a - 1], boost*wz[c]*wy[b]*wx[a]);
}
