// What viscosity does to a component in a step, less what it has done: r = -K u - V (u - u1), and sums over it.
#include "viscous_walls.h"
double lost = 0, driven = 0, square = 0, large = 0;
const auto wall_speed = [&](const float* of, long long i) { return MOVING ? (double)of[MOVING ? i : 0] : 0.0; };
const auto velocity = [&](const float* u, const float* distance, const float* of, long long i) {
    return distance[i] <= (float)CLOSE ? wall_speed(of, i) : (double)u[i];
};
for (int i = first; i < last; ++i) {
    if (!(diagonal[i] > 0.0f)) { r[i] = 0.0f; continue; }
    const double here = u[i];
    double force = 0.0, power = 0.0;
    const auto pull = [&](long long q, double weight) { const double w = wall_speed(own, q); force += weight*(w - here); power += weight*(w - here)*w; };
    const auto link = [&](long long q, long long c) { if (solid(d, q)) pull(q, head_on(i, q, c)); else force += cell[c]*(u[q] - here); };
    const auto side = [&](long long q, float weight) { if (solid(d, q)) pull(q, beside(i, q, weight)); else force += weight*(u[q] - here); };
    const auto mix = [&](const float* v, const float* distance, const float* of, const float* x, long long s) {
        force -= (x[i] - mixed[i])*velocity(v, distance, of, i) - (x[i] - mixed[i - sa])*velocity(v, distance, of, i - sa)
            - (x[i + s] - mixed[i])*velocity(v, distance, of, i + s) + (x[i + s] - mixed[i - sa])*velocity(v, distance, of, i + s - sa);
    };
    link(i + sa, i); link(i - sa, i - sa);
    side(i + sb, xb[i + sb]); side(i - sb, xb[i]);
    mix(ub, db, solid_b, xb, sb);
    if (deep) { side(i + sc, xc[i + sc]); side(i - sc, xc[i]); mix(uc, dc, solid_c, xc, sc); }
    const double rest = force - (change ? (double)volume[i]*change[i] : 0.0);
    r[i] = (float)rest;
    square += rest*rest; large += (double)diagonal[i]*diagonal[i]; lost -= here*force; driven += power;
}
residual = square; taken = lost; given_by_walls = driven; stiff = large;
