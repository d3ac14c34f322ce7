// A sweep over the pressure, the velocity kept up to date.
#include "shape.h"
const float* mass[3] = XYZ(mass); const float* inverse[3] = XYZ(inverse); T* u[3] = XYZ(u);
#include "divergence.h"
for (int i = first; i < last; ++i) {
    float* x = now + i;
    if (!(flags[i] & HOLDS)) continue;
    T diagonal = 0;
    const T w = divergence(i, diagonal);
    if (!(diagonal > (T)0)) continue;
    const T floor_ = flags[i] & FIRM ? -(T)numbers[TENSION] : (T)0, to = (T)x[0] - (T)omega*w/diagonal;
    const float fresh = (float)(to > floor_ ? to : floor_); const T by = (T)fresh - (T)x[0];
    x[0] = fresh;
    for (int axis = 0; axis < DIM; ++axis) {
        u[axis][i + s[axis]] += (T)inverse[axis][i + s[axis]]*by;
        u[axis][i] -= (T)inverse[axis][i]*by;
    }
}
