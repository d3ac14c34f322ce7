// Kernels of the Poisson matrix of a grid. FIELD_X, FIELD_Y, FIELD_Z: which coefficients are
// fields.

// snippet coefficients: Coefficients of lower faces: fields or numbers.
const auto face_x = [&](long long k) -> T { if constexpr (FIELD_X) return fx[k]; else return nx; };
const auto face_y = [&](long long k) -> T { if constexpr (FIELD_Y) return fy[k]; else return ny; };
const auto face_z = [&](long long k) -> T { if constexpr (FIELD_Z) return fz[k]; else return nz; };

// kernel grid_poisson.count_faces: Diagonal of unit coefficients: the number of open faces of a
// FLUID cell along the axes that count
//   compute    uint8
//   reads      int8 cells
//   writes     uint8 diagonal
//   numbers    bool around_x, around_y, around_z
const unsigned char along_x = around_x, along_y = around_y, along_z = around_z;
const auto open = [&](long long k, unsigned char axis) -> unsigned char { return cells[k] != 2 ? axis : (unsigned char)0; };
const auto count = [&](int k) {
    const unsigned char v = open(k - 1, along_x) + open(k + 1, along_x) + open(k + ym, along_y) + open(k + yp, along_y)
        + open(k + zm, along_z) + open(k + zp, along_z);
    diagonal[k] = cells[k] == 1 ? v : (unsigned char)0; };
const int whole = n/64*64;
SIMD64 for (int k = 0; k < whole; ++k) count(k);
SIMD for (int k = whole; k < n; ++k) count(k);

// kernel grid_poisson.diagonal: The sum of the coefficients over a FLUID cell's open faces, plus
// the shift
//   compute    S
//   reads      int8 cells; S fx?, fy?, fz?, shift?
//   writes     S diagonal
//   numbers    S nx, ny, nz
//   constants  FIELD_X = 0, FIELD_Y = 0, FIELD_Z = 0, SHIFTED = 0
#include "coefficients"
SIMD for (int k = 0; k < n; ++k) {
    T v = (cells[k-1] != 2 ? face_x(k) : (T)0) + (cells[k+1] != 2 ? face_x(k+1) : (T)0) + (cells[k+ym] != 2 ? face_y(k) : (T)0)
        + (cells[k+yp] != 2 ? face_y(k+yp) : (T)0) + (cells[k+zm] != 2 ? face_z(k) : (T)0) + (cells[k+zp] != 2 ? face_z(k+zp) : (T)0);
    if constexpr (SHIFTED) v = v + shift[k];
    diagonal[k] = cells[k] == 1 ? v : (T)0; }

// kernel grid_poisson.weights: The weight of a lower face is its coefficient where it joins two
// FLUID cells, else 0; ghost cells above the last ones have them too
//   compute    S
//   reads      int8 cells; S fx?, fy?, fz?
//   writes     S wx, wy, wz
//   numbers    S nx, ny, nz
//   constants  FIELD_X = 0, FIELD_Y = 0, FIELD_Z = 0
#include "coefficients"
SIMD for (int k = 0; k < n; ++k) {
    wx[k] = ((cells[k] == 1) & (cells[k-1] == 1)) ? face_x(k) : (T)0; wy[k] = ((cells[k] == 1) & (cells[k+ym] == 1)) ? face_y(k) : (T)0;
    wz[k] = ((cells[k] == 1) & (cells[k+zm] == 1)) ? face_z(k) : (T)0; }

// kernel grid_poisson.face_gradient: (mu_i - mu_j) (x_i - x_j) of lower faces, 0 where one of the
// two cells is SOLID, and mu_i x_i; and their sums
//   compute    float64
//   reads      int8 cells; float64 multiplier, x
//   writes     float64 face_x?, face_y?, face_z?, shift?
//   sums       sum_x, sum_y, sum_z, sum_shift
const auto across = [&](int k, long long to) -> T {
    const bool open = (cells[k] != 2) & (cells[k + to] != 2);
    return open ? (multiplier[k] - multiplier[k + to])*(x[k] - x[k + to]) : (T)0; };
T sum_x = 0, sum_y = 0, sum_z = 0, sum_shift = 0;
SIMD for (int k = 0; k < n; ++k) {
    sum_x += across(k, -1); sum_y += across(k, ym); sum_z += across(k, zm); sum_shift += cells[k] == 1 ? multiplier[k]*x[k] : (T)0; }
if (face_x) SIMD for (int k = 0; k < n; ++k) face_x[k] = across(k, -1);
if (face_y) SIMD for (int k = 0; k < n; ++k) face_y[k] = across(k, ym);
if (face_z) SIMD for (int k = 0; k < n; ++k) face_z[k] = across(k, zm);
if (shift) SIMD for (int k = 0; k < n; ++k) shift[k] = cells[k] == 1 ? multiplier[k]*x[k] : (T)0;

// kernel grid_poisson.copy_cells: a copy of the cells' labels
//   compute    int8
//   reads      int8 source
//   writes     int8 to
SIMD for (int k = 0; k < n; ++k) to[k] = source[k];
