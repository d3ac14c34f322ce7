// Area of the surface and of the walls that are wet, in faces of cells: 6 f (1 - f) |grad f| has the integral 1 across a surface.
#include "pressure_face.h"
const int nx = given.kind.shape[2];
for (int i = first; i < last; ++i) {
    if (kind[i] == SOLID || i == 0 || i + 1 == nx) continue;
    const float f = share[i];
    if (f <= 0.0f) continue;
    const float x = 0.5f*(share[i + 1] - share[i - 1]), y = 0.5f*(share[i + s2] - share[i - s2]), z = 0.5f*(share[i + sz] - share[i - sz]);
    area += (double)(6.0f*f*(1.0f - f)*sqrtf(x*x + y*y + z*z));
    const float ax = fraction(0, i + 1, 1) - fraction(0, i, 1), ay = fraction(1, i + s2, s2) - fraction(1, i, s2);
    const float az = fraction(2, i + sz, sz) - fraction(2, i, sz);
    wetted += (double)(f*sqrtf(ax*ax + ay*ay + az*az));
}
