// A sweep over the pressure, the velocity kept up to date.
#include "shape.h"
#include "openings.h"
const float* mass[3] = XYZ(mass); const float* inverse[3] = XYZ(inverse); T* u[3] = XYZ(u);
for (int i = first; i < last; ++i) {
    float* x = now + i;
    if (!(flags[i] & HOLDS)) continue;
    T w = (T)drive[i], diagonal = 0;
    const T full = fullness(w*(T)numbers[STEP_OF_CELL]);
    for (int axis = 0; axis < DIM; ++axis) {
        const long long o = i + s[axis];
        const T beyond = passes((T)mass[axis][o], full), here = passes((T)mass[axis][i], full);
        w += beyond*u[axis][o] - here*u[axis][i];
        diagonal += beyond*(T)inverse[axis][o] + here*(T)inverse[axis][i];
    }
    if (!(diagonal > (T)0)) continue;
    const T floor_ = flags[i] & FIRM ? -(T)numbers[TENSION] : (T)0, to = (T)x[0] - (T)omega*w/diagonal;
    const float fresh = (float)(to > floor_ ? to : floor_); const T by = (T)fresh - (T)x[0];
    x[0] = fresh;
    for (int axis = 0; axis < DIM; ++axis) {
        u[axis][i + s[axis]] += (T)inverse[axis][i + s[axis]]*by;
        u[axis][i] -= (T)inverse[axis][i]*by;
    }
}
