// Kernels of interleaved Gauss-Seidel sweeps over the stresses of sand.

// kernel granular.interleaved.sweep_pressure: Gauss-Seidel sweep over the pressure, with the
// velocity updated at once
//   compute    float32
//   whole      float32 numbers
//   box        uint8 flags; float32 now, drive, share_x, mass_x, mass_y?, mass_z?, inverse_x,
//              inverse_y?, inverse_z?, u_x, u_y?, u_z?
//   numbers    float32 omega
//   constants  TENSION, HOLDS, FIRM, STEP_OF_CELL, NEARLY, DIM, BOX = 0, CUT = 0
#include "sand.h:shape"
const float* mass[3] = XYZ(mass);
const float* inverse[3] = XYZ(inverse);
T* u[3] = XYZ(u);
#include "sand.h:divergence"
for (int i = first; i < last; ++i) {
    float* x = now + i;
    if (!(flags[i] & HOLDS)) continue;
    T diagonal = 0;
    const T w = divergence(i, diagonal);
    if (!(diagonal > (T)0)) continue;
    const T floor_ = flags[i] & FIRM ? -(T)numbers[TENSION] : (T)0,
            to = (T)x[0] - (T)omega * w / diagonal;
    const float fresh = (float)(to > floor_ ? to : floor_);
    const T by = (T)fresh - (T)x[0];
    x[0] = fresh;
    for (int axis = 0; axis < DIM; ++axis) {
        u[axis][i + s[axis]] += (T)inverse[axis][i + s[axis]] * by;
        u[axis][i] -= (T)inverse[axis][i] * by;
    }
}

// kernel granular.interleaved_listed.sweep_pressure: As granular.interleaved.sweep_pressure, over
// listed cells
//   compute    float32
//   whole      float32 numbers; int32 cells
//   box        uint8 flags; float32 now, drive, share_x, mass_x, mass_y?, mass_z?, inverse_x,
//              inverse_y?, inverse_z?, u_x, u_y?, u_z?
//   listed     cells
//   numbers    float32 omega
//   constants  TENSION, HOLDS, FIRM, STEP_OF_CELL, NEARLY, DIM, BOX = 0, CUT = 0
#include "granular.interleaved.sweep_pressure"

// kernel granular.interleaved.sweep_friction: Gauss-Seidel sweep over the friction, with the
// velocity updated at once
//   compute    float32
//   whole      float32 numbers
//   box        uint8 flags; float32 now, stiff, share_x, share_y?, share_z?, inverse_x, inverse_y?,
//              inverse_z?, u_x, u_y?, u_z?
//   numbers    float32 omega
//   constants  NEWTON, LEAST_RADIUS, FRICTION, COHESION, SHEARS_HERE, GAIN, HALFWAY, DIM, BOX = 0,
//              RATE = 0
#include "sand.h:shape"
#include "sand.h:rate_bound"
#include "sand.h:yield"
#include "sand.h:edges"
FIELD(flags);
FIELD(now);
FIELD(stiff);
for (int i = first + ROW; i < last + ROW; ++i) {
    if (!(flags[i] & SHEARS_HERE) || !(stiff[i] > 0.0f)) continue;
    float* stress = now + i;
    const T x = (T)stress[0],
            radius = larger((T)numbers[FRICTION] * x + (T)numbers[COHESION], (T)0);
    const T r = larger(radius, (T)LEAST_RADIUS);
    T e[3] = {0, 0, 0}, mean = 0, diagonal = 0;
    for (int axis = 0; axis < DIM; ++axis) {
        e[axis] = u[axis][i + s[axis]] - u[axis][i];
        mean += e[axis] / (T)DIM;
        diagonal += (T)(inverse[axis][i + s[axis]] + inverse[axis][i]);
    }
    T b[SHEARS][4], largest[SHEARS][4], cap[SHEARS], part[SHEARS][4];
    long long at[SHEARS][4];
    for (int d = 0; d < SHEARS; ++d)
        for (int q = 0; q < 4; ++q) {
            at[d][q] = i + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]];
            part[d][q] = share[d][at[d][q]] > 0.0f ? (T)share[d][at[d][q]] : (T)0;
            diagonal += (T)4 * part[d][q] * part[d][q] * light(d, at[d][q]);
        }
    // Larger than half the norm of the cell's own block, which makes the sweep stable.
    const T soft = (T)omega / ((T)0.6 * diagonal);
    T n[NORMALS], normal2 = 0;
    if (DIM == 2) {
        n[0] = (T)stress[layer] + soft * (e[0] - e[1]);
        normal2 = n[0] * n[0];
    } else
        for (int m = 0; m < NORMALS; ++m) {
            n[m] = (T)stress[(1 + m) * layer] + (T)2 * soft * (e[m] - mean);
            normal2 += (T)0.5 * n[m] * n[m];
        }
    for (int d = 0; d < SHEARS; ++d) {
        for (int q = 0; q < 4; ++q)
            b[d][q] = (T)stress[(FIRST + 4 * d + q) * layer] +
                      (T)4 * soft * part[d][q] * rate(d, at[d][q]);
        T m[4];
        for (int q = 0; q < 4; ++q) m[q] = part[d][q] > (T)0 ? magnitude(b[d][q]) : (T)0;
        sums(m[0], m[1], m[2], m[3], largest[d]);
    }
    const T shrink = yield(normal2, largest, r, gain_at(x), half_at(x), soft, cap),
            keep = radius > (T)LEAST_RADIUS ? shrink : (T)0;
    const int cell = AGAIN(keep, i);
    float* again = now + cell;
    for (int m = 0; m < NORMALS; ++m) {
        const float fresh = (float)(n[m] * keep);
        const T by = (T)fresh - (T)again[(1 + m) * layer];
        again[(1 + m) * layer] = fresh;
        for (int axis = 0; axis < DIM; ++axis) {
            if (DIM == 3 && axis != m) continue;
            const T sign = DIM == 2 && axis == 1 ? (T)-1 : (T)1;
            u[axis][cell + s[axis]] -= sign * (T)inverse[axis][cell + s[axis]] * by;
            u[axis][cell] += sign * (T)inverse[axis][cell] * by;
        }
    }
    for (int d = 0; d < SHEARS; ++d)
        for (int q = 0; q < 4; ++q) {
            const long long o = cell + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]];
            const T weight = share[d][o];
            if (!(weight > (T)0)) continue;
            const T limit = radius > (T)LEAST_RADIUS ? cap[d] : (T)0,
                    cut = larger(smaller(b[d][q], limit), -limit);
            float* slot = again + (FIRST + 4 * d + q) * layer;
            const float fresh = (float)cut;
            const T by = weight * ((T)fresh - (T)slot[0]);
            slot[0] = fresh;
            shear(d, o, by);
        }
}

// kernel granular.interleaved_listed.sweep_friction: As granular.interleaved.sweep_friction, over
// listed cells
//   compute    float32
//   whole      float32 numbers; int32 cells
//   box        uint8 flags; float32 now, stiff, share_x, share_y?, share_z?, inverse_x, inverse_y?,
//              inverse_z?, u_x, u_y?, u_z?
//   listed     cells
//   numbers    float32 omega
//   constants  NEWTON, LEAST_RADIUS, FRICTION, COHESION, SHEARS_HERE, GAIN, HALFWAY, DIM, BOX = 0,
//              RATE = 0
#include "granular.interleaved.sweep_friction"

// kernel granular.interleaved.sweep_walls: Gauss-Seidel sweep over the friction of walls
//   compute    float32
//   whole      int32 cells; uint8 sides; int32 walls; float32 friction, fraction; uint8 flags;
//              float32 now, share_x, share_y?, share_z?, inverse_x, inverse_y?, inverse_z?, u_x,
//              u_y?, u_z?, numbers
//   box        int32 cells
//   numbers    float32 omega
//   constants  NEWTON, LEAST_RADIUS, FRICTION, COHESION, WEIGHT, HOLDS, GAIN, DIM, BOX = 0
#include "sand.h:shape"
#include "sand.h:edges"
#include "sand.h:wall_face"
for (int entry = first; entry < last; ++entry) {
    const long long cell = cells[entry];
    if (!(flags[cell] & HOLDS)) continue;
    face(
        entry, [&](long long at) { return (T)now[at]; }, now, numbers + WEIGHT, (T)omega, light,
        rate,
        [&](int d, long long o, long long slot, T share_, T value, T) {
            const float old = now[slot], fresh = (float)value;
            now[slot] = fresh;
            shear(d, o, share_ * ((T)fresh - (T)old));
        });
}
