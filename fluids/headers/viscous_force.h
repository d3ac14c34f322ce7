// What viscosity does to a component in a step, less what it has done: r = -K u - V (u - u1), and sums over it.
#include "viscous_walls.h"
double lost = 0, driven = 0, square = 0, large = 0;
const auto wall_speed = [&](const float* of, long long i) { return MOVING ? (double)of[MOVING ? i : 0] : 0.0; };
const auto source = [&](long long q, long long s) {  // whether a face is a source's, by the step along its component's axis
    return ((kind[q] == SOLID) & (base[q] != SOLID)) | ((kind[q - s] == SOLID) & (base[q - s] != SOLID));
};
const auto met = [&](int i, long long q, int other, int side) {  // the wall's velocity at the end of the link from i to q along an axis
    if (source(q, sa)) return (double)u[q];
    if (!MOVING || !turn) return wall_speed(own, q);
    double x[3] = {i + before_x - 0.5, j + before_y - 0.5, planes == 2 ? k + before_z - 0.5 : 0.0};
    x[axis] -= 0.5; x[other] += side*(double)end_of(i, q);
    const int solid = wall[q] > 0 ? wall[q] : 0;
    const float* row = turn + 9*solid + 3*axis;
    return dx*(row[0]*x[0] + row[1]*x[1] + row[2]*x[2]) + shift[3*solid + axis];
};
const auto velocity = [&](const float* u, const float* distance, const float* of, long long i, long long s) {
    return distance[i] <= (float)CLOSE && !source(i, s) ? wall_speed(of, i) : (double)u[i];
};
for (int i = first; i < last; ++i) {
    if (!(diagonal[i] > 0.0f)) { r[i] = 0.0f; continue; }
    const double here = u[i];
    double force = 0.0, power = 0.0;
    const auto pull = [&](long long q, double weight, int other, int side) { const double w = met(i, q, other, side); force += weight*(w - here); power += weight*(w - here)*w; };
    const auto link = [&](long long q, long long c, int to) { if (solid(d, q)) pull(q, head_on(i, q, c), axis, to); else force += cell[c]*(u[q] - here); };
    const auto side = [&](long long q, float weight, int other, int to) { if (solid(d, q)) pull(q, beside(i, q, weight), other, to); else force += weight*(u[q] - here); };
    const auto mix = [&](const float* v, const float* distance, const float* of, const float* x, long long s) {
        force -= (x[i] - mixed[i])*velocity(v, distance, of, i, s) - (x[i] - mixed[i - sa])*velocity(v, distance, of, i - sa, s)
            - (x[i + s] - mixed[i])*velocity(v, distance, of, i + s, s) + (x[i + s] - mixed[i - sa])*velocity(v, distance, of, i + s - sa, s);
    };
    link(i + sa, i, 1); link(i - sa, i - sa, -1);
    side(i + sb, xb[i + sb], first_other, 1); side(i - sb, xb[i], first_other, -1);
    mix(ub, db, solid_b, xb, sb);
    if (deep) { side(i + sc, xc[i + sc], last_other, 1); side(i - sc, xc[i], last_other, -1); mix(uc, dc, solid_c, xc, sc); }
    const double rest = force - (change ? (double)volume[i]*change[i] : 0.0);
    r[i] = (float)rest;
    square += rest*rest; large += (double)diagonal[i]*diagonal[i]; lost -= here*force; driven += power;
}
residual = square; taken = lost; given_by_walls = driven; stiff = large;
