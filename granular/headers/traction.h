// Friction of the wall in a cell, within `wall_bound` of its load, against the sand's slip along it: the mean of its faces' velocities by
// what is open of them, without the part along the wall's normal n. A layer holds the traction times the wall's area over what is open of
// the cell's two faces along an axis: so much a face takes of it for its own open part. The load is the pressure, which is all that keeps
// sand from going into the wall, and the weight of what no face of the cell stands for: of all that a cell holds with no sand upon it.
#include "shape.h"
#include "wall_bound.h"
const float* inverse[3] = XYZ(inverse); const T* u[3] = XYZ(u);
const float* weight = numbers + WEIGHT;
const T omega = RESIDUAL ? (T)1 : (T)numbers[SHEAR_STEP], beta = RESIDUAL ? (T)0 : (T)momentum[NOW_S];
const T ahead = (T)momentum[NEXT_S]*(T)numbers[LOOKAHEAD];
double es = 0, ee = 0, ss = 0, residual = 0;
for (int m = first; m < last; ++m) {
    const long long cell = cells[m];
    if (!(flags[cell] & HOLDS)) continue;
    const float* n = walls + 8*m;  // normal (3), area, what faces leave out along each axis (3), volume
    const T size = n[3], x = now[cell];
    T v[DIM], sum[DIM], across = 0, stiffest = 0, load = x;
    int main = 0;
    for (int a = 1; a < DIM; ++a) main = n[a]*n[a] > n[main]*n[main] ? a : main;
    const int alone = !(flags[cell - (n[main] > 0.0f ? s[main] : -s[main])] & HOLDS);
    for (int a = 0; a < DIM; ++a) {
        const long long o = cell + s[a];
        const T low = openings[a*layer + cell], high = openings[a*layer + o];
        sum[a] = low + high;
        v[a] = sum[a] > (T)0 ? (low*u[a][cell] + high*u[a][o])/sum[a] : (T)0;
        across += n[a]*v[a];
        load += n[a]*weight[a]*fraction[cell]*(alone ? n[7] : n[4 + a])/size;
        if (sum[a] > (T)0) {
            const T stiff = (T)2*size*(low*low*inverse[a][cell] + high*high*inverse[a][o])/(sum[a]*sum[a]);
            stiffest = stiff > stiffest ? stiff : stiffest;
        }
    }
    if (!(stiffest > (T)0)) continue;
    T tau[DIM], from[DIM], total = 0;
    for (int a = 0; a < DIM; ++a) {
        const long long at = (FIRST + 4*SHEARS + a)*layer + cell;
        const T old = now[at];
        from[a] = (RESIDUAL ? old : old + beta*(old - (T)before[at]))*sum[a]/size;
        tau[a] = from[a] - omega/stiffest*(v[a] - across*n[a]);
        total += tau[a]*tau[a];
    }
    const T bound = wall_bound(friction[numbers_of[m]], load > (T)0 ? load : (T)0);
    const T keep = total > bound*bound ? bound/sqrt(total) : (T)1;
    for (int a = 0; a < DIM; ++a) {
        if (!(sum[a] > (T)0)) continue;
        const long long at = (FIRST + 4*SHEARS + a)*layer + cell;
        const T scale = size/sum[a], old = (T)now[at], value = keep*tau[a];
        const T s_ = value - old/scale, e_ = value - from[a];
        es += stiffest*e_*s_; ee += stiffest*e_*e_; ss += stiffest*s_*s_;
        residual += RESIDUAL ? s_*s_ : e_*e_;
        if (!RESIDUAL) {
            before[at] = (float)old; now[at] = (float)(scale*value); point[at] = (float)(scale*(value + ahead*s_));
        }
    }
}
#include "wall_sums.h"
