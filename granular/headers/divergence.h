// w = drive + div(m' u) of a cell, and the diagonal of the pressure's matrix there.
#include "openings.h"
// What passes a face counts by the face's mass: div(m u). A full cell cannot be compressed: it counts volume, div u, or else a block that
// falls would be squeezed at its front, where lighter faces let less out than comes in from behind. `passes` goes from one to the other.
auto passes = [](T mass, T full) INLINE { return mass + full*((T)1 - mass); };
auto fullness = [](T free) INLINE { const T c = (T)1 - free*(T)(1.0/NEARLY); return c < (T)0 ? (T)0 : c > (T)1 ? (T)1 : c; };
auto divergence = [&](long long i, T& diagonal) INLINE {
    const T full = fullness((T)drive[i]*(T)numbers[STEP_OF_CELL]);
    T w = (T)drive[i];
    UNROLL for (int axis = 0; axis < DIM; ++axis) {
        const long long o = i + s[axis];
        const T beyond = open(axis, o)*passes((T)mass[axis][o], full), here = open(axis, i)*passes((T)mass[axis][i], full);
        w += beyond*u[axis][o] - here*u[axis][i];
        diagonal += open(axis, o)*beyond*(T)inverse[axis][o] + open(axis, i)*here*(T)inverse[axis][i];
    }
    return w;
};
