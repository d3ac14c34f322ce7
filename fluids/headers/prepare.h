// Right-hand side b, lower bound, first guess and what the free surface adds to the diagonal of every cell.
#include "pressure_face.h"
if (planes != 2) w = u;
SIMD8 for (int i = first; i < last; ++i) {
    const int fluid = kind[i] == FLUID;
    const double y = outflow(u, v, w, i), bound = BOUNDED && (touch[i] & LETS_GO) ? 0.0 - adhesion : -INFINITY, x = previous[i]*ratio;
    b[i] = fluid ? y : 0.0;
    if (BOUNDED) lower[i] = fluid ? bound : -INFINITY;
    start[i] = fluid ? (x < bound ? bound : x) : 0.0;
}
// Where the surface itself pulls by more, with a pressure below that of the air, no air gets to the wall before the pressure is below that.
if (BOUNDED && jump) {
    const long long steps[6] = {-1, 1, -s2, s2, -sz, sz};
    for (int i = first; i < last; ++i) {
        if (lower[i] == -INFINITY) continue;
        double least = lower[i];
        for (int n = 0; n < 2*planes + 2; ++n) {
            const long long air = i + steps[n];
            if (kind[air] != AIR) continue;
            const float pull = jump[i] < jump[air] ? jump[i] : jump[air];
            least = pull < least ? pull : least;
        }
        const double x = previous[i]*ratio;
        lower[i] = least;
        start[i] = x < least ? least : x;
    }
}
// What the diagonal of a FLUID cell has more than the operator knows: air nearer than a cell away, and the air beyond open sides.
if (shift) {
    const int nx = given.kind.shape[2] - 2, ny = given.kind.shape[1] - 2, nz = given.kind.shape[0] - 2;
    auto nearer = [&](int axis, long long face, long long s, long long i, long long n, bool side) {
        return kind[n] == AIR ? fraction(axis, face, s)*(inverse_theta(i, n) - (side ? 0.0f : 1.0f)) : 0.0f;
    };
    SIMD for (int i = first; i < last; ++i) {
        const float more = nearer(0, i + 1, 1, i, i + 1, i == nx) + nearer(0, i, 1, i, i - 1, i == 1)
            + nearer(1, i + s2, s2, i, i + s2, j == ny) + nearer(1, i, s2, i, i - s2, j == 1)
            + nearer(2, i + sz, sz, i, i + sz, k == nz) + nearer(2, i, sz, i, i - sz, k == 1);
        shift[i] = kind[i] == FLUID ? more : 0.0f;
    }
}
