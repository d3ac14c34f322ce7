// bend = the curvature of contours of 2 a - b [1/cells], > 0 where the liquid bulges, in cells near the surface; else 0
#include "smooth_share.h"
for (int i = first; i < last; ++i) {
    bend[i] = 0;
    const T share = f(i);
    if (!inside || i == 0 || i + 1 == nx || share < (T)BAND || share > (T)(1 - BAND)) continue;
    const T here = (T)2*share, x = slope(i, 1), y = slope(i, s2), z = slope(i, sz);
    const T xx = f(i + 1) + f(i - 1) - here, yy = f(i + s2) + f(i - s2) - here, zz = f(i + sz) + f(i - sz) - here;
    auto mixed = [&](long long p, long long q) { return (T)0.25*(f(i + p + q) - f(i + p - q) - f(i - p + q) + f(i - p - q)); };
    T sum = xx*(y*y + z*z) + yy*(x*x + z*z) + zz*(x*x + y*y) - (T)2*x*y*mixed(1, s2);
    if (planes == 2) sum -= (T)2*(x*z*mixed(1, sz) + y*z*mixed(s2, sz));
    const T steep = x*x + y*y + z*z, most = limit, curvature = steep > (T)1e-8 ? -sum/(steep*sqrtf(steep)) : (T)0;
    bend[i] = curvature > most ? most : (curvature < -most ? -most : curvature);
}
