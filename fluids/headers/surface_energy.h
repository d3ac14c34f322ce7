// Area of the surface and of the walls that are wet, in faces of cells: a parabola of the share
// times its slope has the integral 1 across a surface, and counts cells only whose neighbors know their distance.
#include "pressure_face.h"
#include "smooth_share.h"
const int nx = given.kind.shape[2];
for (int i = first; i < last; ++i) {
    const float raw = share(i), f = raw < 1.0f ? raw : 1.0f, t = f - 0.5f, u = t*t/(float)(HALF*HALF);
    if (kind[i] == SOLID || i == 0 || i + 1 == nx || f <= 0.0f) continue;
    const float x = slope(i, 1), y = slope(i, s2), z = slope(i, sz);
    area += (double)(u < 1.0f ? 0.75f/(float)HALF*(1.0f - u)*sqrtf(x*x + y*y + z*z)/(linear + 3.0f*cubic*t*t) : 0.0f);
    const float ax = fraction(0, i + 1, 1) - fraction(0, i, 1), ay = fraction(1, i + s2, s2) - fraction(1, i, s2);
    const float az = fraction(2, i + sz, sz) - fraction(2, i, sz);
    wetted += (double)(f*sqrtf(ax*ax + ay*ay + az*az));
}
