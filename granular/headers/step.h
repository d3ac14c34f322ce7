// One projected step of every cell that holds sand, with momentum: from y = x + beta (x - x_before) against the gradient over the diagonal,
// onto x >= floor and the yield set of the new x. `point` becomes where the next gradient is taken, x + lookahead beta (x - x_before).
// Sums, of pressure (0, 1, 2) and of friction (3, 4, 5), in the metric of the diagonal: <e, s>, <e, e>, <s, s> with the error of the
// projection e = x_new - y and the step s = x_new - x; 6, 7: estimates of the squared natural residuals of both.
// RESIDUAL: from the stresses themselves with step 1, nothing is changed; sums 0 and 1 are the squared natural residuals.
// TRIAL: no sums, and the new stresses go to `point` alone, which a step no longer needs once it knows the velocity there.
#if !TRIAL
const long long columns = given.partials.shape[0]/COLUMNS;
double* partial = partials + (k*(long long)given.flags.shape[1] + j)*L.chunks + c_;
for (int c = 0; c < COLUMNS; ++c) partial[c*columns] = 0;
#endif
#include "shape.h"
#include "span.h"
#include "rate_bound.h"
#include "yield.h"
const float* share[3] = FIELDS(share); const float* mass[3] = FIELDS(mass); const float* inverse[3] = FIELDS(inverse);
const T* rate[3] = FIELDS(edge); const T* u[3] = FIELDS(u);
FIELD(flags) FIELD(now) FIELD(before) FIELD(point) FIELD(drive) FIELD(stiff) FIELD(openings)
#include "divergence.h"
const T beta_x = RESIDUAL ? (T)0 : (T)momentum[NOW_X], beta_s = RESIDUAL ? (T)0 : (T)momentum[NOW_S];
const T ahead_x = (T)momentum[NEXT_X]*(T)numbers[LOOKAHEAD], ahead_s = (T)momentum[NEXT_S]*(T)numbers[LOOKAHEAD];
const T k_yield = (T)numbers[FRICTION], cohesion = (T)numbers[COHESION];
const T least = -(T)numbers[TENSION];
const T pressure_step = RESIDUAL ? (T)1 : (T)numbers[PRESSURE_STEP], stress_step = RESIDUAL ? (T)1 : (T)numbers[SHEAR_STEP];
auto start = [&](int c, long long i, T beta) INLINE {
    const T x = (T)now[c*layer + i];
    return RESIDUAL ? x : x + beta*(x - (T)before[c*layer + i]);
};
T x_es = 0, x_ee = 0, x_ss = 0, s_es = 0, s_ee = 0, s_ss = 0, x_residual = 0, s_residual = 0;
MASKED for (int i = begin + ROW; i < END + ROW; ++i) {
    const int sand = flags[i] & HOLDS, dense = flags[i] & SHEARS_HERE, firm = flags[i] & FIRM;
    T diagonal = 0, e[DIM], mean = 0;
    const T w = divergence(i, diagonal);
    UNROLL for (int axis = 0; axis < DIM; ++axis) {
        e[axis] = counted(axis, i)*(u[axis][i + s[axis]] - u[axis][i]);
        mean += e[axis];
    }
    mean *= (T)1/(T)DIM;
    const int loaded = (sand != 0) & (int)(diagonal > (T)0);
    const T per = loaded ? pressure_step/larger(diagonal, (T)1e-6) : (T)0, y = start(0, i, beta_x), x0 = y - per*w;
    const T floor_ = firm ? least : (T)0, x = loaded ? larger(x0, floor_) : (T)0;
    const T radius = larger(k_yield*x + (dense ? cohesion : (T)0), (T)0), r = larger(radius, (T)LEAST_RADIUS);
    const int sheared = (dense != 0) & (int)(stiff[i] > 0.0f) & (int)(radius > (T)LEAST_RADIUS);
    const T soft = stiff[i] > 0.0f ? stress_step/(T)stiff[i] : (T)0;
    T n[NORMALS], normal2 = 0;
    if (DIM == 2) { n[0] = start(1, i, beta_s) + soft*(e[0] - e[1]); normal2 = n[0]*n[0]; }
    else UNROLL for (int c = 0; c < NORMALS; ++c) {
        n[c] = start(1 + c, i, beta_s) + (T)2*soft*(e[c] - mean);
        normal2 += (T)0.5*n[c]*n[c];
    }
    T b[SHEARS][4], largest[SHEARS][4], cap[SHEARS];
    UNROLL for (int d = 0; d < SHEARS; ++d) {
        T m[4];
        UNROLL for (int q = 0; q < 4; ++q) {
            const long long o = i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
            const T part = share[d][o] > 0.0f ? (T)share[d][o] : (T)0;
            b[d][q] = start(FIRST + 4*d + q, i, beta_s) + (T)4*soft*part*rate[d][o];
            m[q] = part > (T)0 ? magnitude(b[d][q]) : (T)0;
        }
        sums(m[0], m[1], m[2], m[3], largest[d]);
    }
    const T shrink = yield(normal2, largest, r, gain_at(x), half_at(x), soft, cap), keep = sheared ? shrink : (T)0;
    const int cell = AGAIN(keep, i);
    T es = 0, ee = 0, ss = 0;
    auto put = [&](int c, T value, T from, T weight, T ahead, int held) INLINE {  // held: the copies on walls are the walls'
        const long long at = c*layer + cell;
        const float old = now[at], earlier = before[at], ahead_of = point[at];
        const T s_ = value - (T)old, e_ = value - from, share_ = held ? (T)0 : weight;
        es += share_*e_*s_; ee += share_*e_*e_; ss += share_*s_*s_;
        if (TRIAL) point[at] = held ? ahead_of : (float)value;
        else if (!RESIDUAL) {
            now[at] = held ? old : (float)value;
            before[at] = held ? earlier : old;
            point[at] = held ? ahead_of : (float)(value + ahead*s_);
        }
    };
    UNROLL for (int c = 0; c < NORMALS; ++c) put(1 + c, n[c]*keep, start(1 + c, cell, beta_s), DIM == 2 ? (T)1 : (T)0.5, ahead_s, 0);
    UNROLL for (int d = 0; d < SHEARS; ++d) UNROLL for (int q = 0; q < 4; ++q) {
        const long long o = cell + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
        const int c = FIRST + 4*d + q;
        const T limit = sheared ? cap[d] : (T)0, cut = larger(smaller(b[d][q], limit), -limit);
        put(c, cut, start(c, cell, beta_s), (T)0.25, ahead_s, share[d][o] < 0.0f);
    }
    s_es += (T)stiff[i]*es; s_ee += (T)stiff[i]*ee; s_ss += (T)stiff[i]*ss;
    s_residual += RESIDUAL ? ss : ee;
    es = 0; ee = 0; ss = 0;
    put(0, x, y, (T)1, ahead_x, 0);
    x_es += diagonal*es; x_ee += diagonal*ee; x_ss += diagonal*ss;
    x_residual += RESIDUAL ? ss : ee;
}
#if RESIDUAL
partial[0] = x_residual; partial[columns] = s_residual;
#elif !TRIAL
const T found[COLUMNS] = {x_es, x_ee, x_ss, s_es, s_ee, s_ss, x_residual, s_residual};
for (int c = 0; c < COLUMNS; ++c) partial[c*columns] = found[c];
#endif
