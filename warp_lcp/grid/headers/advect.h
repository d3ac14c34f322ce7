// Move particles from cell to cell.
#include "particle_blocks.h"
#include "sample.h"
const long long stride[3] = {1, s2, s1};
const int counts[3] = {nx, ny, nz};
int begin[M], end[M], cells[M];
auto prepare = [](int) {};
// Move a particle from cell to cell along the straight line to its aim: a closed face stops it, it slides on along the face.
auto cell_of = [&](T x, int axis) {
    const T least = first_cell[axis], e = counts[axis]; x = x > least ? x : least; return floor_of(x < e ? x : e, axis);
};
auto walk = [&](int m) {
    int cell[3] = {cell_of(from[0][m], 0), cell_of(from[1][m], 1), planes == 2 ? cell_of(from[2][m], 2) : 1};
    T x[3], rest[3]; int stopped = 0;
    for (int d = 0; d < 3; ++d) { x[d] = from[d][m]; rest[d] = to[d][m] - x[d]; }
    // along each axis the walk goes one way only, so it crosses no more faces than this
    for (int crossed = 0; crossed < nx + ny + nz; ++crossed) {
        int axis = -1; T t = 1;
        for (int d = 0; d <= planes; ++d) {
            const T gap = (T)cell[d] + (rest[d] > 0 ? (T)1 : (T)0) - x[d];
            if (abs_of(rest[d]) > abs_of(gap)) {  // it crosses this face
                T s = gap/rest[d];
                s = s > 0 ? s : (T)0;
                if (s < t) { t = s; axis = d; }
            }
        }
        if (axis < 0) break;
        const int side = rest[axis] > 0 ? 1 : -1;
        for (int d = 0; d <= planes; ++d) { x[d] += t*rest[d]; rest[d] *= 1 - t; }
        x[axis] = (T)cell[axis] + (side > 0 ? (T)1 : (T)0);
        if (room[cell[2]*s1 + cell[1]*s2 + cell[0] - back + side*stride[axis]] == 0) {
            x[axis] -= (T)side*margin; rest[axis] = 0; ++stopped;
        } else {
            cell[axis] += side;
            if ((ENDLESS >> axis & 1) && (cell[axis] < 1 || cell[axis] > counts[axis])) {  // in again at the other side
                cell[axis] -= side*counts[axis]; x[axis] -= (T)(side*counts[axis]);
            }
            if (cell[axis] < first_cell[axis] || cell[axis] > counts[axis]) {  // out through an open side: there is nothing to meet
                for (int d = 0; d <= planes; ++d) to[d][m] = x[d] + rest[d];
                hit[m] = stopped > 0;
                return;
            }
        }
    }
    const signed char* here = room + (cell[2]*s1 + cell[1]*s2 + cell[0] - back);
    for (int d = 0; d <= planes; ++d) {  // whoever moves along a closed face keeps off it too
        x[d] += rest[d];
        const T low = (T)cell[d] + margin, high = (T)cell[d] + 1 - margin;
        if (x[d] < low && here[-stride[d]] == 0) x[d] = low;
        if (x[d] > high && here[stride[d]] == 0) x[d] = high;
        to[d][m] = x[d];
    }
    hit[m] = stopped > 0;
};
// Aim at from + a A + b B + c C. Nothing stops a particle that stays in its cell off the faces, or whose solids are further than it goes.
auto move = [&](T a, const Block& A, T b, const Block& B, T c, const Block& C, int n) {
    const T rx = lx - 1, ry = ly - 1, rz = lz - 1;  // the ring
    SIMD for (int m = 0; m < n; ++m) {
        const T x = from[0][m], y = from[1][m], z = planes == 2 ? from[2][m] : (T)1.5;
        const T X = x + (a*A[0][m] + b*B[0][m] + c*C[0][m]), Y = y + (a*A[1][m] + b*B[1][m] + c*C[1][m]);
        const T Z = planes == 2 ? z + (a*A[2][m] + b*B[2][m] + c*C[2][m]) : (T)1.5;
        to[0][m] = X; to[1][m] = Y; to[2][m] = Z; hit[m] = 0;
        T p = x > lx ? x : lx, q = y > ly ? y : ly, r = z > lz ? z : lz;
        const int i = floor_of(p < (T)nx ? p : (T)nx, 0), j = floor_of(q < (T)ny ? q : (T)ny, 1), k = floor_of(r < (T)nz ? r : (T)nz, 2);
        p = X > rx ? X : rx; q = Y > ry ? Y : ry; r = Z > rz ? Z : rz;  // beyond the ring nothing is known, nor needed
        const int I = floor_of(p < (T)(nx + 1) ? p : (T)(nx + 1), 0), J = floor_of(q < (T)(ny + 1) ? q : (T)(ny + 1), 1);
        const int K = floor_of(r < (T)(nz + 1) ? r : (T)(nz + 1), 2);
        int di = I - i, dj = J - j, dk = K - k;
        di = di < 0 ? -di : di; dj = dj < 0 ? -dj : dj; dk = dk < 0 ? -dk : dk;
        int most = di < dj ? dj : di; most = most < dk ? dk : most;
        const T fx = X - (T)i, fy = Y - (T)j, fz = Z - (T)k;
        const int stays = (int)(fx >= margin) & (int)(fx <= 1 - margin) & (int)(fy >= margin) & (int)(fy <= 1 - margin)
            & (int)(fz >= margin) & (int)(fz <= 1 - margin);
        begin[m] = (int)(k*s1 + j*s2 + i - back); end[m] = (int)(K*s1 + J*s2 + I - back); cells[m] = stays ? -1 : most;
    }
    int careful = 0;
    for (int m = 0; m < n; ++m) {  // no branches: half of the particles change cells, and nobody guesses which
        list[careful] = m;
        careful += (int)(cells[m] >= 0) & ((int)(room[begin[m]] <= cells[m]) | (int)(room[end[m]] <= 1));
    }
    for (int q = 0; q < careful; ++q) walk(list[q]);
};
#include "runge_kutta.h"
