// How near each cell is to yielding; found: cells that carry shear, yielded ones, what friction takes, the most of a fraction predicted.
#include "shape.h"
#include "rate_bound.h"
const float* share[3] = XYZ(share); const float* mass[3] = XYZ(mass); const double* rate[3] = XYZ(edge); const double* u[3] = XYZ(u);
const float* inverse[3] = XYZ(inverse);
#include "divergence.h"
for (int i = first; i < last; ++i) {
    if (!flags[i]) { ratio[i] = 0; continue; }  // no sand, no stress
    float size = 0; double e[3], mean = 0, fast2 = 0, diagonal = 0;
    const double w = divergence(i, diagonal);
    for (int axis = 0; axis < DIM; ++axis) {
        e[axis] = counted(axis, i)*(u[axis][i + s[axis]] - u[axis][i]); mean += e[axis]/DIM;
    }
    if (DIM == 2) { const float a = now[layer + i]; size = a*a; taken += a*(e[0] - e[1]); fast2 = (e[0] - e[1])*(e[0] - e[1]); }
    else for (int c = 0; c < NORMALS; ++c) {
        const float n = now[(1 + c)*layer + i];
        size += 0.5f*n*n; taken += n*(e[c] - mean); fast2 += 2*(e[c] - mean)*(e[c] - mean);
    }
    for (int d = 0; d < SHEARS; ++d) {
        float largest = 0; double fast = 0;
        for (int q = 0; q < 4; ++q) {
            const long long o = i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
            const float b = now[(FIRST + 4*d + q)*layer + i], part = share[d][o];
            if (part > 0.0f) { const float m = b < 0.0f ? -b : b; largest = m > largest ? m : largest; fast += part*fabs(rate[d][o]); }
            taken += (part > 0.0f ? part : -part)*b*rate[d][o];
        }
        size += largest*largest; fast2 += fast*fast;
    }
    const float bound = numbers[FRICTION]*now[i] + (flags[i] & SHEARS_HERE ? numbers[COHESION] : 0.0f)
        + (RATE ? (float)gained(sqrt(fast2), gain_at(now[i]), half_at(now[i])) : 0.0f);
    const bool carries = (flags[i] & SHEARS_HERE) && bound > 1e-12f;
    ratio[i] = carries ? sqrt(size)/bound : 0.0f;
    cells += carries; yielded += carries && ratio[i] > (float)RATIO_YIELDS;
    if (flags[i] & HOLDS) { const double over = -w*numbers[STEP_OF_CELL]; most = over > most ? over : most; }
}
