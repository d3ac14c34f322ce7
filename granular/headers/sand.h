// Snippets that kernels of sand share: the grid, the yield set, walls.

// snippet shape: Field of stresses: its layers, see `granular.stress_layout`; the axes of each
// shear; offsets between layers and along each axis. Steps read 28 fields. The address of a row of
// each takes two registers; that of a field is an argument. On CUDA they therefore count cells from
// the first one of a field, and a thread has one cell (END). FIELD and FIELDS name fields, ROW
// comes before the row's values. Values read with AGAIN are loaded again, since the compiler cannot
// know that KEEP is never negative; otherwise 48 addresses are held while the cell yields.
#ifdef __CUDA_ARCH__
#define INLINE
#define UNROLL
#define FIELD(NAME) auto* NAME = given.NAME.data
#define FIELDS(NAME) {given.NAME##_x.data, given.NAME##_y.data, given.NAME##_z.data}
#define ROW (int)(k * s1 + j * s2)
#define END (begin + 1)
#define AGAIN(KEEP, CELL) ((KEEP) < (T)0 ? (CELL) + 1 : (CELL))
#else
#define FIELD(NAME) static_assert(true)
#define FIELDS(NAME) XYZ(NAME)
#define ROW 0
#define END end
#define AGAIN(KEEP, CELL) (CELL)
// Vectorized loops cannot call functions or contain loops: these are inlined and unrolled.
#define INLINE __attribute__((always_inline))
#define UNROLL PRAGMA(clang loop unroll(full))
#endif
#define XYZ(FIELD) {FIELD##_x, FIELD##_y, FIELD##_z}
enum { NORMALS = DIM == 3 ? 3 : 1, SHEARS = DIM == 3 ? 3 : 1, FIRST = 1 + NORMALS };
constexpr int ALPHA[3] = {0, 0, 1}, BETA[3] = {1, 2, 2};
const long long nx = given.share_x.shape[2],
                layer = nx * given.share_x.shape[1] * given.share_x.shape[0];
const long long s[3] = {1, nx, nx * given.share_x.shape[1]};

// snippet span: Span of a row: cells that hold sand, and the cells beside them.
const int* span = spans + 2 * (k * (long long)given.spans.shape[1] + j);
const int begin = first > span[0] ? first : span[0], end = last < span[1] ? last : span[1];
if (begin >= end) continue;

// snippet light: Sum of 1 / mass around an edge.
const float* inverse[3] = FIELDS(inverse);
auto light = [&](int d, long long o) {
    const int a = ALPHA[d], b = BETA[d];
    return (T)(inverse[a][o] + inverse[a][o - s[b]] + inverse[b][o] + inverse[b][o - s[a]]);
};

// snippet openings: Solids that cut cells (CUT): open part of a cell's lower faces, and the part of
// a cell that its differences along an axis stand for. CUT is 2 if some move: the last layer has
// the rate at which their walls free space for the cell's sand, times dx / volume [m/s].
#if CUT
auto open = [&](int axis, long long i) INLINE { return (T)openings[axis * layer + i]; };
auto counted = [&](int axis, long long i) INLINE { return (T)openings[(DIM + axis) * layer + i]; };
#else
auto open = [](int, long long) INLINE { return (T)1; };
auto counted = open;
#endif

// snippet rate_bound: mu(I) friction, which grows with the rate of shear [Jop, Forterre & Pouliquen
// 2006]: the radius is r + gain e/(e + half), with e the cell's rate of shear times dx [m/s]. Both
// `gain` and `half` are functions of the pressure; at e = half there is half of the gain.
auto gain_at = [&](T x) INLINE { return RATE && x > (T)0 ? (T)numbers[GAIN] * x : (T)0; };
auto half_at = [&](T x) INLINE { return RATE && x > (T)0 ? (T)numbers[HALFWAY] * sqrt(x) : (T)0; };
auto gained = [](T e, T gain, T half) INLINE { return e > (T)0 ? gain * e / (e + half) : (T)0; };

// snippet divergence: w = drive + div(m' u) of a cell, and the diagonal of the pressure's matrix
// there.
#include "openings"
// The flux through a face is weighted by the face's mass: div(m u). In a full cell, which cannot be
// compressed, it is the volume: div u. Otherwise a falling block would be compressed at its front,
// where lighter faces let less out than comes in from behind. `passes` blends the two.
auto passes = [](T mass, T full) INLINE { return mass + full * ((T)1 - mass); };
auto fullness = [](T free) INLINE {
    const T c = (T)1 - free * (T)(1.0 / NEARLY);
    return c<(T)0 ? (T)0 : c>(T) 1 ? (T)1 : c;
};
auto divergence = [&](long long i, T& diagonal) INLINE {
    const T full = fullness((T)drive[i] * (T)numbers[STEP_OF_CELL]);
    T w = (T)drive[i];
#if CUT > 1
    w += (T)openings[2 * DIM * layer + i];
#endif
    UNROLL for (int axis = 0; axis < DIM; ++axis) {
        const long long o = i + s[axis];
        const T beyond = open(axis, o) * passes((T)mass[axis][o], full),
                here = open(axis, i) * passes((T)mass[axis][i], full);
        w += beyond * u[axis][o] - here * u[axis][i];
        diagonal += open(axis, o) * beyond * (T)inverse[axis][o] +
                    open(axis, i) * here * (T)inverse[axis][i];
    }
    return w;
};

// snippet edges: Velocities that edges read and change.
#include "light"
const float* share[3] = FIELDS(share);
T* u[3] = FIELDS(u);
auto rate = [&](int d, long long o) {
    const int a = ALPHA[d], b = BETA[d];
    return (u[a][o] - u[a][o - s[b]]) + (u[b][o] - u[b][o - s[a]]);
};
// Change of the velocity by a change of an edge's stress.
auto shear = [&](int d, long long o, T by) {
    const int a = ALPHA[d], b = BETA[d];
    u[a][o] -= (T)inverse[a][o] * by;
    u[a][o - s[b]] += (T)inverse[a][o - s[b]] * by;
    u[b][o] -= (T)inverse[b][o] * by;
    u[b][o - s[a]] += (T)inverse[b][o - s[a]] * by;
};

// snippet yield: Projection onto the friction cone |n|^2 / 2 + sum_shears max_q b_q^2 <= r^2 in the
// metric |n|^2 / 2 + sum of b_q^2 / 4. With a multiplier mu, n shrinks by 1 + mu, and the largest
// |b_q| of a shear are cut to m = max_n S_n / (n + 4 mu), S_n the sum of the n largest of the four.
// mu is the root of 1/r - 1/sqrt(|n|^2/2 + sum m^2), which is nearly linear in mu. The box of
// Narain et al. bounds each part on its own: |n|^2 / 2 <= r^2, |b_q| <= r. RATE: a step of `soft`
// leaves the rate of shear e = mu r / soft, by which r itself grows. The step is that of backward
// Euler, whose state at rest does not depend on its length. Newton's line for 1/size meets 1/r(e)
// where r(e) (size - slope mu) + slope soft e = size^2, a quadratic for e.
auto larger = [](T a, T b) INLINE { return a > b ? a : b; };
auto smaller = [](T a, T b) INLINE { return a < b ? a : b; };
auto magnitude = [](T a) INLINE { return a < (T)0 ? -a : a; };
// Factor by which n shrinks, and the largest |b| of each shear.
auto yield = [&](T normal2, const T (&largest)[SHEARS][4], T static_, T gain, T half, T soft,
                 T (&cap)[SHEARS]) INLINE {
    T r = static_, e = 0;
    if (BOX) {
        for (int d = 0; d < SHEARS; ++d) cap[d] = r;
        return smaller(r / larger(sqrt(normal2), (T)LEAST_RADIUS), (T)1);
    }
    const T inverse_r = (T)1 / (RATE ? r + gain : r), all = sqrt(normal2);
    T mu = all * inverse_r - (T)1, size = 0;  // a lower bound: each part on its own must fit
    UNROLL for (int d = 0; d < SHEARS; ++d) UNROLL for (int n = 0; n < 4; ++n) mu =
        larger(mu, (T)0.25 * (largest[d][n] * inverse_r - (T)(n + 1)));
    mu = larger(mu, (T)0);
    T shrink = 0;
    UNROLL for (int iteration = 0; iteration <= NEWTON; ++iteration) {
        shrink = (T)1 / ((T)1 + mu);
        T by[4];
        UNROLL for (int n = 0; n < 4; ++n) by[n] = (T)1 / ((T)(n + 1) + (T)4 * mu);
        const T a2 = normal2 * shrink * shrink;
        T total = a2, slope = a2 * shrink;
        UNROLL for (int d = 0; d < SHEARS; ++d) {
            T m = largest[d][0] * by[0], rate = by[0];
            UNROLL for (int n = 1; n < 4; ++n) {
                const T other = largest[d][n] * by[n];
                rate = other > m ? by[n] : rate;
                m = larger(m, other);
            }
            cap[d] = m;
            total += m * m;
            slope += m * m * (T)4 * rate;
        }
        size = sqrt(total);
        if (RATE && iteration < NEWTON) {
            const T along = slope / larger(total, (T)LEAST_RADIUS), rest = (T)1 - along * mu,
                    by_rate = along * soft, q = size - rest * static_;
            const T p = by_rate * half + rest * gain - q,
                    root = sqrt(p * p + (T)4 * larger(by_rate * q * half, (T)0));
            const T above = p > (T)0 ? (T)2 * q * half : root - p,
                    below = p > (T)0 ? p + root : larger((T)2 * by_rate, (T)LEAST_RADIUS);
            e = q > (T)0 ? above / below : (T)0;
            mu = e > (T)0 ? soft * e * (e + half) / (static_ * (e + half) + gain * e) : (T)0;
        } else if (iteration < NEWTON) {
            const T step = (size * inverse_r - (T)1) * total / larger(slope, (T)LEAST_RADIUS);
            mu = larger(mu + step, (T)0);
        }
    }
    if (RATE) r += gained(e, gain, half);
    const T onto = smaller(r / larger(size, (T)LEAST_RADIUS), (T)1);
    UNROLL for (int d = 0; d < SHEARS; ++d) cap[d] *= onto;
    return onto * shrink;
};
// sums of the one, two, three and four largest
auto sums = [&](T a, T b, T c, T d, T (&out)[4]) INLINE {
    const T ab = larger(a, b), ba = smaller(a, b), cd = larger(c, d), dc = smaller(c, d);
    const T low = smaller(ab, cd), high = larger(ba, dc);
    out[0] = larger(ab, cd);
    out[1] = out[0] + larger(low, high);
    out[2] = out[1] + smaller(low, high);
    out[3] = out[2] + smaller(ba, dc);
};

// snippet wall_bound: Largest friction of a wall under a load >= 0: mu times the load (Coulomb),
// and at most what the sand beside it bears in simple shear at any rate. On a wall rougher than
// sand it is the sand that fails, in a band thinner than a cell. Without this bound a column of
// depth h that is pushed between walls a distance l apart loads itself by exp(2 mu h / l)
// (Janssen), and walls that stick leave it no stress at all.
auto wall_bound = [&](float mu, auto load) {
    const auto wall = mu * load,
               sand = (numbers[FRICTION] + numbers[GAIN]) * load + numbers[COHESION];
    return wall < sand ? wall : sand;
};

// snippet wall_face: Friction on a wall face of a cell: the copies on its edges, two of each shear,
// within `wall_bound` of the normal load, in the metric sum b_q^2 / 2. The load is that of the
// face: x - n at the cell's center, plus the weight W / 2 of the half cell before it. Of the half
// beyond the center, the pressure bears x; the wall bears the rest, if x < W / 2. So sand at rest
// without more sand on top, with x = W / 2, and a cell without pressure both load it with W.
// `rate` and `light`: rate of shear of an edge, and the sum of 1 / mass around it.
// `from`: start of a copy's step. `store` receives its new value and the face's diagonal.
#include "wall_bound"
const float* shares[3] = XYZ(share);
auto face = [&](int entry, auto from, const float* now, const float* weight, T omega, auto light,
                auto rate, auto store) {
    const long long cell = cells[entry];
    const int axis = sides[entry] >> 1, side = sides[entry] & 1;
    const float x = now[cell], n = DIM == 3 ? now[(1 + axis) * layer + cell]
                                            : (axis == 0 ? 1.0f : -1.0f) * now[layer + cell];
    const float toward = (side ? 1.0f : -1.0f) * weight[axis],
                half = 0.5f * toward * fraction[cell], rest = half - (x > 0.0f ? x : 0.0f),
                load = x - n + half + (rest > 0.0f ? rest : 0.0f);
    const T bound = wall_bound(friction[walls[entry]], load > 0.0f ? load : 0.0f);
    T b[2][2], most[2] = {0, 0}, sum[2] = {0, 0}, stiffest = 0, share[2][2];
    long long slot[2][2], at[2][2];
    int shear[2] = {0, 0};
    for (int t = 0; t < DIM - 1; ++t) {
        const int d = DIM == 2 ? 0 : (axis == 0 ? t : axis == 1 ? 2 * t : 1 + t);
        shear[t] = d;
        for (int m = 0; m < 2; ++m) {
            const int q = ALPHA[d] == axis ? side + 2 * m : m + 2 * side;
            at[t][m] = cell + (q & 1) * s[ALPHA[d]] + (q >> 1) * s[BETA[d]];
            slot[t][m] = (FIRST + 4 * d + q) * layer + cell;
            share[t][m] = shares[d][at[t][m]] < 0.0f ? -(T)shares[d][at[t][m]] : (T)0;
            if (share[t][m] > (T)0) {
                const T stiff = (T)2 * share[t][m] * light(d, at[t][m]);
                stiffest = stiff > stiffest ? stiff : stiffest;
            }
        }
    }
    if (!(stiffest > (T)0)) return;
    for (int t = 0; t < DIM - 1; ++t)
        for (int m = 0; m < 2; ++m) {
            b[t][m] = share[t][m] > (T)0
                          ? from(slot[t][m]) +
                                omega * (T)2 / stiffest * share[t][m] * rate(shear[t], at[t][m])
                          : (T)0;
            const T size = b[t][m] < (T)0 ? -b[t][m] : b[t][m];
            sum[t] += size;
            most[t] = size > most[t] ? size : most[t];
        }
    T cap[2] = {0, 0}, total = 0, slope = 0, mu = 0, onto = 0;
    auto cut_at = [&]() {
        total = 0;
        slope = 0;
        for (int t = 0; t < DIM - 1; ++t) {
            const T one = most[t] / ((T)1 + (T)2 * mu), two = sum[t] / ((T)2 + (T)2 * mu);
            cap[t] = one > two ? one : two;
            total += cap[t] * cap[t];
            slope += cap[t] * cap[t] * (T)2 / ((one > two ? (T)1 : (T)2) + (T)2 * mu);
        }
    };
    cut_at();
    if (bound > (T)LEAST_RADIUS) {
        for (int iteration = 0; iteration < NEWTON && total > bound * bound; ++iteration) {
            mu += (sqrt(total) / bound - (T)1) * total / slope;
            cut_at();
        }
        onto = total > bound * bound ? bound / sqrt(total) : (T)1;
    }
    for (int t = 0; t < DIM - 1; ++t)
        for (int m = 0; m < 2; ++m) {
            if (!(share[t][m] > (T)0)) continue;
            const T limit = cap[t] * onto, cut = b[t][m] > limit    ? limit
                                                 : b[t][m] < -limit ? -limit
                                                                    : b[t][m];
            store(shear[t], at[t][m], slot[t][m], share[t][m], cut, stiffest);
        }
};

// snippet wall_sums: Sums over entries of walls, behind those of other entries.
const double third = RESIDUAL ? work : es;
const double found[COLUMNS] = {RESIDUAL ? residual : 0, 0, 0, third, ee, ss, 0, residual};
for (int c = 0; c < COLUMNS; ++c)
    partials[c * (long long)(given.partials.shape[0] / COLUMNS) + behind + c_] = found[c];
