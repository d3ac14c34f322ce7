// The velocity that a stress leaves: u = u* + (div sigma) / mass, sigma = -x + s. On a face that a solid cuts the pressure acts on what is
// open, the deviator by what it stands for in the cell (the adjoint of its rate of strain), and the tractions of the walls in both cells.
#include "shape.h"
#include "span.h"
#include "openings.h"
const T* b[3] = XYZ(edge);
const float* start[3] = XYZ(start); const float* inverse[3] = XYZ(inverse);
T* out[3] = XYZ(u);
for (int axis = 0; axis < DIM; ++axis) {
    const long long sa = s[axis];
    const float* n = y + (DIM == 3 ? 1 + axis : 1)*layer;
    const T sign = DIM == 2 && axis == 1 ? (T)-1 : (T)1;
    const long long traction = (FIRST + 4*SHEARS + axis)*layer;
    // the two shears on this face: (shear, other axis)
    const int d0 = axis == 2 ? 1 : 0, d1 = axis == 0 ? 1 : 2, o0 = axis == 0 ? 1 : 0, o1 = axis == 2 ? 1 : 2;
    const T* b0 = b[d0]; const T* b1 = DIM == 3 ? b[d1] : b[d0]; const long long t0 = s[o0], t1 = DIM == 3 ? s[o1] : 0;
    const float* from = start[axis]; const float* light = inverse[axis]; T* u = out[axis];
    if ((axis != 2 && k > given.y.shape[1] - 2) || (axis != 1 && j > given.y.shape[2] - 2)) continue;  // beyond the domain's last face
    const int far = axis == 0 || end < nx - 1 ? end : (int)nx - 1;
    MASKED for (int i = begin; i < far; ++i) {
    #if CUT
        const T wall = (T)y[i + traction] + (T)y[i - sa + traction];
        const T normal = open(axis, i)*((T)y[i - sa] - (T)y[i] + wall)
            + sign*(counted(axis, i)*(T)n[i] - counted(axis, i - sa)*(T)n[i - sa]);
    #else
        const T normal = (sign*(T)n[i] - (T)y[i]) - (sign*(T)n[i - sa] - (T)y[i - sa]);
    #endif
        const T shear = (b0[i + t0] - b0[i]) + (b1[i + t1] - b1[i]);
        u[i] = (T)from[i] + (T)light[i]*(normal + shear);
    }
}
