// The links of a component's faces to rigid bodies: what each weighs, and times the velocities of the body's unit motions where they meet;
// its way is 2 axis + (1: up). Without `entry_rows` their number in each row.
#include "viscous_walls.h"
const int begin = entry_rows ? offsets[k*(int)(s1/s2) + j] : 0;
int e = begin;
for (int i = first; i < last; ++i) {
    if (!(diagonal[i] > 0.0f)) continue;
    for (int n = 0; n < 2*planes + 2; ++n) {
        const int other = n >> 1, to = 2*(n & 1) - 1;
        const long long q = i + to*step[other];
        const int number = solid(d, q) && wall[q] > 0 ? body[wall[q]] : -1;
        const float* across = other == first_other ? xb : xc;
        const long long edge = to > 0 ? i + step[other] : i;
        const double weight = number < 0 ? 0.0 : (other == axis ? head_on(i, q, to > 0 ? i : i - sa) : beside(i, q, across[edge]));
        if (!(weight > 0.0)) continue;
        if (entry_rows) {
            double x[3] = {i + before_x - 0.5, j + before_y - 0.5, k + before_z - 0.5};
            x[axis] -= 0.5; x[other] += to*(double)(d[i]/(d[i] - d[q]));
            for (int a = 0; a < 3; ++a) x[a] = a > planes ? 0.0 : dx*x[a] - center[3*number + a];
            const int a1 = (axis + 1) % 3, a2 = (axis + 2) % 3;  // (w x r) along the axis is w[a1] r[a2] - w[a2] r[a1]
            double* moves = values + (long long)e*width;
            for (int m = 0; m < width; ++m) moves[m] = 0.0;
            moves[axis] = weight;
            if (planes == 1) moves[2] = weight*(axis == 0 ? -x[1] : x[0]);
            else { moves[3 + a1] = weight*x[a2]; moves[3 + a2] = -weight*x[a1]; }
            entry_rows[e] = from_ + (int)((k*(s1/s2) + j)*s2) + i; blocks[e] = number; weights[e] = weight; ways[e] = n;
        }
        ++e;
    }
}
counts[k*(int)(s1/s2) + j] = e - begin;
