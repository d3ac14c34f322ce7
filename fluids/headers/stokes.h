// Kernels of the coupled solve of velocity and pressure (unsteady Stokes), see `fluids.stokes`.

// snippet stokes_face: A component's lower face of a cell. `step`: to the cell below it;
// `fraction`: its open fraction; `inverse_theta`: 1 / theta between a FLUID and an AIR cell.
const long long steps[3] = {1, s2, s1}, step = steps[axis];
const auto fraction = [&](long long i) {
    return CUT ? open[CUT ? i : 0]
               : (((kind[i] == SOLID) | (kind[i - step] == SOLID)) ? 0.0f : 1.0f);
};
// Faces that the pressure moves: they touch FLUID, are open, and neither cell is SOLID.
const auto moved = [&](long long i) {
    const int here = kind[i], below = kind[i - step];
    return ((here == FLUID) | (below == FLUID)) & (here != SOLID) & (below != SOLID) &
           (fraction(i) > 0.0f);
};

// snippet stokes_edge: First face of a row that has a cell below it.
const int edge =
    (axis == 1 && j == 0) || (axis == 2 && k == 0) ? last : (axis == 0 && first == 0 ? 1 : first);

// kernel fluids.stokes.masses: Mass of a component's faces, m = a theta, in units of rho dx^d; and
// faces in a wall that are partly open. A film as thick as half of the open part holds these:
// drag = tau nu_rel / (a / 2 + slip length). `leak` = a^2 / (m + drag) is their outflow per
// difference of pressures, `share` = drag / (m + drag) the wall's part of their velocity;
// `free_part` = a (1 - share). Where the film slips, it is stretched against the liquid beside it,
// with the stress 2 tau nu_rel a per velocity: its leak has at least this resistance.
//   compute    float32
//   box        float32 volume, leak, share, free_part?, d, h, open?, phi?, thick?; int8 kind;
//              uint8 contact
//   numbers    int axis, planes; float32 tau
//   constants  FLUID, SOLID, AIR, RELEASED, CLOSE, THETA_MIN, CUT, GHOST, VARIES
#include "stokes_face"
#include "stokes_edge"
const auto inverse_theta = [&](long long liquid, long long air) {
    const float inverse = GHOST ? 1.0f - phi[GHOST ? air : 0] / phi[GHOST ? liquid : 0] : 1.0f;
    const float least = inverse > 1.0f ? inverse : 1.0f;
    return least < (float)(1.0 / THETA_MIN) ? least : (float)(1.0 / THETA_MIN);
};
// viscosity of the liquid on both sides of a face, the mean of two cells
const auto viscosity = [&](long long i) {
    if (!VARIES) return 1.0f;
    const float here = thick[VARIES ? i : 0], below = thick[VARIES ? i - step : 0],
                sum = here + below;
    return sum > 0.0f ? (here > 0.0f && below > 0.0f ? 0.5f * sum : sum) : 1.0f;
};
for (int i = first; i < edge; ++i) volume[i] = leak[i] = share[i] = 0.0f;
for (int i = edge; i < last; ++i) {
    const int here = kind[i], below = kind[i - step];
    const float part = moved(i) ? fraction(i) : 0.0f;
    const float inverse = here == AIR
                              ? (below == FLUID ? inverse_theta(i - step, i) : 1.0f)
                              : (below == AIR && here == FLUID ? inverse_theta(i, i - step) : 1.0f);
    const float mass = part / inverse;
    const bool wall = d[i] <= (float)CLOSE;
    const bool held = ((here == FLUID) & (contact[i] != RELEASED)) |
                      ((below == FLUID) & (contact[i - step] != RELEASED));
    float drag = 0.0f;
    if (wall && part > 0.0f && held && h[i] < INFINITY) {
        drag = tau * viscosity(i) / (0.5f * part + h[i]);
    }
    const float stretch = wall && part > 0.0f ? 2.0f * tau * viscosity(i) * part : 0.0f,
                resistance = drag > stretch ? drag : stretch;
    volume[i] = wall ? 0.0f : mass;
    leak[i] = wall && part > 0.0f ? part * part / (mass + resistance) : 0.0f;
    share[i] = wall && part > 0.0f ? drag / (mass + drag) : 0.0f;
    if (free_part) free_part[i] = fraction(i) * (1.0f - share[i]);
}

// kernel fluids.stokes.cells: Weights of the normal stresses of FLUID cells, 0 in other cells. A
// cell has its own liquid, and an equal part of the liquid of each AIR cell beside it. Beside a
// separating wall the strain rate across the wall is replaced by minus the sum of the others, see
// `fluids.stokes`; `product` is then the weight of the products of the other two in 3-D.
//   compute    float32
//   box        float32 cell, mixed, out_cell, out_mixed, product?, dx, dy, dz?; int8 kind;
//              uint8 touch, contact; uint8 out_contact; int8 across?
//   numbers    int planes
//   constants  AIR, FLUID, RELEASED, LETS_GO, CLOSE, ALONG, CUT
const long long steps[3] = {1, s2, s1};
const float* d[3] = {dx, dy, planes == 2 ? dz : dx};
for (int i = first; i < last; ++i) {
    float weight = 0.0f, rest = 0.0f, cross = 0.0f;
    int normal = -1;
    unsigned char touching = contact[i];
    if (kind[i] == FLUID) {
        weight = cell[i];
        rest = mixed[i];
        for (int n = 0; n < 2 * planes + 2; ++n) {
            const long long air = i + (n & 1 ? 1 : -1) * steps[n >> 1];
            if (kind[air] != AIR || !(cell[air] > 0.0f)) continue;
            int count = 0;
            for (int m = 0; m < 2 * planes + 2; ++m)
                count += kind[air + (m & 1 ? 1 : -1) * steps[m >> 1]] == FLUID;
            weight += cell[air] / (float)count;
        }
        if (touch[i] & LETS_GO) {
            int walls = 0;
            bool aligned = true;
            for (int axis = 0; axis <= planes; ++axis) {
                const float low = d[axis][i], high = d[axis][i + steps[axis]];
                if (!(low <= (float)CLOSE) && !(high <= (float)CLOSE)) continue;
                ++walls;
                normal = axis;
                const float rise = low < high ? high - low : low - high;
                aligned = aligned && (!CUT || rise >= (float)ALONG);
            }
            if (aligned && walls) {
                weight += rest;
                rest = 0.0f;
                touching = RELEASED;  // no link to the wall along its normal
                if (walls == 1) {
                    cross = weight;
                    weight *= 2.0f;
                }
            }
        }
    }
    out_cell[i] = weight;
    out_mixed[i] = rest;
    out_contact[i] = touching;
    if (product) {
        product[i] = cross;
        across[i] = (signed char)normal;
    }
}

// kernel fluids.stokes.edges: Cut the shear stress at edges that touch a face without mass: there
// this face moves such that the stress vanishes
//   compute    float32
//   box        float32 weight, da, db, va, vb
//   numbers    int a, b
//   constants  CLOSE
const long long steps[3] = {1, s2, s1}, A = steps[a], B = steps[b];
const auto light = [&](const float* d, const float* v, long long f) {
    return !(d[f] <= (float)CLOSE) && !(v[f] > 0.0f);
};
for (int i = first; i < last; ++i) {
    const bool cut =
        light(da, va, i) || light(da, va, i - B) || light(db, vb, i) || light(db, vb, i - A);
    weight[i] = cut ? 0.0f : weight[i];
}

// kernel fluids.stokes.scale: Correction c of the pressure by an outflow, which approximates
// mu / dx^2: the reciprocal of the sum of a^2 / K over the faces of a cell, with the viscous part K
// of their diagonals. `weight`: c plus the reciprocal of the sum of a^2 / m, an estimate of the
// diagonal of the inverse Schur complement
//   compute    float32
//   box        float32 coefficient, weight, ax?, ay?, az?, vx, vy, vz?, diagonal_x, diagonal_y,
//              diagonal_z?, leak_x, leak_y, leak_z?, share_x, share_y, share_z?, cell; int8 kind
//   numbers    int planes
//   constants  FLUID, SOLID, CUT
const long long steps[3] = {1, s2, s1};
const float* open[3] = {ax, ay, az};
const float* volume[3] = {vx, vy, vz};
const float* diagonal[3] = {diagonal_x, diagonal_y, diagonal_z};
const float* leak[3] = {leak_x, leak_y, leak_z};
const float* share[3] = {share_x, share_y, share_z};
for (int i = first; i < last; ++i) {
    float stiff = 0.0f, inert = 0.0f;
    bool loose = false;  // a face without viscous force
    for (int n = 0; n < 2 * planes + 2; ++n) {
        const int axis = n >> 1;
        const long long f = i + (n & 1) * steps[axis];
        float by_force = 0.0f, by_mass = 0.0f;
        if (volume[axis][f] > 0.0f) {
            const float a = CUT ? open[axis][CUT ? f : 0] : 1.0f;
            // faces at open sides of the domain have no row in the viscous equations
            const float force =
                diagonal[axis][f] > 0.0f ? diagonal[axis][f] - volume[axis][f] : cell[i];
            by_mass = a * a / volume[axis][f];
            by_force = force > 0.0f ? a * a / force : 0.0f;
        } else if (leak[axis][f] > 0.0f) {
            by_mass = leak[axis][f];
            by_force = share[axis][f] > 0.0f ? leak[axis][f] / share[axis][f] : INFINITY;
            // the film's own stress, where it resists more than the wall
            const float a = CUT ? open[axis][CUT ? f : 0] : 1.0f,
                        resistance = a * a / leak[axis][f] - a;
            if (resistance > 0.0f && a * a / resistance < 0.99f * by_force)
                by_force = a * a / resistance;
            by_force = by_force < INFINITY ? by_force : 0.0f;
        }
        inert += by_mass;
        stiff += by_force;
        loose = loose || (by_mass > 0.0f && !(by_force > 0.0f));
    }
    const bool viscous = (kind[i] == FLUID) & (stiff > 0.0f) & !loose,
               moves = (kind[i] == FLUID) & (inert > 0.0f);
    coefficient[i] = viscous ? 1.0f / stiff : 0.0f;
    weight[i] = moves ? coefficient[i] + 1.0f / inert : 0.0f;
}

// kernel fluids.stokes.weights: Reciprocal diagonals of a component's rows
//   compute    float32
//   box        float32 weight, volume, diagonal, cell; int8 kind
//   numbers    int axis
//   constants  FLUID
const long long steps[3] = {1, s2, s1}, step = steps[axis];
#include "stokes_edge"
for (int i = first; i < last; ++i) {
    float size = 1.0f;
    if (i >= edge && volume[i] > 0.0f)
        size = diagonal[i] > 0.0f ? diagonal[i] : volume[i] + cell[kind[i] == FLUID ? i : i - step];
    weight[i] = i >= edge && volume[i] > 0.0f ? 1.0f / size : 0.0f;
}

// snippet stokes_gradient: Add the pressure's force a (x_below - x_here) to the force on a
// component, times `sign`; at faces on open sides of the domain also mass times `rate`, and the
// viscous force of the cell beside it.
for (int i = edge; i < last; ++i) {
    if (!(volume[i] > 0.0f)) continue;
    const double push = (double)fraction(i) * ((double)x[i - step] - (double)x[i]);
    double row = diagonal[i] > 0.0f ? (double)out[i] : 0.0;
    if (!(diagonal[i] > 0.0f)) {
        const bool above = kind[i] == FLUID;  // the cell of liquid beside it
        const double link = cell[above ? i : i - step];
        row = -sign * ((double)volume[i] * rate[i] +
                       link * ((double)u[i] - (double)u[above ? i + step : i - step]));
    }
    out[i] = (float)(row + sign * push);
}

// kernel fluids.stokes.gradient: The rows of velocities in a product: viscous part minus pressure
//   compute    float64
//   box        float32 out, volume, diagonal, cell, u, rate, open?, x; int8 kind
//   numbers    int axis; float64 sign
//   constants  FLUID, SOLID, CUT
#include "stokes_face"
#include "stokes_edge"
#include "stokes_gradient"

// kernel fluids.stokes.force: The residual of velocities: viscous part plus pressure
//   compute    float64
//   box        float32 out, volume, diagonal, cell, u, rate, open?; float64 x; int8 kind
//   numbers    int axis; float64 sign
//   constants  FLUID, SOLID, CUT
#include "stokes_face"
#include "stokes_edge"
#include "stokes_gradient"

// kernel fluids.stokes.beside_walls: Add the products c g_s g_t of the two strain rates along an
// aligned separating wall to the rows of a component t, times `sign`: c g_s of the cell below minus
// that of the cell above. 3-D only
//   compute    float32
//   box        float32 out, volume, product, u, v, w; int8 across
//   numbers    int axis; float32 sign
const long long steps[3] = {1, s2, s1}, step = steps[axis];
const float* speed[3] = {u, v, w};
#include "stokes_edge"
const auto stress = [&](long long c) {
    const int normal = across[c];
    if (normal < 0 || normal == axis || !(product[c] > 0.0f)) return 0.0f;
    const int other = 3 - axis - normal;
    return product[c] * (speed[other][c + steps[other]] - speed[other][c]);
};
for (int i = edge; i < last; ++i)
    if (volume[i] > 0.0f) out[i] += sign * (stress(i - step) - stress(i));

// kernel fluids.stokes.outflow: Minus the outflow of free cells by velocities and leaks
//   compute    float32
//   box        float32 out, x, u, v, w?, ax?, ay?, az?, vx, vy, vz?, leak_x, leak_y, leak_z?;
//              uint8 free
//   numbers    int planes
//   constants  CUT
const long long steps[3] = {1, s2, s1};
const float* open[3] = {ax, ay, az};
const float* speed[3] = {u, v, w};
const float* volume[3] = {vx, vy, vz};
const float* leak[3] = {leak_x, leak_y, leak_z};
for (int i = first; i < last; ++i) {
    float sum = 0.0f;
    for (int axis = 0; axis <= planes; ++axis) {
        const long long step = steps[axis], f = i + step;
        const float up = volume[axis][f] > 0.0f
                             ? (CUT ? open[axis][CUT ? f : 0] : 1.0f) * speed[axis][f]
                             : 0.0f,
                    down = volume[axis][i] > 0.0f
                               ? (CUT ? open[axis][CUT ? i : 0] : 1.0f) * speed[axis][i]
                               : 0.0f;
        sum += up - down + leak[axis][f] * (x[i] - x[f]) + leak[axis][i] * (x[i] - x[i - step]);
    }
    out[i] = free[i] ? -sum : 0.0f;
}

// kernel fluids.stokes.held: Velocity of faces in walls that are partly open: that of wall and
// start, by their shares, and the leak of the pressure
//   compute    float64
//   box        float32 u, before, leak, share, open?, solid?; float64 x; int8 kind
//   numbers    int axis
//   constants  FLUID, SOLID, CUT, MOVING
#include "stokes_face"
#include "stokes_edge"
for (int i = edge; i < last; ++i) {
    if (!(leak[i] > 0.0f)) continue;
    const double wall = MOVING ? (double)solid[MOVING ? i : 0] : 0.0;
    u[i] = (float)(share[i] * wall + (1.0 - share[i]) * before[i] +
                   leak[i] / fraction(i) * (x[i - step] - x[i]));
}

// kernel fluids.stokes.divergence: Outflow y of FLUID cells [m/s]. Cells beside separating walls
// are free unless x is at its bound and y > 0; `switching`: cells that changed; `worst`: largest
// |y| of free cells; `most`: largest |x|
//   compute    float64
//   box        float32 y, u, v, w?, ax?, ay?, az?, solid_x?, solid_y?, solid_z?; float64 x, lower?;
//              int8 kind; uint8 free
//   numbers    int planes, look; float64 least_x, least_y
//   sums       switching
//   largest    worst, most
//   constants  FLUID, SOLID, CUT, MOVING, BOUNDED
const long long steps[3] = {1, s2, s1};
const float* open[3] = {ax, ay, az};
const float* speed[3] = {u, v, w};
const float* solid[3] = {solid_x, solid_y, solid_z};
double changes = 0.0;
for (int i = first; i < last; ++i) {
    double sum = 0.0;
    for (int n = 0; n < 2 * planes + 2; ++n) {
        const int axis = n >> 1;
        const long long f = i + (n & 1) * steps[axis], b = f - steps[axis];
        const double a = CUT ? (double)open[axis][CUT ? f : 0]
                             : (((kind[f] == SOLID) | (kind[b] == SOLID)) ? 0.0 : 1.0);
        const double through = a * (double)speed[axis][f] +
                               (MOVING ? (1.0 - a) * (double)solid[axis][MOVING ? f : 0] : 0.0);
        sum += n & 1 ? through : -through;
    }
    const bool fluid = kind[i] == FLUID;
    bool is_free = fluid && (free[i] != 0 || look == 2);
    if (BOUNDED && fluid && look && lower[BOUNDED ? i : 0] > -INFINITY) {
        const double above = x[i] - lower[BOUNDED ? i : 0];
        const bool next = look == 2 ? above > 0.0 : (is_free ? above >= -least_x : sum < -least_y);
        changes += look == 1 && next != is_free;
        is_free = next;
    }
    free[i] = is_free;
    y[i] = fluid ? (float)sum : 0.0f;
    const double miss = is_free ? (sum < 0.0 ? -sum : sum) : 0.0,
                 size = fluid ? (x[i] < 0.0 ? -x[i] : x[i]) : 0.0;
    worst = miss > worst ? miss : worst;
    most = size > most ? size : most;
}
switching = changes;

// kernel fluids.stokes.bound: Set the pressure of cells that are not free to its bound
//   compute    float64
//   box        float64 x, lower?; int8 kind; uint8 free
//   constants  FLUID
for (int i = first; i < last; ++i)
    if (kind[i] == FLUID && !free[i] && lower) x[i] = lower[i];

// kernel fluids.stokes.right_side: Right-hand side of the pressure's correction: r + sign q on free
// cells
//   compute    float32
//   box        float32 out, r, q; uint8 free
//   numbers    float32 sign
for (int i = first; i < last; ++i) out[i] = free[i] ? r[i] + sign * q[i] : 0.0f;

// kernel fluids.stokes.correction: Minus the pressure's correction: z = -(cycle + c r), and the
// square of the right-hand side in the preconditioner's norm, r (cycle + c r)
//   compute    float32
//   box        float32 z, cycle, r, coefficient; uint8 free
//   sums       square
double sum = 0.0;
for (int i = first; i < last; ++i) {
    const float v = free[i] ? cycle[i] + coefficient[i] * r[i] : 0.0f;
    sum += (double)v * r[i];
    z[i] = -v;
}
square = sum;

// kernel fluids.stokes.velocity_correction: The viscous cycle's velocity on faces with mass; faces
// at open sides have their diagonal alone; its product with the residual
//   compute    float32
//   box        float32 z, cycle, r, volume, diagonal, cell; int8 kind
//   numbers    int axis
//   sums       square
//   constants  FLUID
const long long steps[3] = {1, s2, s1}, step = steps[axis];
const int begin =
    (axis == 1 && j == 0) || (axis == 2 && k == 0) ? last : (axis == 0 && first == 0 ? 1 : first);
double sum = 0.0;
for (int i = begin; i < last; ++i) {
    float v = 0.0f;
    if (volume[i] > 0.0f)
        v = diagonal[i] > 0.0f ? cycle[i]
                               : r[i] / (volume[i] + cell[kind[i] == FLUID ? i : i - step]);
    z[i] = v;
    sum += (double)v * r[i];
}
square = sum;

// kernel fluids.stokes.energy: Mass times the square of a velocity, and velocity times a force
//   compute    float32
//   box        float32 u, force, volume, diagonal
//   sums       kinetic, power
EXACT_MATH  // the sums of a row do not depend on where the window ends
    double kinetic_sum = 0.0,
           power_sum = 0.0;
for (int i = first; i < last; ++i) {
    if (!(volume[i] > 0.0f)) continue;
    kinetic_sum += (double)volume[i] * u[i] * u[i];
    power_sum += diagonal[i] > 0.0f ? (double)u[i] * force[i] : (double)volume[i] * u[i] * u[i];
}
kinetic = kinetic_sum;
power = power_sum;

// kernel fluids.stokes.difference: Difference a - b of two velocities on faces with mass, else 0
//   compute    float32
//   box        float32 out, a, b, volume
SIMD for (int i = first; i < last; ++i) out[i] = volume[i] > 0.0f ? a[i] - b[i] : 0.0f;

// kernel fluids.stokes.start_velocity: Take another velocity on faces with mass
//   compute    float32
//   box        float32 u, other, volume
SIMD for (int i = first; i < last; ++i) u[i] = volume[i] > 0.0f ? other[i] : u[i];

// kernel fluids.stokes.start_pressure: `ratio` times another pressure in cells that are FLUID in
// both kinds of cells
//   compute    float64
//   box        float64 x, other; int8 kind, other_kind
//   numbers    float64 ratio
//   constants  FLUID
for (int i = first; i < last; ++i)
    if (kind[i] == FLUID && other_kind[i] == FLUID) x[i] = ratio * other[i];

// kernel fluids.stokes.pressure_difference: Difference x - other in FLUID cells, else 0
//   compute    float64
//   box        float32 out; float64 x, other; int8 kind
//   constants  FLUID
for (int i = first; i < last; ++i) out[i] = kind[i] == FLUID ? (float)(x[i] - other[i]) : 0.0f;

// kernel fluids.stokes.add_velocity: Add a correction to a velocity on faces with mass
//   compute    float32
//   box        float32 u, more, volume
SIMD for (int i = first; i < last; ++i) u[i] += volume[i] > 0.0f ? more[i] : 0.0f;

// kernel fluids.stokes.add_pressure: Add a correction to the pressure of free cells
//   compute    float64
//   box        float64 x; float32 more; uint8 free
for (int i = first; i < last; ++i) x[i] += free[i] ? (double)more[i] : 0.0;
