// Kernels of the Poisson matrix of a grid. FIELD_X, FIELD_Y, FIELD_Z: which coefficients are
// fields.

// snippet coefficients: Coefficients of lower faces: fields or numbers.
const auto face_x = [&](int k) -> T {
    if constexpr (FIELD_X)
        return fx[k];
    else
        return nx;
};
const auto face_y = [&](int k, long long at = 0) -> T {
    if constexpr (FIELD_Y)
        return (fy + at)[k];
    else
        return ny;
};
const auto face_z = [&](int k, long long at = 0) -> T {
    if constexpr (FIELD_Z)
        return (fz + at)[k];
    else
        return nz;
};

// kernel grid_poisson.count_faces: Diagonal for unit coefficients: number of open faces of a FLUID
// cell along the axes that count
//   compute    uint8
//   reads      int8 cells
//   writes     uint8 diagonal
//   numbers    bool around_x, around_y, around_z
//   module     grid
#include "snippets.h:bytes"
const unsigned char along_x = around_x, along_y = around_y, along_z = around_z;
const auto open = [&](int k, unsigned char axis, long long at = 0) -> unsigned char {
    return (cells + at)[k] != 2 ? axis : (unsigned char)0;
};
const auto count = [&](int k) {
    const unsigned char v = open(k - 1, along_x) + open(k + 1, along_x) + open(k, along_y, ym) +
                            open(k, along_y, yp) + open(k, along_z, zm) + open(k, along_z, zp);
    diagonal[k] = cells[k] == 1 ? v : (unsigned char)0;
};
const int whole = n / 64 * 64;
if (MASKED_BYTES) {
    MASKED64 for (int k = 0; k < n; ++k) count(k);
} else {
    SIMD64 for (int k = 0; k < whole; ++k) count(k);
    SIMD for (int k = whole; k < n; ++k) count(k);
}

// kernel grid_poisson.diagonal: Diagonal: sum of the coefficients over a FLUID cell's open faces,
// plus the shift
//   compute    S
//   reads      int8 cells; S fx?, fy?, fz?, shift?
//   writes     S diagonal
//   numbers    S nx, ny, nz
//   constants  FIELD_X = 0, FIELD_Y = 0, FIELD_Z = 0, SHIFTED = 0
#include "coefficients"
SIMD for (int k = 0; k < n; ++k) {
    T v = (cells[k - 1] != 2 ? face_x(k) : (T)0) + (cells[k + 1] != 2 ? face_x(k + 1) : (T)0) +
          ((cells + ym)[k] != 2 ? face_y(k) : (T)0) +
          ((cells + yp)[k] != 2 ? face_y(k, yp) : (T)0) +
          ((cells + zm)[k] != 2 ? face_z(k) : (T)0) + ((cells + zp)[k] != 2 ? face_z(k, zp) : (T)0);
    if constexpr (SHIFTED) v = v + shift[k];
    diagonal[k] = cells[k] == 1 ? v : (T)0;
}

// kernel grid_poisson.weights: Weight of a lower face: its coefficient if it joins two FLUID cells,
// else 0; also in the ghost cells above the last ones
//   compute    S
//   reads      int8 cells; S fx?, fy?, fz?
//   writes     S wx, wy, wz
//   numbers    S nx, ny, nz
//   constants  FIELD_X = 0, FIELD_Y = 0, FIELD_Z = 0
#include "coefficients"
SIMD for (int k = 0; k < n; ++k) {
    wx[k] = ((cells[k] == 1) & (cells[k - 1] == 1)) ? face_x(k) : (T)0;
    wy[k] = ((cells[k] == 1) & ((cells + ym)[k] == 1)) ? face_y(k) : (T)0;
    wz[k] = ((cells[k] == 1) & ((cells + zm)[k] == 1)) ? face_z(k) : (T)0;
}

// kernel grid_poisson.face_gradient: Derivatives by coefficients: (mu_i - mu_j) (x_i - x_j) of
// lower faces, 0 where one of the two cells is SOLID; mu_i x_i for the shift; and their sums
//   compute    float64
//   reads      int8 cells; float64 multiplier, x
//   writes     float64 face_x?, face_y?, face_z?, shift?
//   sums       sum_x, sum_y, sum_z, sum_shift
// across a face to the cell `left` elements before that at `to`
const auto across = [&](int k, int left, long long to) -> T {
    const bool open = (cells[k] != 2) & ((cells + to)[k - left] != 2);
    return open ? (multiplier[k] - (multiplier + to)[k - left]) * (x[k] - (x + to)[k - left])
                : (T)0;
};
T sum_x = 0, sum_y = 0, sum_z = 0, sum_shift = 0;
SIMD for (int k = 0; k < n; ++k) {
    sum_x += across(k, 1, 0);
    sum_y += across(k, 0, ym);
    sum_z += across(k, 0, zm);
    sum_shift += cells[k] == 1 ? multiplier[k] * x[k] : (T)0;
}
if (face_x) SIMD for (int k = 0; k < n; ++k) face_x[k] = across(k, 1, 0);
if (face_y) SIMD for (int k = 0; k < n; ++k) face_y[k] = across(k, 0, ym);
if (face_z) SIMD for (int k = 0; k < n; ++k) face_z[k] = across(k, 0, zm);
if (shift) SIMD for (int k = 0; k < n; ++k) shift[k] = cells[k] == 1 ? multiplier[k] * x[k] : (T)0;

// kernel grid_poisson.copy_cells: Copy the labels of the cells
//   compute    int8
//   reads      int8 source
//   writes     int8 to
SIMD for (int k = 0; k < n; ++k) to[k] = source[k];

// kernel grid_operator.find_spans: Span of a row: from its first to its last FLUID cell, both
// included, widened to whole vectors of 16 cells, so that aggregates stay whole too. Rows with a
// span are marked in `reach`, and the chunks of flat fields that contain them in `chunks`; older
// marks stay. On the CPU eight cells are tested at a time. A byte of v is 0 where a cell is FLUID.
// Only there v - 1 sets a highest bit that ~v has, apart from bytes behind one of them.
//   compute    float32
//   reads      int8 cells
//   by_row     vec2i spans, reach
//   whole      vec2i chunks?
//   numbers    int chunk_count; int64 size
//   constants  CHUNK, SPAN_CELLS
//   module     grid
const auto none = [&](int k) {
#ifdef __CUDA_ARCH__
    return false;
#else
    unsigned long long v, ones = 0x0101010101010101ull;
    __builtin_memcpy(&v, cells + k, 8);
    v ^= ones;
    return ((v - ones) & ~v & ones << 7) == 0;
#endif
};
int first = 0, last = n;
while (first + 8 <= n && none(first)) first += 8;
while (first < n && cells[first] != 1) ++first;
while (last - 8 >= first && none(last - 8)) last -= 8;
while (last > first && cells[last - 1] != 1) --last;
const bool any = last > first;
const int end = (last + SPAN_CELLS - 1) / SPAN_CELLS * SPAN_CELLS;
spans[P.row] =
    any ? wp::vec2i(first / SPAN_CELLS * SPAN_CELLS, end < n ? end : n) : wp::vec2i(0, 0);
if (any) {
    reach[P.row] = wp::vec2i(0, n);
    const long long begin = p - 1, row = yp;  // of the stored row, with its ghosts
    for (long long c = begin / CHUNK; c < chunk_count && c <= (begin + row - 1) / CHUNK; ++c) {
        const long long left = size - c * CHUNK;
        chunks[c] = wp::vec2i(0, (int)(left < CHUNK ? left : CHUNK));
    }
}
