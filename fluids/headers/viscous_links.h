// What pulls a component's faces towards solids: each link's weight, or that of a product with a face in the solid, times the velocities of
// the solid's unit motions where the link meets it, or at that face. Without `entry_rows` their number in each row.
#include "viscous_walls.h"
const int begin = entry_rows ? offsets[k*(int)(s1/s2) + j] : 0;
int e = begin;
const auto owner = [&](const short* walls, long long q, long long s) {  // of a face
    const int solid = CUT ? walls[CUT ? q : 0] : (index[CUT ? 0 : q] > index[CUT ? 0 : q - s] ? index[CUT ? 0 : q] : index[CUT ? 0 : q - s]);
    return solid >= 0 ? body[solid] : -1;
};
const auto enter = [&](int i, int number, double weight, int along, double x, double y, double z) {
    if (entry_rows) {
        const double* o = center + 3*number;
        const double r[3] = {dx*x - o[0], dx*y - o[1], planes == 2 ? dx*z - o[2] : 0.0};
        double* moves = values + (long long)e*width;
        for (int m = 0; m < width; ++m) moves[m] = 0.0;
        moves[along] = weight;
        const int a1 = (along + 1) % 3, a2 = (along + 2) % 3;  // (w x r) along the axis is w[a1] r[a2] - w[a2] r[a1]
        if (planes == 1) moves[2] = weight*(along == 0 ? -r[1] : r[0]);
        else { moves[3 + a1] = weight*r[a2]; moves[3 + a2] = -weight*r[a1]; }
        entry_rows[e] = from_ + (int)((k*(s1/s2) + j)*s2) + i; blocks[e] = number;
    }
    ++e;
};
for (int i = first; i < last; ++i) {
    if (!(diagonal[i] > 0.0f)) continue;
    const double low[3] = {i + before_x - 0.5, j + before_y - 0.5, k + before_z - 0.5};
    for (int n = 0; n < 2*planes + 2; ++n) {
        const int other = n >> 1, to = 2*(n & 1) - 1;
        const long long q = i + to*step[other];
        const int number = solid(d, q) ? owner(wall, q, sa) : -1;
        if (number < 0) continue;
        const float* across = other == first_other ? xb : xc;
        const double weight = other == axis ? head_on(i, q, to > 0 ? i : i - sa) : beside(i, q, across[to > 0 ? i + step[other] : i]);
        double x[3] = {low[0], low[1], low[2]};
        x[axis] -= 0.5; x[other] += to*(double)end_of(i, q);
        if (weight > 0.0) enter(i, number, weight, axis, x[0], x[1], x[2]);
    }
    for (int n = 0; n < 4*planes; ++n) {
        const int other = n < 4 ? first_other : last_other, up = n >> 1 & 1, back = n & 1;
        const float* distance = n < 4 ? db : dc; const short* walls = n < 4 ? wall_b : wall_c; const float* x_ = n < 4 ? xb : xc;
        const long long q = i + up*step[other] - back*sa;
        const int number = distance[q] <= (float)CLOSE ? owner(walls, q, step[other]) : -1;
        const double weight = (up ? 1.0 : -1.0)*(back ? -1.0 : 1.0)*(x_[i + up*step[other]] - mixed[back ? i - sa : i]);
        if (number < 0 || weight == 0.0) continue;
        double x[3] = {low[0], low[1], low[2]};
        x[axis] -= back; x[other] += up - 0.5;
        enter(i, number, weight, other, x[0], x[1], x[2]);
    }
}
counts[k*(int)(s1/s2) + j] = e - begin;
