// Motion of rigid bodies, see `rigid/body.py`. Matrices are stored row by row; `values` are the 26
// numbers of a body's state.

// snippet spins: Angular velocity from the angular momentum: omega = R I^-1 R' L.
const auto spin_of = [&](const double* R, const double* inverse, const double* L, double* w) {
    double u[3], v[3];
    apply_transposed(R, L, u);
    apply(inverse, u, v);
    apply(R, v, w);
};

// snippet turns: Rotation matrices, and the step of `advance_states`.
// K x = v x x (cross product). Zeros are products, so that values that are not finite propagate.
const auto cross_matrix = [&](const double* v, double* K) {
    const double zero = fused(v[2], 0.0, fused(v[1], 0.0, v[0] * 0.0));
    K[0] = K[4] = K[8] = zero;
    K[1] = zero - v[2];
    K[2] = zero + v[1];
    K[3] = zero + v[2];
    K[5] = zero - v[0];
    K[6] = zero - v[1];
    K[7] = zero + v[0];
};
const auto rotation_by = [&](const double* v, double* R) {  // rotation by the angle |v| about v
    const double pi = 3.141592653589793, angle = length(v) / pi;
    const auto sinc = [&](double x) {
        double y = pi * x;
        y = y != 0.0 ? y : 2.220446049250313e-16;
        return sin(y) / y;
    };
    double K[9], H[9], square[9];
    cross_matrix(v, K);
    const double s = sinc(angle), h = sinc(0.5 * angle), half = 0.5 * (h * h);
    for (int i = 0; i < 9; ++i) H[i] = half * K[i];
    product(H, K, square);
    for (int i = 0; i < 9; ++i) R[i] = ((i % 4 ? 0.0 : 1.0) + s * K[i]) + square[i];
};
const auto advance = [&](double* values, double mass, const double* inverse, double dt) {
    double *R = values + 3, *momentum = values + 12, *L = values + 15;
    double half[3], before[3], w[3], turn[9], turned[9];
    spin_of(R, inverse, L, w);
    for (int i = 0; i < 3; ++i) half[i] = 0.5 * dt * w[i];
    for (int round = 0; round < MOST_ROUNDS; ++round) {
        for (int i = 0; i < 3; ++i) before[i] = half[i];
        rotation_by(before, turn);
        product(turn, R, turned);
        spin_of(turned, inverse, L, w);
        bool same = true;
        for (int i = 0; i < 3; ++i) {
            half[i] = 0.5 * dt * w[i];
            same &= fabs(half[i] - before[i]) <= 1e-15;
        }
        if (same) break;
    }
    for (int i = 0; i < 3; ++i) half[i] *= 2.0;
    rotation_by(half, turn);
    product(turn, R, turned);
    // Newton-Schulz step to the nearest rotation, R (3 - R'R)/2: |R'R - 1| = d becomes 3/4 d^2,
    // which is below the rounding error.
    double scaled[9], rest[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            rest[3 * i + j] = (i == j ? 3.0 : 0.0) - along(turned + i, 3, turned + j, 3);
    for (int i = 0; i < 9; ++i) scaled[i] = 0.5 * turned[i];
    product(scaled, rest, R);
    for (int i = 0; i < 3; ++i) values[i] += dt * (momentum[i] / mass);
    spin_of(R, inverse, L, w);
    values[18] += dt * w[2];
    values[19] += dt;
};

// kernel warp_lcp.rigid.motion.advance: Move bodies along their velocities, each by its own time.
// `reals` holds the values, masses, inverse inertias and times of `count` bodies; the values
// change.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 found
//   numbers    int count
//   constants  MOST_ROUNDS = 60
EXACT_MATH
#include "snippets.h:algebra"
#include "spins"
#include "turns"
const double *mass = reals + 26 * count, *inverse = mass + count, *dt = inverse + 9 * count;
for (int t = first; t < last; ++t) advance(reals + 26 * t, mass[t], inverse + 9 * t, dt[t]);

// kernel warp_lcp.rigid.motion.poses: Poses of bodies at `times` times, see `BodyMotion.poses_of`.
// `reals` holds values, masses, inverse inertias, centers and times. The results follow: rotations
// and translations, time by time, and the present velocity fields, turns and shifts.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 found
//   numbers    int count, times
//   constants  MOST_ROUNDS = 60
EXACT_MATH
#include "snippets.h:algebra"
#include "spins"
#include "turns"
const double *mass = reals + 26 * count, *inverse = mass + count, *centers = inverse + 9 * count,
             *time = centers + 3 * count;
double *rotations = reals + 39 * count + times, *translations = rotations + 9 * count * times;
double *turns = translations + 3 * count * times, *shifts = turns + 9 * count;
for (int t = first; t < last; ++t) {
    const double *now = reals + 26 * t, *center = centers + 3 * t;
    double moved[26], w[3], by[3];
    for (int m = 0; m < times; ++m) {
        const double dt = time[m] - now[19];
        for (int i = 0; i < 26; ++i) moved[i] = now[i];
        if (dt != 0.0) advance(moved, mass[t], inverse + 9 * t, dt);
        double *R = rotations + 9 * (m * count + t), *x = translations + 3 * (m * count + t);
        for (int i = 0; i < 9; ++i) R[i] = moved[3 + i];
        apply(R, center, by);
        for (int i = 0; i < 3; ++i) x[i] = (center[i] - by[i]) + (moved[i] - center[i]);
    }
    spin_of(now + 3, inverse + 9 * t, now + 15, w);
    cross_matrix(w, turns + 9 * t);
    apply(turns + 9 * t, now, by);
    for (int i = 0; i < 3; ++i) shifts[3 * t + i] = now[12 + i] / mass[t] - by[i];
}
