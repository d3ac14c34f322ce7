// jump = scale times the curvature at the nearest point of the smooth surface in cells beside the surface; else 0
#include "smooth_share.h"
const int nz = given.once.shape[0], ny = given.once.shape[1], nx = given.once.shape[2];
const bool inside = j > 0 && j + 1 < ny && (planes != 2 || (k > 0 && k + 1 < nz));
const long long sz = planes == 2 ? s1 : 0;
for (int i = first; i < last; ++i) {
    jump[i] = 0;
    if (!inside || i == 0 || i + 1 == nx || kind[i] == SOLID) continue;
    const signed char other = kind[i] == FLUID ? AIR : FLUID;
    if (kind[i - 1] != other && kind[i + 1] != other && kind[i - s2] != other && kind[i + s2] != other && kind[i - sz] != other
        && kind[i + sz] != other) continue;
    const T x = slope(i, 1), y = slope(i, s2), z = slope(i, sz), steep = x*x + y*y + z*z, most = (T)FARTHEST;
    T way = steep > (T)1e-4 ? -distance(i)/steep : (T)0;
    way = way > most ? most : (way < -most ? -most : way);
    T p[3] = {(T)i + way*x, (T)j + way*y, (T)k + way*z};
    const int ends[3] = {nx - 2, ny - 2, nz - 2};
    int c[3];
    for (int e = 0; e < 3; ++e) {
        p[e] = p[e] < 1 ? (T)1 : (p[e] > (T)ends[e] ? (T)ends[e] : p[e]);
        c[e] = (int)p[e]; p[e] -= (T)c[e];
    }
    const T* q = bend + ((c[0]) + (c[1] - j)*s2 + (planes == 2 ? (c[2] - k)*s1 : 0));
    auto plane = [&](const T* r) { return (1 - p[1])*((1 - p[0])*r[0] + p[0]*r[1]) + p[1]*((1 - p[0])*r[s2] + p[0]*r[s2 + 1]); };
    jump[i] = scale*(planes == 2 ? (1 - p[2])*plane(q) + p[2]*plane(q + s1) : plane(q));
}
