// Kernels of surface tension. linear, cubic: coefficients of the distance as a function of the
// smooth share.

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
#include "pressure.h:pressure_face"
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
#include "pressure.h:pressure_face"
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
