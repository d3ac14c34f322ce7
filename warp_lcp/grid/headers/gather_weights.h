// Face (k, j, i) visits the particles of the cells around it; along x they are consecutive, a range a row of cells.
const T* position = (const T*)given.position.data; const T* velocity = (const T*)given.velocity.data;
const T* gradient = (const T*)given.gradient.data;
#include "nodes.h"
const int nx = given.field.shape[2], ny = given.field.shape[1], nz = given.field.shape[0];
for (int i = first; i < last; ++i) {
    // a particle in cell c reaches the nodes c and c + 1 of its own axis, c - 1 to c + 1 of the others
    const int x0 = i > 0 ? i - 1 : 0, x1 = axis == 0 || i + 1 >= nx ? i : i + 1;
    const int y0 = j > 0 ? j - 1 : 0, y1 = axis == 1 || j + 1 >= ny ? j : j + 1;
    const int z0 = planes == 1 ? k : (k > 0 ? k - 1 : 0), z1 = planes == 1 || axis == 2 || k + 1 >= nz ? k : k + 1;
    T momentum = 0, sum = 0;
    for (int c = z0; c <= z1; ++c) for (int b = y0; b <= y1; ++b) {
        const long long row = c*s1 + b*s2;
        const int beyond = offsets[row + x1 + 1];
        for (long long p = offsets[row + x0]; p < beyond; ++p) {
            int pi, pj, pk; T fx, fy, fz;
            nodes(p, pi, pj, pk, fx, fy, fz);
            const int di = i - pi, dj = j - pj, dk = planes == 2 ? k - pk : 0;
            if ((di | dj | dk) & ~1) continue;  // not one of the nodes around it
            const T w = (di ? fx : 1 - fx)*(dj ? fy : 1 - fy)*(planes == 1 ? (T)1 : dk ? fz : 1 - fz);
            T v = velocity[3*p + axis];
            if (gradient) {
                v += dx*(gradient[3*p]*((T)di - fx) + gradient[3*p + 1]*((T)dj - fy));
                if (planes == 2) v += dx*gradient[3*p + 2]*((T)dk - fz);
            }
            momentum += w*v;
            sum += w;
        }
    }
    weight[i] = sum;
    field[i] = sum > (T)TINY_WEIGHT ? momentum/sum : (T)0;
}
