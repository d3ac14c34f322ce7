// What `step.h` does to cells, for wall faces: a step of their copies, after that. TRIAL: after one that has left its stresses in `point`.
#include "shape.h"
#include "wall_face.h"
#include "light.h"
double es = 0, ee = 0, ss = 0, residual = 0;
const T* rates[3] = XYZ(edge);
const T omega = RESIDUAL ? (T)1 : (T)numbers[SHEAR_STEP], beta = RESIDUAL ? (T)0 : (T)momentum[NOW_S];
const T ahead = (T)momentum[NEXT_S]*(T)numbers[LOOKAHEAD];
auto start = [&](long long at) {
    const T x = (T)now[at];
    return RESIDUAL ? x : x + beta*(x - (T)before[at]);
};
const int end = last < active[0] ? last : active[0];
for (int m = first; m < end; ++m) {
    face(active[1 + m], start, TRIAL ? point : now, numbers + WEIGHT, omega, light,
        [&](int d, long long o) { return rates[d][o]; },
        [&](int, long long, long long slot, T, T value, T stiff) {
            if (TRIAL) { point[slot] = (float)value; return; }
            const T old = (T)now[slot], s_ = value - old, e_ = value - start(slot);
            es += 0.5*stiff*e_*s_; ee += 0.5*stiff*e_*e_; ss += 0.5*stiff*s_*s_;
            residual += 0.5*(RESIDUAL ? s_*s_ : e_*e_);
            if (!RESIDUAL) {
                before[slot] = (float)old; now[slot] = (float)value; point[slot] = (float)(value + ahead*s_);
            }
        });
}
#if !TRIAL
#include "wall_sums.h"
#endif
