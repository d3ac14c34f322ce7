// Kernels of the stress solve, its forces on bodies, and its report.

// kernel granular.stress.edge_stress: Shear of an edge: mean of its copies
//   compute    float32 | float64
//   whole      int32 spans
//   box        float32 share_x, share_y?, share_z?, y; T edge_x, edge_y?, edge_z?
//   constants  DIM, BOX = 0
#include "sand.h:shape"
#include "sand.h:span"
const float* share[3] = XYZ(share);
T* out[3] = XYZ(edge);
for (int d = 0; d < SHEARS; ++d) {
    const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
    const float* c0 = y + (FIRST + 4 * d) * layer;
    const float* c1 = c0 + layer - sa;
    const float* c2 = c0 + 2 * layer - sb;
    const float* c3 = c0 + 3 * layer - sa - sb;
    const float* weight = share[d];
    T* b = out[d];
    MASKED for (int i = begin; i < end; ++i) {
        const T w = weight[i] < 0.0f ? -weight[i] : weight[i];
        b[i] = w * (((T)c0[i] + (T)c1[i]) + ((T)c2[i] + (T)c3[i]));
    }
}

// kernel granular.stress.face_velocity: Velocity under a stress: u = u* + (div sigma) / mass, sigma
// = -x + s. On a face that a solid cuts, the pressure acts on the open part, and the deviator by
// the part of the cell that it stands for (the adjoint of its rate of strain); the tractions of the
// walls in both cells are added.
//   compute    float32 | float64
//   whole      int32 spans
//   box        float32 share_x, y; T edge_x, edge_y?, edge_z?; float32 start_x, start_y?, start_z?,
//              inverse_x, inverse_y?, inverse_z?, openings?; T u_x, u_y?, u_z?
//   constants  DIM, BOX = 0, CUT = 0
#include "sand.h:shape"
#include "sand.h:span"
#include "sand.h:openings"
const T* b[3] = XYZ(edge);
const float* start[3] = XYZ(start);
const float* inverse[3] = XYZ(inverse);
T* out[3] = XYZ(u);
for (int axis = 0; axis < DIM; ++axis) {
    const long long sa = s[axis];
    const float* n = y + (DIM == 3 ? 1 + axis : 1) * layer;
    const T sign = DIM == 2 && axis == 1 ? (T)-1 : (T)1;
    const long long traction = (FIRST + 4 * SHEARS + axis) * layer;
    // the two shears on this face: (shear, other axis)
    const int d0 = axis == 2 ? 1 : 0, d1 = axis == 0 ? 1 : 2, o0 = axis == 0 ? 1 : 0,
              o1 = axis == 2 ? 1 : 2;
    const T* b0 = b[d0];
    const T* b1 = DIM == 3 ? b[d1] : b[d0];
    const long long t0 = s[o0], t1 = DIM == 3 ? s[o1] : 0;
    const float* from = start[axis];
    const float* light = inverse[axis];
    T* u = out[axis];
    // beyond the domain's last face
    if ((axis != 2 && k > given.y.shape[1] - 2) || (axis != 1 && j > given.y.shape[2] - 2))
        continue;
    const int far = axis == 0 || end < nx - 1 ? end : (int)nx - 1;
    MASKED for (int i = begin; i < far; ++i) {
#if CUT
        const T wall = (T)y[i + traction] + (T)y[i - sa + traction];
        const T normal = open(axis, i) * ((T)y[i - sa] - (T)y[i] + wall) +
                         sign * (counted(axis, i) * (T)n[i] - counted(axis, i - sa) * (T)n[i - sa]);
#else
        const T normal = (sign * (T)n[i] - (T)y[i]) - (sign * (T)n[i - sa] - (T)y[i - sa]);
#endif
        const T shear = (b0[i + t0] - b0[i]) + (b1[i + t1] - b1[i]);
        u[i] = (T)from[i] + (T)light[i] * (normal + shear);
    }
}

// kernel granular.stress.edge_strain: Twice the shear rate of an edge, times dx
//   compute    float32 | float64
//   whole      int32 spans
//   box        float32 share_x; T u_x, u_y?, u_z?, edge_x, edge_y?, edge_z?
//   constants  DIM, BOX = 0
#include "sand.h:shape"
#include "sand.h:span"
const T* u[3] = XYZ(u);
T* out[3] = XYZ(edge);
for (int d = 0; d < SHEARS; ++d) {
    const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
    const T* ua = u[ALPHA[d]];
    const T* ub = u[BETA[d]];
    T* rate = out[d];
    MASKED for (int i = begin; i < end; ++i) rate[i] = (ua[i] - ua[i - sb]) + (ub[i] - ub[i - sa]);
}

// kernel granular.stress.step: One projected step with momentum for every cell that holds sand:
// from y = x + beta (x - x_before) against the gradient over the diagonal, onto x >= floor and the
// yield set of the new x. `point` becomes the place of the next gradient, x + lookahead beta (x -
// x_before). Sums of pressure (0, 1, 2) and of friction (3, 4, 5) in the metric of the diagonal:
// <e, s>, <e, e>, <s, s> with the error of the projection e = x_new - y and the step s = x_new - x;
// 6, 7: estimates of the squared natural residuals of both. RESIDUAL: a step of length 1 from the
// stresses themselves; nothing is changed. Sums 0 and 1 are the squared natural residuals, 2 the
// squared stresses, and 3 the work of the error of `Stress.take_residual`.
// TRIAL: no sums; the new stresses go to `point` alone, which a step no longer needs once the
// velocity there is known.
//   compute    float32 | float64
//   whole      int32 spans; float64 momentum; float32 numbers; float64 partials
//   box        uint8 flags; float32 now, before, point, past, drive, stiff, openings?, share_x,
//              share_y?, share_z?, mass_x, mass_y?, mass_z?, inverse_x, inverse_y?, inverse_z?; T
//              edge_x, edge_y?, edge_z?, u_x, u_y?, u_z?
//   constants  NEWTON, COLUMNS, LEAST_RADIUS, FRICTION, COHESION, TENSION, PRESSURE_STEP,
//              SHEAR_STEP, LOOKAHEAD, HOLDS, SHEARS_HERE, FIRM, STEP_OF_CELL, NEARLY, GAIN,
//              HALFWAY, RATIO, UNSURE, DIM, BOX = 0, RATE = 0, CUT = 0, RESIDUAL, TRIAL = 0, NOW_X,
//              NOW_S, NEXT_X, NEXT_S
#if !TRIAL
const long long columns = given.partials.shape[0] / COLUMNS;
double* partial = partials + (k * (long long)given.flags.shape[1] + j) * L.chunks + c_;
for (int c = 0; c < COLUMNS; ++c) partial[c * columns] = 0;
#endif
#include "sand.h:shape"
#include "sand.h:span"
#include "sand.h:rate_bound"
#include "sand.h:yield"
const float* share[3] = FIELDS(share);
const float* mass[3] = FIELDS(mass);
const float* inverse[3] = FIELDS(inverse);
const T* rate[3] = FIELDS(edge);
const T* u[3] = FIELDS(u);
FIELD(flags);
FIELD(now);
FIELD(before);
FIELD(point);
#if RESIDUAL
FIELD(past);
#endif
FIELD(drive);
FIELD(stiff);
FIELD(openings);
#include "sand.h:divergence"
const T beta_x = RESIDUAL ? (T)0 : (T)momentum[NOW_X],
        beta_s = RESIDUAL ? (T)0 : (T)momentum[NOW_S];
const T ahead_x = (T)momentum[NEXT_X] * (T)numbers[LOOKAHEAD],
        ahead_s = (T)momentum[NEXT_S] * (T)numbers[LOOKAHEAD];
const T k_yield = (T)numbers[FRICTION], cohesion = (T)numbers[COHESION];
const T least = -(T)numbers[TENSION];
const T pressure_step = RESIDUAL ? (T)1 : (T)numbers[PRESSURE_STEP],
        stress_step = RESIDUAL ? (T)1 : (T)numbers[SHEAR_STEP];
auto start = [&](int c, long long i, T beta) INLINE {
    const T x = (T)now[c * layer + i];
    return RESIDUAL ? x : x + beta * (x - (T)before[c * layer + i]);
};
T x_es = 0, x_ee = 0, x_ss = 0, s_es = 0, s_ee = 0, s_ss = 0, x_residual = 0, s_residual = 0;
#if RESIDUAL
const T ratio = (T)numbers[RATIO], unsure = (T)numbers[UNSURE];
T carried = 0, error_work = 0;
#endif
MASKED for (int i = begin + ROW; i < END + ROW; ++i) {
    const int sand = flags[i] & HOLDS, dense = flags[i] & SHEARS_HERE, firm = flags[i] & FIRM;
    T diagonal = 0, e[DIM], mean = 0;
    const T w = divergence(i, diagonal);
    UNROLL for (int axis = 0; axis < DIM; ++axis) {
        e[axis] = counted(axis, i) * (u[axis][i + s[axis]] - u[axis][i]);
        mean += e[axis];
    }
    mean *= (T)1 / (T)DIM;
    const int loaded = (sand != 0) & (int)(diagonal > (T)0);
    const T per = loaded ? pressure_step / larger(diagonal, (T)1e-6) : (T)0,
            y = start(0, i, beta_x), x0 = y - per * w;
    const T floor_ = firm ? least : (T)0, x = loaded ? larger(x0, floor_) : (T)0;
    const T radius = larger(k_yield * x + (dense ? cohesion : (T)0), (T)0),
            r = larger(radius, (T)LEAST_RADIUS);
    const int sheared = (dense != 0) & (int)(stiff[i] > 0.0f) & (int)(radius > (T)LEAST_RADIUS);
    const T soft = stiff[i] > 0.0f ? stress_step / (T)stiff[i] : (T)0;
    T n[NORMALS], normal2 = 0;
    if (DIM == 2) {
        n[0] = start(1, i, beta_s) + soft * (e[0] - e[1]);
        normal2 = n[0] * n[0];
    } else
        UNROLL for (int c = 0; c < NORMALS; ++c) {
            n[c] = start(1 + c, i, beta_s) + (T)2 * soft * (e[c] - mean);
            normal2 += (T)0.5 * n[c] * n[c];
        }
    T b[SHEARS][4], largest[SHEARS][4], cap[SHEARS];
    UNROLL for (int d = 0; d < SHEARS; ++d) {
        T m[4];
        UNROLL for (int q = 0; q < 4; ++q) {
            const long long o = i + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]];
            const T part = share[d][o] > 0.0f ? (T)share[d][o] : (T)0;
            b[d][q] = start(FIRST + 4 * d + q, i, beta_s) + (T)4 * soft * part * rate[d][o];
            m[q] = part > (T)0 ? magnitude(b[d][q]) : (T)0;
        }
        sums(m[0], m[1], m[2], m[3], largest[d]);
    }
    const T shrink = yield(normal2, largest, r, gain_at(x), half_at(x), soft, cap),
            keep = sheared ? shrink : (T)0;
    const int cell = AGAIN(keep, i);
    T es = 0, ee = 0, ss = 0;
#if RESIDUAL
    T work = 0;
#endif
    // held: copies on walls belong to the walls
    auto put = [&](int c, T value, T from, T weight, T ahead, int held) INLINE {
        const long long at = c * layer + cell;
        const float old = now[at], earlier = before[at], ahead_of = point[at];
        const T s_ = value - (T)old, e_ = value - from, share_ = held ? (T)0 : weight;
        es += share_ * e_ * s_;
        ee += share_ * e_ * e_;
        ss += share_ * s_ * s_;
#if RESIDUAL
        carried += share_ * (T)old * (T)old;
        work += share_ * magnitude(s_) * (magnitude((T)old - ratio * (T)past[at]) + unsure);
#endif
        if (TRIAL)
            point[at] = held ? ahead_of : (float)value;
        else if (!RESIDUAL) {
            now[at] = held ? old : (float)value;
            before[at] = held ? earlier : old;
            point[at] = held ? ahead_of : (float)(value + ahead * s_);
        }
    };
    UNROLL for (int c = 0; c < NORMALS; ++c)
        put(1 + c, n[c] * keep, start(1 + c, cell, beta_s), DIM == 2 ? (T)1 : (T)0.5, ahead_s, 0);
    UNROLL for (int d = 0; d < SHEARS; ++d) UNROLL for (int q = 0; q < 4; ++q) {
        const long long o = cell + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]];
        const int c = FIRST + 4 * d + q;
        const T limit = sheared ? cap[d] : (T)0, cut = larger(smaller(b[d][q], limit), -limit);
        put(c, cut, start(c, cell, beta_s), (T)0.25, ahead_s, share[d][o] < 0.0f);
    }
    s_es += (T)stiff[i] * es;
    s_ee += (T)stiff[i] * ee;
    s_ss += (T)stiff[i] * ss;
    s_residual += RESIDUAL ? ss : ee;
    es = 0;
    ee = 0;
    ss = 0;
#if RESIDUAL
    error_work += (T)stiff[i] * work;
    work = 0;
#endif
    put(0, x, y, (T)1, ahead_x, 0);
    x_es += diagonal * es;
    x_ee += diagonal * ee;
    x_ss += diagonal * ss;
    x_residual += RESIDUAL ? ss : ee;
#if RESIDUAL
    error_work += diagonal * work;
#endif
}
#if RESIDUAL
partial[0] = x_residual;
partial[columns] = s_residual;
partial[2 * columns] = carried;
partial[3 * columns] = error_work;
#elif !TRIAL
const T found[COLUMNS] = {x_es, x_ee, x_ss, s_es, s_ee, s_ss, x_residual, s_residual};
for (int c = 0; c < COLUMNS; ++c) partial[c * columns] = found[c];
#endif

// kernel granular.bodies.step: As granular.stress.step, for listed cells beside bodies
//   compute    float32 | float64
//   whole      int32 cell, spans; float64 momentum; float32 numbers
//   box        uint8 flags; float32 now, before, point, drive, stiff, openings?, share_x, share_y?,
//              share_z?, mass_x, mass_y?, mass_z?, inverse_x, inverse_y?, inverse_z?; T edge_x,
//              edge_y?, edge_z?, u_x, u_y?, u_z?
//   listed     cell
//   constants  NEWTON, COLUMNS, LEAST_RADIUS, FRICTION, COHESION, TENSION, PRESSURE_STEP,
//              SHEAR_STEP, LOOKAHEAD, HOLDS, SHEARS_HERE, FIRM, STEP_OF_CELL, NEARLY, GAIN,
//              HALFWAY, DIM, BOX = 0, RATE = 0, CUT = 0, RESIDUAL, TRIAL = 0, NOW_X, NOW_S, NEXT_X,
//              NEXT_S
#include "granular.stress.step"

// kernel granular.stress.wall_step: The step for wall faces: a step of their copies, after that of
// the cells. TRIAL: after one that has left its stresses in `point`
//   compute    float32 | float64
//   whole      int32 cells; uint8 sides; int32 walls; float32 friction, fraction, now, before,
//              point, past; T edge_x, edge_y?, edge_z?; float32 share_x, share_y?, share_z?,
//              inverse_x, inverse_y?, inverse_z?; float64 momentum; float32 numbers; float64
//              partials
//   box        int32 active
//   numbers    int behind
//   constants  NEWTON, COLUMNS, LEAST_RADIUS, FRICTION, COHESION, WEIGHT, SHEAR_STEP, LOOKAHEAD,
//              GAIN, RATIO, UNSURE, DIM, BOX = 0, RESIDUAL, TRIAL = 0, NOW_S, NEXT_S
#include "sand.h:shape"
#include "sand.h:wall_face"
#include "sand.h:light"
double es = 0, ee = 0, ss = 0, residual = 0, work = 0;
const T* rates[3] = XYZ(edge);
const T omega = RESIDUAL ? (T)1 : (T)numbers[SHEAR_STEP],
        beta = RESIDUAL ? (T)0 : (T)momentum[NOW_S];
const T ahead = (T)momentum[NEXT_S] * (T)numbers[LOOKAHEAD];
auto start = [&](long long at) {
    const T x = (T)now[at];
    return RESIDUAL ? x : x + beta * (x - (T)before[at]);
};
const int end = last < active[0] ? last : active[0];
for (int m = first; m < end; ++m) {
    face(
        active[1 + m], start, TRIAL ? point : now, numbers + WEIGHT, omega, light,
        [&](int d, long long o) { return rates[d][o]; },
        [&](int, long long, long long slot, T, T value, T stiff) {
            if (TRIAL) {
                point[slot] = (float)value;
                return;
            }
            const T old = (T)now[slot], s_ = value - old, e_ = value - start(slot);
            es += 0.5 * stiff * e_ * s_;
            ee += 0.5 * stiff * e_ * e_;
            ss += 0.5 * stiff * s_ * s_;
            residual += 0.5 * (RESIDUAL ? s_ * s_ : e_ * e_);
#if RESIDUAL
            const T change = old - (T)numbers[RATIO] * (T)past[slot];
            work += 0.5 * stiff * fabs(s_) * (fabs(change) + (T)numbers[UNSURE]);
#endif
            if (!RESIDUAL) {
                before[slot] = (float)old;
                now[slot] = (float)value;
                point[slot] = (float)(value + ahead * s_);
            }
        });
}
#if !TRIAL
#include "sand.h:wall_sums"
#endif

// kernel granular.bodies.wall_step: As granular.stress.wall_step, for the walls of listed cells
//   compute    float32 | float64
//   whole      int32 cells; uint8 sides; int32 walls; float32 friction, fraction, now, before,
//              point; T edge_x, edge_y?, edge_z?; float32 share_x, share_y?, share_z?, inverse_x,
//              inverse_y?, inverse_z?; float64 momentum; float32 numbers
//   box        int32 active
//   constants  NEWTON, COLUMNS, LEAST_RADIUS, FRICTION, COHESION, WEIGHT, SHEAR_STEP, LOOKAHEAD,
//              GAIN, DIM, BOX = 0, RESIDUAL, TRIAL = 0, NOW_S, NEXT_S
#include "granular.stress.wall_step"

// kernel granular.stress.traction: Friction of the wall in a cell, within `wall_bound` of its load,
// against the slip of the sand along the wall. The slip is the mean of the velocities of the cell's
// faces, weighted by their open parts, relative to the wall's velocity if solids move (CUT = 2),
// without the part along the wall's normal n. A layer holds
// the traction times the wall's area over the open part of the cell's two faces along an axis; a
// face takes this times its own open part. The load is the pressure, which alone keeps sand from
// moving into the wall, and the weight of the part that no face of the cell stands for: of the
// whole cell if no sand is above it.
//   compute    float32 | float64
//   whole      float32 walls, friction; uint8 flags; float32 fraction, openings?, now, before,
//              point, past, share_x, inverse_x, inverse_y?, inverse_z?; T u_x, u_y?, u_z?; float64
//              momentum; float32 numbers; float64 partials
//   box        int32 cells, numbers_of
//   numbers    int behind
//   constants  COLUMNS, FRICTION, COHESION, WEIGHT, SHEAR_STEP, LOOKAHEAD, HOLDS, GAIN, RATIO,
//              UNSURE, DIM, BOX = 0, CUT, RESIDUAL, NOW_S, NEXT_S
#include "sand.h:shape"
#include "sand.h:wall_bound"
const float* inverse[3] = XYZ(inverse);
const T* u[3] = XYZ(u);
const float* weight = numbers + WEIGHT;
const T omega = RESIDUAL ? (T)1 : (T)numbers[SHEAR_STEP],
        beta = RESIDUAL ? (T)0 : (T)momentum[NOW_S];
const T ahead = (T)momentum[NEXT_S] * (T)numbers[LOOKAHEAD];
double es = 0, ee = 0, ss = 0, residual = 0, work = 0;
for (int m = first; m < last; ++m) {
    const long long cell = cells[m];
    if (!(flags[cell] & HOLDS)) continue;
    // normal (3), area, part that faces leave out along each axis (3), volume, velocity (3)
    const float* n = walls + (CUT > 1 ? 11 : 8) * m;
    const T size = n[3], x = now[cell];
    T v[DIM], sum[DIM], across = 0, stiffest = 0, load = x;
    int main = 0;
    for (int a = 1; a < DIM; ++a) main = n[a] * n[a] > n[main] * n[main] ? a : main;
    const int alone = !(flags[cell - (n[main] > 0.0f ? s[main] : -s[main])] & HOLDS);
    for (int a = 0; a < DIM; ++a) {
        const long long o = cell + s[a];
        const T low = openings[a * layer + cell], high = openings[a * layer + o];
        sum[a] = low + high;
        v[a] = sum[a] > (T)0 ? (low * u[a][cell] + high * u[a][o]) / sum[a] : (T)0;
#if CUT > 1
        v[a] -= sum[a] > (T)0 ? (T)n[8 + a] : (T)0;
#endif
        across += n[a] * v[a];
        load += n[a] * weight[a] * fraction[cell] * (alone ? n[7] : n[4 + a]) / size;
        if (sum[a] > (T)0) {
            const T stiff = (T)2 * size *
                            (low * low * inverse[a][cell] + high * high * inverse[a][o]) /
                            (sum[a] * sum[a]);
            stiffest = stiff > stiffest ? stiff : stiffest;
        }
    }
    if (!(stiffest > (T)0)) continue;
    T tau[DIM], from[DIM], total = 0;
    for (int a = 0; a < DIM; ++a) {
        const long long at = (FIRST + 4 * SHEARS + a) * layer + cell;
        const T old = now[at];
        from[a] = (RESIDUAL ? old : old + beta * (old - (T)before[at])) * sum[a] / size;
        tau[a] = from[a] - omega / stiffest * (v[a] - across * n[a]);
        total += tau[a] * tau[a];
    }
    const T bound = wall_bound(friction[numbers_of[m]], load > (T)0 ? load : (T)0);
    const T keep = total > bound * bound ? bound / sqrt(total) : (T)1;
    for (int a = 0; a < DIM; ++a) {
        if (!(sum[a] > (T)0)) continue;
        const long long at = (FIRST + 4 * SHEARS + a) * layer + cell;
        const T scale = size / sum[a], old = (T)now[at], value = keep * tau[a];
        const T s_ = value - old / scale, e_ = value - from[a];
        es += stiffest * e_ * s_;
        ee += stiffest * e_ * e_;
        ss += stiffest * s_ * s_;
        residual += RESIDUAL ? s_ * s_ : e_ * e_;
#if RESIDUAL
        const T change = (old - (T)numbers[RATIO] * (T)past[at]) / scale;
        work += stiffest * fabs(s_) * (fabs(change) + (T)numbers[UNSURE]);
#endif
        if (!RESIDUAL) {
            before[at] = (float)old;
            now[at] = (float)(scale * value);
            point[at] = (float)(scale * (value + ahead * s_));
        }
    }
}
#include "sand.h:wall_sums"

// kernel granular.stress.admit: Keep the last stresses where they have a place now: pressure where
// there is sand, shear where a cell carries it, copies where they have a share
//   compute    float32 | float64
//   box        uint8 flags; float32 stiff, share_x, share_y?, share_z?, now, before, point
//   numbers    float32 ratio
//   constants  HOLDS, SHEARS_HERE, DIM, BOX = 0, CUT = 0
#include "sand.h:shape"
const float* share[3] = XYZ(share);
auto put = [&](long long at, float value) {
    now[at] = value;
    before[at] = value;
    point[at] = value;
};
for (int i = first; i < last; ++i) {
    const int sand = flags[i] & HOLDS, sheared = (flags[i] & SHEARS_HERE) && stiff[i] > 0.0f;
    put(i, sand ? now[i] * ratio : 0.0f);
    for (int c = 0; c < NORMALS; ++c)
        put((1 + c) * layer + i, sheared ? now[(1 + c) * layer + i] * ratio : 0.0f);
    for (int d = 0; d < SHEARS; ++d)
        for (int q = 0; q < 4; ++q) {
            const float weight = share[d][i + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]]];
            const long long at = (FIRST + 4 * d + q) * layer + i;
            put(at, (weight > 0.0f && sheared) || (weight < 0.0f && sand) ? now[at] * ratio : 0.0f);
        }
    if (CUT)
        for (int c = FIRST + 4 * SHEARS; c < FIRST + 4 * SHEARS + DIM; ++c)
            put(c * layer + i, sand ? now[c * layer + i] * ratio : 0.0f);
}

// kernel granular.stress.damp: Subtract a part of the pattern that alternates in all directions,
// found in `source`, from `now`, which holds the same values
//   compute    float32 | float64
//   box        uint8 flags; float32 share_x, share_y?, share_z?, source, now
//   constants  SHEARS_HERE, PARTLY, DIM, BOX = 0, DAMPED
#include "sand.h:shape"
const float* share[3] = XYZ(share);
for (int i = first; i < last; ++i) {
    if (!(flags[i] & SHEARS_HERE) || flags[i] & PARTLY) continue;
    bool deep = true;
    float pattern = 0.0f;
    for (int c = DIM == 3 ? -1 : 0; c <= (DIM == 3 ? 1 : 0); ++c)
        for (int b = -1; b <= 1; ++b)
            for (int a = -1; a <= 1; ++a) {
                const long long o = i + a + b * s[1] + c * s[2];
                deep = deep && (flags[o] & SHEARS_HERE);
                const float weight = (a ? -0.25f : 0.5f) * (b ? -0.25f : 0.5f) *
                                     (DIM == 2 ? 1.0f
                                      : c      ? -0.25f
                                               : 0.5f);
                pattern += weight * source[o];
            }
    for (int d = 0; d < SHEARS; ++d)
        for (int q = 0; q < 4; ++q)
            deep = deep && share[d][i + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]]] > 0.0f;
    const float by = (float)DAMPED * pattern;
    if (!deep || source[i] < by) continue;
    now[i] = source[i] - by;
    for (int d = 0; d < SHEARS; ++d)
        for (int q = 0; q < 4; ++q)
            now[(FIRST + 4 * d + q) * layer + i] +=
                (DIM == 3 ? 0.5f : 1.0f) * ((q == 0 || q == 3) ? by : -by);
}

// kernel granular.report.report: How close each cell is to yielding. Sums: cells that carry shear,
// yielded ones, power of friction; `most`: the largest predicted fraction
//   compute    float64
//   whole      float32 numbers
//   box        uint8 flags; float32 now, drive, stiff, ratio, openings?, share_x, share_y?,
//              share_z?, mass_x, mass_y?, mass_z?, inverse_x, inverse_y?, inverse_z?; float64
//              edge_x, edge_y?, edge_z?, u_x, u_y?, u_z?
//   sums       cells, yielded, taken
//   largest    most
//   constants  FRICTION, COHESION, HOLDS, SHEARS_HERE, STEP_OF_CELL, NEARLY, GAIN, HALFWAY, DIM,
//              BOX = 0, RATE = 0, CUT = 0, RATIO_YIELDS
#include "sand.h:shape"
#include "sand.h:rate_bound"
const float* share[3] = XYZ(share);
const float* mass[3] = XYZ(mass);
const double* rate[3] = XYZ(edge);
const double* u[3] = XYZ(u);
const float* inverse[3] = XYZ(inverse);
#include "sand.h:divergence"
for (int i = first; i < last; ++i) {
    if (!flags[i]) {
        ratio[i] = 0;
        continue;
    }  // no sand, no stress
    float size = 0;
    double e[3], mean = 0, fast2 = 0, diagonal = 0;
    const double w = divergence(i, diagonal);
    for (int axis = 0; axis < DIM; ++axis) {
        e[axis] = counted(axis, i) * (u[axis][i + s[axis]] - u[axis][i]);
        mean += e[axis] / DIM;
    }
    if (DIM == 2) {
        const float a = now[layer + i];
        size = a * a;
        taken += a * (e[0] - e[1]);
        fast2 = (e[0] - e[1]) * (e[0] - e[1]);
    } else
        for (int c = 0; c < NORMALS; ++c) {
            const float n = now[(1 + c) * layer + i];
            size += 0.5f * n * n;
            taken += n * (e[c] - mean);
            fast2 += 2 * (e[c] - mean) * (e[c] - mean);
        }
    for (int d = 0; d < SHEARS; ++d) {
        float largest = 0;
        double fast = 0;
        for (int q = 0; q < 4; ++q) {
            const long long o = i + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]];
            const float b = now[(FIRST + 4 * d + q) * layer + i], part = share[d][o];
            if (part > 0.0f) {
                const float m = b < 0.0f ? -b : b;
                largest = m > largest ? m : largest;
                fast += part * fabs(rate[d][o]);
            }
            taken += (part > 0.0f ? part : -part) * b * rate[d][o];
        }
        size += largest * largest;
        fast2 += fast * fast;
    }
    const float bound =
        numbers[FRICTION] * now[i] + (flags[i] & SHEARS_HERE ? numbers[COHESION] : 0.0f) +
        (RATE ? (float)gained(sqrt(fast2), gain_at(now[i]), half_at(now[i])) : 0.0f);
    const bool carries = (flags[i] & SHEARS_HERE) && bound > 1e-12f;
    ratio[i] = carries ? sqrt(size) / bound : 0.0f;
    cells += carries;
    yielded += carries && ratio[i] > (float)RATIO_YIELDS;
    if (flags[i] & HOLDS) {
        const double over = -w * numbers[STEP_OF_CELL];
        most = over > most ? over : most;
    }
}
