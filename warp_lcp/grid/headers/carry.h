// A row's places with a mean level above `least`, which are few or all: their list, their way back, and the value there.
typedef T Block[3][M];
const int nx = given.u.shape[2] - 2, ny = given.u.shape[1] - 2, nz = given.u.shape[0] - 2;
const long long s2 = nx + 2, s1 = s2*(ny + 2), up = planes == 2 ? s1 : 0, back = 0;
const T lx = 1, ly = 1, lz = 1;
const long long below = AXIS == 0 ? 1 : AXIS == 1 ? s2 : AXIS == 2 ? s1 : 0;
const T hx = AXIS == 0 ? (T)0 : (T)0.5, hy = AXIS == 1 ? (T)0 : (T)0.5, hz = AXIS == 2 ? (T)0 : (T)0.5;
const T ex = nx + 1, ey = ny + 1, ez = nz + 1;
const T* g = given.field.data;
Block from, to, k1, k2, k3;
int list[M];
#include "sample.h"
for (int start = first; start < last; start += M) {
    const int end = last - start < M ? last : start + M;
    int n = 0;
    for (int i = start; i < end; ++i) {
        out[i] = AXIS < CENTERS ? field[i] : (T)0; list[n] = i;
        n += (int)((T)0.5*(level[i] + level[i - below]) > least);
    }
    if (n == 0) continue;
    for (int m = 0; m < n; ++m) { from[0][m] = (T)list[m] + hx; from[1][m] = (T)j + hy; from[2][m] = planes == 2 ? (T)k + hz : (T)1; }
    auto go = [&](T a, const Block& A, T b, const Block& B, T c, const Block& C) {
        for (int d = 0; d <= planes; ++d) {
            SIMD for (int m = 0; m < n; ++m) to[d][m] = from[d][m] - (a*A[d][m] + b*B[d][m] + c*C[d][m]);
        }
    };
    for (int m = 0; m < n; ++m) { to[2][m] = (T)1; k1[2][m] = k2[2][m] = k3[2][m] = 0; }
    sample(from, k1, n);
    go((T)0.5*h, k1, 0, k1, 0, k1);
    sample(to, k2, n);
    go((T)0.75*h, k2, 0, k2, 0, k2);
    sample(to, k3, n);
    go((T)2/9*h, k1, (T)3/9*h, k2, (T)4/9*h, k3);
    for (int m = 0; m < n; ++m) {
        T x = to[0][m], y = to[1][m], z = to[2][m];
        x = x > 1 ? x : (T)1; y = y > 1 ? y : (T)1; z = z > 1 ? z : (T)1;
        x = (x < ex ? x : ex) - hx; y = (y < ey ? y : ey) - hy; z = planes == 2 ? (z < ez ? z : ez) - hz : (T)1;
        int a = (int)x, b = (int)y, c = (int)z;
        a = a < nx ? a : nx; b = b < ny ? b : ny; c = planes == 2 && c > nz ? nz : c;
        const T fx = x - (T)a, fy = y - (T)b, fz = planes == 2 ? z - (T)c : (T)0;
#if AXIS == CENTERS
#include "carry_linear.h"
#else
#include "carry_cubic.h"
#endif
    }
}
