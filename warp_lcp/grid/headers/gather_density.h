// Let a cell add up the particles around it.
#include "origin.h"
const T* position = (const T*)given.position.data;
const int nx = given.density.shape[2], ny = given.density.shape[1], nz = given.density.shape[0];
auto weight = [&](int axis, T x, int cell) {
    T d = grid_coordinate(x, origin[axis]) - ((T)cell + (T)0.5);
    d = d < 0 ? -d : d;
    const T outer = d < (T)1.5 ? (T)1.5 - d : (T)0;
    return d < (T)0.5 ? (T)0.75 - d*d : (T)0.5*outer*outer;
};
for (int i = first; i < last; ++i) {
    const int x0 = i > 0 ? i - 1 : 0, x1 = i + 1 < nx ? i + 1 : i, y0 = j > 0 ? j - 1 : 0, y1 = j + 1 < ny ? j + 1 : j;
    const int z0 = planes == 2 && k > 0 ? k - 1 : k, z1 = planes == 2 && k + 1 < nz ? k + 1 : k;
    T total = 0;
    for (int c = z0; c <= z1; ++c) for (int b = y0; b <= y1; ++b) {
        const long long row = c*s1 + b*s2;
        const int beyond = offsets[row + x1 + 1];
        for (long long p = offsets[row + x0]; p < beyond; ++p) {
            const T z = planes == 2 ? weight(2, position[3*p + 2], k) : (T)1;
            total += weight(0, position[3*p], i)*weight(1, position[3*p + 1], j)*z;
        }
    }
    density[i] = each*total;
}
