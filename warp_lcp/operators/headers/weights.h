#include "coefficients.h"
// The weight of a lower face is its coefficient where it joins two FLUID cells, else 0; ghost cells above the last ones have them too.
SIMD for (int k = 0; k < n; ++k) {
    wx[k] = ((cells[k] == 1) & (cells[k-1] == 1)) ? face_x(k) : (T)0; wy[k] = ((cells[k] == 1) & (cells[k+ym] == 1)) ? face_y(k) : (T)0;
    wz[k] = ((cells[k] == 1) & (cells[k+zm] == 1)) ? face_z(k) : (T)0; }
