// Kernels of fields on staggered grids.

// kernel warp_lcp.grid.clear.clear: Set a field to 0
//   compute    float32 | float64 | int8
//   box        T field
for (int i = first; i < last; ++i) field[i] = 0;

// kernel warp_lcp.grid.active_rows.mark_segments: Mark the segment of a row that each particle lies
// in
//   compute    float32
//   whole      uint8 marks
//   box        vec3 position
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z, in_z, in_y,
//              in_x, segment
#include "snippets.h:grid_coordinate"
const float* position = (const float*)given.position.data;
const auto cell_of = [](float coordinate, int count) {
    const int at = coordinate > 0.0f ? (int)coordinate : 0;
    return at < count ? at : count - 1;
};
for (int p = first; p < last; ++p) {
    const float* at = position + 3 * (long long)p;
    const int k = planes == 2 ? cell_of(grid_coordinate(at[2], before_z), in_z) : 1;
    const int j = cell_of(grid_coordinate(at[1], before_y), in_y),
              i = cell_of(grid_coordinate(at[0], before_x), in_x * segment);
    marks[((long long)k * in_y + j) * in_x + i / segment] = 1;
}

// kernel warp_lcp.grid.extrapolate.fill_layer: Fill faces marked `fill` from neighbors known up to
// `layer`, and mark them layer + 1. A pass over the marks finds what to fill, so that rows without
// any cost a byte a face: with one thread a row in plain Warp a liquid of 276,000 cells spent 23
// ms a step on its extrapolation, in this form it spends 8. In place without a race: a face that
// another thread fills in this launch is marked `fill` or layer + 1 and is not read either way.
//   compute    float32
//   box        float32 field; int8 known
//   numbers    int layer, fill
const int nz = given.known.shape[0], ny = given.known.shape[1], nx = given.known.shape[2];
// where there is no neighboring row the row itself stands in for it, and no mark is low enough to
// be a source
const long long a = j > 0 ? -s2 : 0, b = j + 1 < ny ? s2 : 0, c = k > 0 ? -s1 : 0,
                d = k + 1 < nz ? s1 : 0;
const signed char now = (signed char)layer;
const signed char la = a ? now : 0, lb = b ? now : 0, lc = c ? now : 0, ld = d ? now : 0;
auto source = [](signed char mark, signed char limit) {
    return (unsigned char)((mark > 0) & (mark <= limit));
};
auto wanted = [&](long long i, signed char low, signed char high) {
    return (unsigned char)((known[i] == fill) &
                           (source(known[i - (low > 0)], low) |
                            source(known[i + (high > 0)], high) | source(known[i + a], la) |
                            source(known[i + b], lb) | source(known[i + c], lc) |
                            source(known[i + d], ld)));
};
auto mean = [&](long long i, signed char low, signed char high) {
    const int x0 = source(known[i - (low > 0)], low), x1 = source(known[i + (high > 0)], high),
              y0 = source(known[i + a], la);
    const int y1 = source(known[i + b], lb), z0 = source(known[i + c], lc),
              z1 = source(known[i + d], ld);
    const float total = (x0 ? field[i - (low > 0)] : 0.0f) + (x1 ? field[i + (high > 0)] : 0.0f) +
                        (y0 ? field[i + a] : 0.0f) + (y1 ? field[i + b] : 0.0f) +
                        (z0 ? field[i + c] : 0.0f) + (z1 ? field[i + d] : 0.0f);
    return total / (float)(x0 + x1 + y0 + y1 + z0 + z1);
};
auto fill_one = [&](long long i) {
    const signed char low = i > 0 ? now : 0, high = i + 1 < nx ? now : 0;
    if (wanted(i, low, high)) {
        field[i] = mean(i, low, high);
        known[i] = now + 1;
    }
};
#ifdef __CUDA_ARCH__
for (int i = first; i < last; ++i) fill_one(i);
#else
if (first == 0) fill_one(0);
const int from = first > 0 ? first : 1, end = last < nx ? last : nx - 1;
for (int start = from; start < end; start += M) {
    const int n = end - start < M ? end - start : M;
    unsigned char fills[M], any = 0;
    MASKED for (int m = 0; m < n; ++m) {
        const unsigned char w = wanted(start + m, now, now);
        fills[m] = w;
        any |= w;
    }
    if (!any) continue;
    MASKED for (int m = 0; m < n; ++m) {
        const float value = mean(start + m, now, now);
        field[start + m] = fills[m] ? value : field[start + m];
    }
    MASKED for (int m = 0; m < n; ++m) known[start + m] =
        fills[m] ? (signed char)(now + 1) : known[start + m];
}
if (last == nx && nx > 1) fill_one(nx - 1);
#endif

// kernel warp_lcp.grid.copy_box.copy: Copy a field
//   compute    float32
//   box        float32 field, source
SIMD for (int i = first; i < last; ++i) field[i] = source[i];

// kernel warp_lcp.grid.window_reduction.add_rows: Reduce the results of a window's rows
// One column a quantity: sums, and the maximum of each of the last columns. The order is that of
// NumPy's pairwise summation: 8 accumulators over up to 128 values, their sums added in pairs. In a
// box without whole planes, rows that fit 8192 values are added one after another.
//   compute    float64
//   whole      float64 partials, host, results; vec2i pieces?
//   numbers    int first_k, first_j, planes, rows_, box_k, box_j, box_planes, box_rows, hulls,
//              sums_, all_planes, all_rows
const auto pairwise = [](const auto& self, const auto& value, long long first,
                         long long n) -> double {
    EXACT_MATH
    if (n < 8) {
        double s = -0.0;
        for (long long i = 0; i < n; ++i) s += value(first + i);
        return s;
    }
    if (n <= 128) {
        double r[8];
        for (int m = 0; m < 8; ++m) r[m] = value(first + m);
        long long i = 8;
        for (; i < n - n % 8; i += 8)
            for (int m = 0; m < 8; ++m) r[m] += value(first + i + m);
        double s = ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]));
        for (; i < n; ++i) s += value(first + i);
        return s;
    }
    const long long half = n / 2 - n / 2 % 8;
    return self(self, value, first, half) + self(self, value, first + half, n - half);
};
for (int column = P.first; column < P.first + n; ++column) {
    EXACT_MATH
    const long long places = pieces ? hulls : (long long)planes * rows_;
    const double* found = partials + column * places;
    double* field = host + column * (long long)all_planes * all_rows;
    if (pieces) {
        for (int k = box_k; k < box_k + box_planes; ++k)
            for (int j = box_j; j < box_j + box_rows; ++j) field[k * (long long)all_rows + j] = 0;
        for (int h = 0; h < hulls; ++h)
            field[pieces[2 * h][0] * (long long)all_rows + pieces[2 * h][1]] = found[h];
    }
    const auto value = [&](long long at) -> double {
        const int k = box_k + (int)(at / box_rows), j = box_j + (int)(at % box_rows),
                  y = k - first_k, x = j - first_j;
        if (pieces) return field[k * (long long)all_rows + j];
        return y >= 0 && y < planes && x >= 0 && x < rows_ ? found[y * (long long)rows_ + x] : 0;
    };
    const long long all = (long long)box_planes * box_rows;
    if (column < sums_) {
        double s = 0;
        const long long fit = box_rows == all_rows || box_planes == 1 ? all
                              : box_rows > 8192                       ? 8192
                                                                      : 8192 / box_rows * box_rows;
        for (long long at = 0; at < all; at += fit)
            s += pairwise(pairwise, value, at, at + fit < all ? fit : all - at);
        results[column] = s;
    } else {
        double most = -HUGE_VAL;
        for (long long i = 0; i < all; ++i) {
            const double v = value(i);
            most = v > most || v != v ? v : most;
            if (most != most) break;
        }
        results[column] = most;
    }
}
