#include "coefficients.h"
// The sum of the coefficients over a FLUID cell's open faces, plus the shift.
SIMD for (int k = 0; k < n; ++k) {
    T v = (cells[k-1] != 2 ? face_x(k) : (T)0) + (cells[k+1] != 2 ? face_x(k+1) : (T)0) + (cells[k+ym] != 2 ? face_y(k) : (T)0)
        + (cells[k+yp] != 2 ? face_y(k+yp) : (T)0) + (cells[k+zm] != 2 ? face_z(k) : (T)0) + (cells[k+zp] != 2 ? face_z(k+zp) : (T)0);
    if constexpr (SHIFTED) v = v + shift[k];
    diagonal[k] = cells[k] == 1 ? v : (T)0; }
