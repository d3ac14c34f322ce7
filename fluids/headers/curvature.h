// bend = the curvature of the contours of the distance [1/cells], > 0 where the liquid bulges, in cells near the surface; else 0
#include "smooth_share.h"
const int nz = given.once.shape[0], ny = given.once.shape[1], nx = given.once.shape[2];
const bool inside = j > 0 && j + 1 < ny && (planes != 2 || (k > 0 && k + 1 < nz));
const long long sz = planes == 2 ? s1 : 0;
for (int i = first; i < last; ++i) {
    bend[i] = 0;
    const T f = share(i);
    if (!inside || i == 0 || i + 1 == nx || f < (T)BAND || f > (T)(1 - BAND)) continue;
    const T here = (T)2*distance(i), x = slope(i, 1), y = slope(i, s2), z = slope(i, sz);
    const T xx = distance(i + 1) + distance(i - 1) - here, yy = distance(i + s2) + distance(i - s2) - here;
    const T zz = distance(i + sz) + distance(i - sz) - here;
    auto mixed = [&](long long p, long long q) {
        return (T)0.25*(distance(i + p + q) - distance(i + p - q) - distance(i - p + q) + distance(i - p - q));
    };
    T sum = xx*(y*y + z*z) + yy*(x*x + z*z) + zz*(x*x + y*y) - (T)2*x*y*mixed(1, s2);
    if (planes == 2) sum -= (T)2*(x*z*mixed(1, sz) + y*z*mixed(s2, sz));
    const T steep = x*x + y*y + z*z, most = limit, curvature = steep > (T)1e-4 ? sum/(steep*sqrtf(steep)) : (T)0;
    bend[i] = curvature > most ? most : (curvature < -most ? -most : curvature);
}
