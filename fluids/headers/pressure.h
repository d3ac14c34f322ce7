// Kernels of the pressure projection and of surface tension. linear, cubic: coefficients of the
// distance to the surface as a function of the smooth share.

// snippet pressure_face: Solids on a cell's lower faces, and the free surface between cells. In 2-D
// the third axis repeats the first one with a step of 0, so that its inflow equals its outflow.
const long long sz = planes == 2 ? s1 : 0;
const float* a[3] = {open_x, open_y, planes == 2 ? open_z : open_x};
const float* solid[3] = {solid_x, solid_y, planes == 2 ? solid_z : solid_x};
// `fraction`: open fraction of a cell's lower face; `passes`: velocity through it, open u + (1 -
// open) u_solid; `inverse_theta`: 1 / theta between two cells (ghost fluid method).
auto fraction = [&](int axis, long long i, long long s) {
    return CUT ? a[axis][CUT ? i : 0]
               : (((kind[i] == SOLID) | (kind[i - s] == SOLID)) ? 0.0f : 1.0f);
};
auto passes = [&](const float* u, int axis, long long i, long long s) {
    const double open = fraction(axis, i, s);
    return open * u[i] + (MOVING ? (1.0 - open) * solid[axis][MOVING ? i : 0] : 0.0);
};
auto inverse_theta = [&](long long i, long long n) {  // i is FLUID, n is AIR
    const float inverse = GHOST ? 1.0f - phi[GHOST ? n : 0] / phi[GHOST ? i : 0] : 1.0f;
    // beyond an open side there is air, whatever phi is
    const float least = inverse > 1.0f ? inverse : 1.0f;
    return least < (float)(1.0 / THETA_MIN) ? least : (float)(1.0 / THETA_MIN);
};
auto outflow = [&](const float* u, const float* v, const float* w, long long i) {
    return passes(u, 0, i + 1, 1) - passes(u, 0, i, 1) + passes(v, 1, i + s2, s2) -
           passes(v, 1, i, s2) + passes(w, 2, i + sz, sz) - passes(w, 2, i, sz);
};

// kernel fluids.pressure.prepare: Right-hand side b, lower bound, initial guess, and what the free
// surface adds to the diagonal of every cell
//   compute    float64
//   box        int8 kind; float32 open_x?, open_y?, open_z?, solid_x?, solid_y?, solid_z?, phi?, u,
//              v, w?; uint8 touch; float64 previous, b, lower?, start; float32 shift?, jump?
//   numbers    int planes; float64 ratio, adhesion
//   constants  FLUID, SOLID, AIR, LETS_GO, CUT, MOVING, GHOST, BOUNDED, THETA_MIN
#include "pressure_face"
if (planes != 2) w = u;
SIMD8 for (int i = first; i < last; ++i) {
    const int fluid = kind[i] == FLUID;
    const double y = outflow(u, v, w, i),
                 bound = BOUNDED && (touch[i] & LETS_GO) ? 0.0 - adhesion : -INFINITY,
                 x = previous[i] * ratio;
    b[i] = fluid ? y : 0.0;
    if (BOUNDED) lower[i] = fluid ? bound : -INFINITY;
    start[i] = fluid ? (x < bound ? bound : x) : 0.0;
}
// Where surface tension itself lowers the pressure at the wall further below that of the air, this
// pressure is the bound: air does not reach the wall before.
if (BOUNDED && jump) {
    const long long steps[6] = {-1, 1, -s2, s2, -sz, sz};
    for (int i = first; i < last; ++i) {
        if (lower[i] == -INFINITY) continue;
        double least = lower[i];
        for (int n = 0; n < 2 * planes + 2; ++n) {
            const long long air = i + steps[n];
            if (kind[air] != AIR) continue;
            const float pull = jump[i] < jump[air] ? jump[i] : jump[air];
            least = pull < least ? pull : least;
        }
        const double x = previous[i] * ratio;
        lower[i] = least;
        start[i] = x < least ? least : x;
    }
}
// Addition to the operator's diagonal for FLUID cells: air nearer than a cell away, and the air
// beyond open sides.
if (shift) {
    const int nx = given.kind.shape[2] - 2, ny = given.kind.shape[1] - 2,
              nz = given.kind.shape[0] - 2;
    auto nearer = [&](int axis, long long face, long long s, long long i, long long n, bool side) {
        return kind[n] == AIR
                   ? fraction(axis, face, s) * (inverse_theta(i, n) - (side ? 0.0f : 1.0f))
                   : 0.0f;
    };
    SIMD for (int i = first; i < last; ++i) {
        const float more =
            nearer(0, i + 1, 1, i, i + 1, i == nx) + nearer(0, i, 1, i, i - 1, i == 1) +
            nearer(1, i + s2, s2, i, i + s2, j == ny) + nearer(1, i, s2, i, i - s2, j == 1) +
            nearer(2, i + sz, sz, i, i + sz, k == nz) + nearer(2, i, sz, i, i - sz, k == 1);
        shift[i] = kind[i] == FLUID ? more : 0.0f;
    }
}

// kernel fluids.pressure.subtract_gradient: Subtract the pressure gradient, u -= (x_i - x_(i-1)) /
// theta, on open faces that touch FLUID and mark them 1; mark the other faces 0, or -1 inside
// solids of whole cells
//   compute    float64
//   box        int8 kind; float32 open_x?, open_y?, open_z?, solid_x?, solid_y?, solid_z?, phi?;
//              float64 x; float32 field; int8 known
//   numbers    int planes, axis
//   constants  FLUID, SOLID, AIR, CUT, MOVING, GHOST, THETA_MIN
#include "pressure_face"
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
const int edge =
    (axis == 1 && j == 0) || (axis == 2 && k == 0) ? last : (axis == 0 && first == 0 ? 1 : first);
for (int i = first; i < edge; ++i) known[i] = -1;  // lower faces of the ghost ring lie in the wall
SIMD8 for (int i = edge; i < last; ++i) {
    const int here = kind[i], below = kind[i - s], wet = (here == FLUID) | (below == FLUID);
    const float open = fraction(axis, i, s);
    const float inverse = !GHOST ? 1.0f
                                 : (here == AIR ? inverse_theta(i - s, i)
                                                : (below == AIR ? inverse_theta(i, i - s) : 1.0f));
    // cells of a source are SOLID, but their faces are open
    const int projected = wet & (open > 0.0f) & (here != SOLID) & (below != SOLID);
    field[i] -= projected ? (float)(x[i] - x[i - s]) * inverse : 0.0f;
    const int hidden = CUT ? 0 : (here == SOLID) & (below == SOLID);
    known[i] = projected ? 1 : (hidden ? -1 : 0);
}

// kernel fluids.pressure.support: Change of faces beside projected ones: open faces between AIR
// cells with weight from particles take the mean change of the projected faces beside them, up to
// `limit` [m/s] and not beyond the mean velocity of these; they are marked 2. Only projected faces
// are read, and no task writes to them here: the order does not matter.
//   compute    float64
//   box        int8 kind; float32 open_x?, open_y?, open_z?, solid_x?, solid_y?, solid_z?, phi?;
//              float64 x; float32 field; int8 known; float32 weight, jump?
//   numbers    int planes, axis; float32 limit
//   constants  FLUID, SOLID, AIR, CUT, MOVING, GHOST, THETA_MIN, TINY_WEIGHT
#include "pressure_face"
const int nx = given.kind.shape[2], ny = given.kind.shape[1], nz = given.kind.shape[0];
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1), steps[6] = {-1, 1, -s2, s2, -s1, s1};
// Jump of surface tension on the face, over theta; see `fluids.surface_tension.push`.
auto over = [&](long long liquid, long long air) {
    return jump[liquid] * (inverse_theta(liquid, air) - 1.0f) + jump[air];
};
const bool inside_y = j > 0 && j < (axis == 1 ? ny : ny - 1),
           inside_z = planes != 2 || (k > 0 && k < (axis == 2 ? nz : nz - 1));
const int low = first > 1 ? first : 1, end = axis == 0 ? nx : nx - 1,
          high = last < end ? last : end;
for (int i = low; i < high && inside_y && inside_z; ++i) {
    if (known[i] != 0 || !(weight[i] > (float)TINY_WEIGHT)) continue;
    if (kind[i] == SOLID || kind[i - s] == SOLID || !(fraction(axis, i, s) > 0.0f)) continue;
    const bool there[6] = {true,       i + 1 < nx,  true,
                           j + 1 < ny, planes == 2, planes == 2 && k + 1 < nz};
    float change = 0.0f, velocity = 0.0f;
    int found = 0;
    for (int n = 0; n < 6; ++n) {
        const long long e = there[n] ? i + steps[n] : i;
        if (known[e] != 1) continue;
        const float inverse = kind[e] == AIR
                                  ? inverse_theta(e - s, e)
                                  : (kind[e - s] == AIR ? inverse_theta(e, e - s) : 1.0f);
        change -= (float)(x[e] - x[e - s]) * inverse;
        if (jump && kind[e] != kind[e - s])
            change += kind[e] == AIR ? -over(e - s, e) : over(e, e - s);
        velocity += field[e];
        ++found;
    }
    if (found == 0) continue;
    change /= (float)found;
    const float gap = velocity / (float)found - field[i], size = change < 0.0f ? -change : change,
                most = gap < 0.0f ? -gap : gap;
    const float nearer = change * gap > 0.0f ? (size < most ? change : gap) : 0.0f,
                low = nearer > -limit ? nearer : -limit;
    field[i] += low < limit ? low : limit;
    known[i] = 2;
}

// kernel fluids.pressure.contact: Find the released cells, their number, and the largest |outflow|
// of the other FLUID cells [m/s], `worst`
//   compute    float64
//   box        int8 kind; float32 open_x?, open_y?, open_z?, solid_x?, solid_y?, solid_z?, phi?, u,
//              v, w?; uint8 touch; float64 x; uint8 contact
//   numbers    int planes; float64 threshold
//   sums       released
//   largest    worst
//   constants  FLUID, SOLID, AIR, TOUCHES, LETS_GO, RELEASED, HELD, CUT, MOVING, GHOST, BOUNDED,
//              THETA_MIN
#include "pressure_face"
if (planes != 2) w = u;
int found = 0;
double rest[M];
unsigned char leaves[M];
for (int from = first; from < last; from += M) {
    const int n = last - from < M ? last - from : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = from + m, fluid = kind[i] == FLUID;
        const double y = outflow(u, v, w, i), size = y < 0.0 ? -y : y;
        const int leaving =
            BOUNDED & fluid & ((touch[i] & LETS_GO) != 0) & (x[i] <= 0.0) & (y > threshold);
        contact[i] = leaving ? RELEASED : ((fluid & (touch[i] & TOUCHES)) ? HELD : 0);
        leaves[m] = leaving;
        rest[m] = (fluid & !leaving) ? size : 0.0;
    }
    for (int m = 0; m < n; ++m) {
        found += leaves[m];
        worst = rest[m] > worst ? rest[m] : worst;
    }
}
released = found;

// kernel fluids.pressure.count_fluid: Number of FLUID cells
//   compute    float64
//   box        int8 kind
//   sums       fluid
//   constants  FLUID
int found = 0;
SIMD for (int i = first; i < last; ++i) found += kind[i] == FLUID;
fluid = found;

// kernel tolerance.change: Change by the solve: guess = x - guess
//   compute    float64
//   reads      float64 x
//   writes     float64 guess
SIMD for (int k = 0; k < n; ++k) guess[k] = x[k] - guess[k];

// snippet smooth_share: Smooth share of liquid, 2 once - twice, and the distance to its surface
// [cells], > 0 outside, that a plane with this share has. Central differences of this distance are
// those of straight lines. Differences of the share itself would lose a fiftieth of the slope and
// add as much to the curvature.
auto share = [&](long long n) { return (float)2 * once[n] - twice[n]; };
auto distance = [&](long long n) {
    const float t = 0.5f - share(n), within = t < -0.45f ? -0.45f : (t > 0.45f ? 0.45f : t);
    return within * (linear + cubic * within * within);
};
auto slope = [&](long long i, long long s) { return 0.5f * (distance(i + s) - distance(i - s)); };

// kernel fluids.surface_tension.curvature: bend = curvature of the contours of the distance d,
// div(grad d / |grad d|) [1/cells], > 0 where the liquid bulges, in cells near the surface; else 0
//   compute    float32
//   box        float32 once, twice, bend
//   numbers    int planes; float32 linear, cubic, limit
//   constants  BAND
#include "smooth_share"
const int nz = given.once.shape[0], ny = given.once.shape[1], nx = given.once.shape[2];
const bool inside = j > 0 && j + 1 < ny && (planes != 2 || (k > 0 && k + 1 < nz));
const long long sz = planes == 2 ? s1 : 0;
for (int i = first; i < last; ++i) {
    bend[i] = 0;
    const T f = share(i);
    if (!inside || i == 0 || i + 1 == nx || f < (T)BAND || f > (T)(1 - BAND)) continue;
    const T here = (T)2 * distance(i), x = slope(i, 1), y = slope(i, s2), z = slope(i, sz);
    const T xx = distance(i + 1) + distance(i - 1) - here,
            yy = distance(i + s2) + distance(i - s2) - here;
    const T zz = distance(i + sz) + distance(i - sz) - here;
    auto mixed = [&](long long p, long long q) {
        return (T)0.25 * (distance(i + p + q) - distance(i + p - q) - distance(i - p + q) +
                          distance(i - p - q));
    };
    T sum = xx * (y * y + z * z) + yy * (x * x + z * z) + zz * (x * x + y * y) -
            (T)2 * x * y * mixed(1, s2);
    if (planes == 2) sum -= (T)2 * (x * z * mixed(1, sz) + y * z * mixed(s2, sz));
    const T steep = x * x + y * y + z * z, most = limit,
            curvature = steep > (T)1e-4 ? sum / (steep * sqrtf(steep)) : (T)0;
    bend[i] = curvature > most ? most : (curvature < -most ? -most : curvature);
}

// kernel fluids.surface_tension.jump: jump = scale times the curvature at the nearest point of the
// smooth surface, in cells beside the surface; else 0
//   compute    float32
//   box        float32 once, twice, bend, jump; int8 kind
//   numbers    int planes; float32 linear, cubic, scale
//   constants  FLUID, SOLID, AIR, FARTHEST
#include "smooth_share"
const int nz = given.once.shape[0], ny = given.once.shape[1], nx = given.once.shape[2];
const bool inside = j > 0 && j + 1 < ny && (planes != 2 || (k > 0 && k + 1 < nz));
const long long sz = planes == 2 ? s1 : 0;
for (int i = first; i < last; ++i) {
    jump[i] = 0;
    if (!inside || i == 0 || i + 1 == nx || kind[i] == SOLID) continue;
    const signed char other = kind[i] == FLUID ? AIR : FLUID;
    if (kind[i - 1] != other && kind[i + 1] != other && kind[i - s2] != other &&
        kind[i + s2] != other && kind[i - sz] != other && kind[i + sz] != other)
        continue;
    const T x = slope(i, 1), y = slope(i, s2), z = slope(i, sz), steep = x * x + y * y + z * z,
            most = (T)FARTHEST;
    T way = steep > (T)1e-4 ? -distance(i) / steep : (T)0;
    way = way > most ? most : (way < -most ? -most : way);
    T p[3] = {(T)i + way * x, (T)j + way * y, (T)k + way * z};
    const int ends[3] = {nx - 2, ny - 2, nz - 2};
    int c[3];
    for (int e = 0; e < 3; ++e) {
        p[e] = p[e] < 1 ? (T)1 : (p[e] > (T)ends[e] ? (T)ends[e] : p[e]);
        c[e] = (int)p[e];
        p[e] -= (T)c[e];
    }
    const T* q = bend + ((c[0]) + (c[1] - j) * s2 + (planes == 2 ? (c[2] - k) * s1 : 0));
    auto plane = [&](const T* r) {
        return (1 - p[1]) * ((1 - p[0]) * r[0] + p[0] * r[1]) +
               p[1] * ((1 - p[0]) * r[s2] + p[0] * r[s2 + 1]);
    };
    jump[i] = scale * (planes == 2 ? (1 - p[2]) * plane(q) + p[2] * plane(q + s1) : plane(q));
}

// kernel fluids.surface_tension.push: Add the pressure jump on the surface, over theta, to the
// faces that the surface crosses; see snippet pressure_face
//   compute    float32
//   box        int8 kind; float32 open_x?, open_y?, open_z?, solid_x?, solid_y?, solid_z?, phi,
//              jump, field
//   numbers    int planes, axis
//   constants  FLUID, SOLID, AIR, CUT, MOVING, GHOST, THETA_MIN
#include "pressure_face"
const int nx = given.kind.shape[2], ny = given.kind.shape[1], nz = given.kind.shape[0];
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
// cells of the ghost ring have no surface
const int lowest[3] = {axis == 0 ? 2 : 1, axis == 1 ? 2 : 1, planes != 2 ? 0 : (axis == 2 ? 2 : 1)};
const bool inside = j >= lowest[1] && j + 1 < ny && k >= lowest[2] && (planes != 2 || k + 1 < nz);
const int low = first > lowest[0] ? first : lowest[0], high = last < nx - 1 ? last : nx - 1;
for (int i = low; i < high && inside; ++i) {
    const bool wet = kind[i] == FLUID && kind[i - s] == AIR,
               dry = kind[i] == AIR && kind[i - s] == FLUID;
    if (!wet && !dry) continue;
    const long long liquid = wet ? i : i - s, air = wet ? i - s : i;
    // jump by linear interpolation, over theta
    const float over = jump[liquid] * (inverse_theta(liquid, air) - 1.0f) + jump[air];
    field[i] += wet ? over : -over;
}

// kernel fluids.surface_tension.surface_energy: Area of the surface and of the wetted walls, in
// faces of cells. The area is the sum of w(share) |grad d|, with a parabola w of the share whose
// integral across a surface is 1. Only cells whose neighbors have a distance count.
//   compute    float64
//   box        int8 kind; float32 open_x?, open_y?, open_z?, solid_x?, solid_y?, solid_z?, phi,
//              once, twice
//   numbers    int planes; float32 linear, cubic
//   sums       area, wetted
//   constants  FLUID, SOLID, AIR, CUT, MOVING, GHOST, THETA_MIN, HALF
#include "pressure_face"
#include "smooth_share"
const int nx = given.kind.shape[2];
for (int i = first; i < last; ++i) {
    const float raw = share(i), f = raw < 1.0f ? raw : 1.0f, t = f - 0.5f,
                u = t * t / (float)(HALF * HALF);
    if (kind[i] == SOLID || i == 0 || i + 1 == nx || f <= 0.0f) continue;
    const float x = slope(i, 1), y = slope(i, s2), z = slope(i, sz);
    area += (double)(u < 1.0f ? 0.75f / (float)HALF * (1.0f - u) * sqrtf(x * x + y * y + z * z) /
                                    (linear + 3.0f * cubic * t * t)
                              : 0.0f);
    const float ax = fraction(0, i + 1, 1) - fraction(0, i, 1),
                ay = fraction(1, i + s2, s2) - fraction(1, i, s2);
    const float az = fraction(2, i + sz, sz) - fraction(2, i, sz);
    wetted += (double)(f * sqrtf(ax * ax + ay * ay + az * az));
}

// kernel fluids.pressure.last_right_side: Right-hand side b - A x of the last projection, which
// corrects a pressure x, and the first guess x. `start` has A x before
//   compute    float64
//   box        float64 b, start, x
for (int i = first; i < last; ++i) {
    b[i] -= start[i];
    start[i] = x[i];
}

// kernel fluids.pressure.change: Difference of pressures after and before the last projection
//   compute    float64
//   box        float64 out, x, before; int8 kind
//   constants  FLUID
for (int i = first; i < last; ++i) out[i] = kind[i] == FLUID ? x[i] - before[i] : 0.0;

// kernel fluids.pressure.sum_pressure: Add the pressure before the last projection
//   compute    float64
//   box        float64 x, before; int8 kind
//   constants  FLUID
for (int i = first; i < last; ++i) x[i] += kind[i] == FLUID ? before[i] : 0.0;
