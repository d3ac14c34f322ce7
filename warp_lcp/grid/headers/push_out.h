// Put some particles that are inside walls, or too near, outside; count those it moved and those it could not.
#include "origin.h"
typedef T Block[3][M];
const T margin = (T)MARGIN;
T* position = (T*)given.position.data;
#define SHAPE given.distance.shape
#include "numbered_cells.h"
Block at; T room[M]; int inside[M], list[M];
#include "wall_distance.h"
#include "project.h"
int moved = 0, left = 0;
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    T* position_here = position + 3*(long long)start;
    for (int d = 0; d < 3; ++d) { SIMD for (int m = 0; m < n; ++m) at[d][m] = grid_coordinate(position_here[3*m + d]); }
    measure_all(at, room, n);
    const T ex = nx + 1, ey = ny + 1, ez = nz + 1;
    SIMD for (int m = 0; m < n; ++m) {
        const T x = at[0][m], y = at[1][m], z = planes == 2 ? at[2][m] : lz;
        const int outside = (int)(x < lx) | (int)(y < ly) | (int)(z < lz) | (int)(x > ex) | (int)(y > ey) | (int)(z > ez);
        inside[m] = (outside & (int)(open_sides == 0)) | (int)(room[m] < margin);
    }
    int count = 0;
    for (int m = 0; m < n; ++m) { list[count] = m; count += inside[m]; }
    for (int q = 0; q < count; ++q) {
        const int m = list[q];
        T x[3] = {at[0][m], at[1][m], at[2][m]}, normal[3]; int finite = 1;
        for (int d = 0; d <= planes; ++d) finite &= (int)(x[d] <= (T)3e38) & (int)(x[d] >= (T)-3e38);
        if (!finite) continue;  // the sums over particles will find it
        into_domain(x);
        if (!project(x, normal, (T)PUSH)) { ++left; continue; }
        for (int d = 0; d <= planes; ++d) position_here[3*m + d] = (x[d] - 1)*dx;
        ++moved;
    }
}
if (moved > 0) count_up(given.moved.data, moved);
if (left > 0) count_up(given.left.data, left);
