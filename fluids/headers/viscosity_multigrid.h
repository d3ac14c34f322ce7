// Kernels of the multigrid method for the viscous solve.

// snippet viscous_levels: Indices between a level and the finer one: coarse cell n covers cells 2n
// - 1 and 2n; coarse face n is face 2n - 1. On parts of the two levels a shift is added.
const int shift[3] = {shift_x, shift_y, shift_z};
const auto clamped = [](int i, int n) { return i < 0 ? 0 : (i < n ? i : n - 1); };

// snippet viscous_stencil: What the neighbors of a face of one component, and faces of the other
// two, add to its row: A x = diagonal x - around.
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0],
                sc = step[axis == 2 ? 1 : 2];
const auto pair = [&](const T* n, long long s, long long i) {
    return n[i + s] * x[i + s] + n[i] * x[i - s];
};
const auto along = [&](long long i) { return cell[i] * x[i + sa] + cell[i - sa] * x[i - sa]; };
const auto mix = [&](const T* v, const T* n, long long s, long long i) {
    return (n[i] - mixed[i - sa]) * v[i - sa] - (n[i] - mixed[i]) * v[i] +
           (n[i + s] - mixed[i]) * v[i + s] - (n[i + s] - mixed[i - sa]) * v[i + s - sa];
};
const auto others = [&](long long i) {
    const T sum = mix(y, xb, sb, i);
    return DEPTH ? sum + pair(DEPTH ? xc : xb, DEPTH ? sc : sb, i) +
                       mix(DEPTH ? z : y, DEPTH ? xc : xb, DEPTH ? sc : sb, i)
                 : sum;
};
const auto around = [&](long long i) { return along(i) + pair(xb, sb, i) + others(i); };
const int* reach = span + 4 * (k * (int)(s1 / s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];

// kernel fluids.viscosity.span: First and last unknown of each row, and its core: the longest run
// of cells whose equations equal those of the cells beside them. `ends`: lengths of the runs that
// touch the two ends of the row.
//   compute    float32
//   whole      int32 span, ends?
//   box        float32 dx, dy, dz?
//   constants  ALIKE
const float* fields[3] = {dx, dy, dz};
const long long beside[3] = {1, s2, s1};
int begin = (int)s2, end = 0, run = 0, length = 0, core = 0, head = 0;
for (int i = first; i < last; ++i) {
    bool there = false, alike = true;
    for (int a = 0; a < (dz ? 3 : 2); ++a) {
        const float* d = fields[a] + i;
        there = there || *d > 0.0f;
        for (int b = 0; b < (dz ? 3 : 2); ++b) {
            alike = alike && *d > 0.0f && fabsf(d[beside[b]] - *d) <= ALIKE * (*d) &&
                    fabsf(d[-beside[b]] - *d) <= ALIKE * (*d);
        }
    }
    if (there) {
        begin = i < begin ? i : begin;
        end = i + 1;
    }
    run = alike ? run + 1 : 0;
    if (run > length) {
        length = run;
        core = i + 1;
    }
    if (run == i + 1 - first) head = run;
}
int* row = span + 4 * (k * (int)(s1 / s2) + j);
row[0] = begin;
row[1] = end;
row[2] = length ? core - length : end;
row[3] = length ? core : end;
if (ends) {
    ends[2 * (k * (int)(s1 / s2) + j)] = head;
    ends[2 * (k * (int)(s1 / s2) + j) + 1] = run;
}

// kernel fluids.viscosity.sweep: Gauss-Seidel over the rows of one color, or over what lies before
// and behind their cores; no two rows of a color touch in the component. Even cells of a row go
// first, or odd ones. What other rows and components add is computed before, for the whole row.
//   compute    float32
//   whole      int32 span
//   box        float32 x, y, z?, xb, xc?, cell, mixed, diagonal, b, scratch
//   numbers    int axis, color, order, only, band
//   constants  DEPTH
#include "viscous_stencil"
const auto relax = [&](const int low, const int high) {
#ifdef __CUDA_ARCH__
    for (int i = low + ((low + only) & 1); i < high; i += 2)
        x[i] = diagonal[i] > 0 ? (b[i] + around(i)) / diagonal[i] : 0;
#else
    if (axis == 0) {
        SIMD for (int i = low; i < high; ++i) scratch[i] = b[i] + pair(xb, sb, i) + others(i);
    } else {
        SIMD for (int i = low; i < high; ++i) scratch[i] = b[i] + along(i) + others(i);
    }
    for (int half = 0; half < 2; ++half) {
        const int start = low + ((low + (half ^ order)) & 1);
        if (axis == 0) {
            SIMD for (int i = start; i < high; i += 2) {
                const T by = diagonal[i];
                x[i] = by > 0 ? (scratch[i] + cell[i] * x[i + 1] + cell[i - 1] * x[i - 1]) / by : 0;
            }
        } else {
            SIMD for (int i = start; i < high; i += 2) {
                const T by = diagonal[i];
                x[i] = by > 0 ? (scratch[i] + xb[i + 1] * x[i + 1] + xb[i] * x[i - 1]) / by : 0;
            }
        }
    }
#endif
};
if (((j + k) & 1) == color) {
    relax(low, band && reach[2] < high ? reach[2] : high);
    if (band) relax(reach[3] > low ? reach[3] : low, high);
}

// kernel fluids.viscosity.apply: A x, or the residual b - A x
//   compute    float32
//   whole      int32 span
//   box        float32 x, y, z?, xb, xc?, cell, mixed, diagonal, out, right?
//   numbers    int axis
//   constants  DEPTH, RESIDUAL
#include "viscous_stencil"
SIMD for (int i = low; i < high; ++i) {
    const T v = diagonal[i] * x[i] - around(i);
    out[i] = diagonal[i] > 0 ? (RESIDUAL ? right[RESIDUAL ? i : 0] - v : v) : 0;
}

// kernel fluids.viscosity.average: Mean over the finer level, times `scale`: of two cells per axis,
// or of three faces if bit n of `faces` is set for axis n. `wide`: of the four cells that the
// interpolation reaches across a component's axis, weighted by its squares, 9 to 1
//   compute    float32
//   whole      float32 fine
//   box        float32 out
//   numbers    int planes, faces, wide; float32 scale; int shift_x, shift_y, shift_z
#include "viscous_levels"
const int mx = given.fine.shape[2], my = given.fine.shape[1], mz = given.fine.shape[0];
const auto part = [&](int axis, int n, int c, int size, float& weight) {
    if (axis == 2 && planes == 1) {
        weight = c == 0 ? 1.0f : 0.0f;
        return n;
    }
    const bool face = faces >> axis & 1;
    if (wide && !face) {
        weight = c == 0 || c == 3 ? 0.05f : 0.45f;
        return clamped(2 * n - 2 + c + shift[axis], size);
    }
    weight = c == 3 ? 0.0f : face ? (c == 1 ? 0.5f : 0.25f) : (c < 2 ? 0.5f : 0.0f);
    return clamped(2 * n - 1 - (int)face + c + shift[axis], size);
};
const int most = wide ? 4 : 3;
for (int i = first; i < last; ++i) {
    float sum = 0.0f, wz, wy, wx;
    for (int c = 0; c < most; ++c)
        for (int b = 0; b < most; ++b)
            for (int a = 0; a < most; ++a) {
                const long long z = part(2, k, c, mz, wz), y = part(1, j, b, my, wy),
                                x = part(0, i, a, mx, wx);
                sum += wz * wy * wx * fine[(z * my + y) * mx + x];
            }
    out[i] = scale * sum;
}

// kernel fluids.viscosity.close: Whether a wall holds a coarse face: the mean of the finer faces on
// it, -1 if one of them is not in a wall
//   compute    float32
//   whole      float32 fine
//   box        float32 out
//   numbers    int axis, planes, shift_x, shift_y, shift_z
#include "viscous_levels"
const int mx = given.fine.shape[2], my = given.fine.shape[1], mz = given.fine.shape[0];
for (int i = first; i < last; ++i) {
    float sum = 0.0f, least = 1.0f;
    int count = 0;
    for (int c = 0; c < (axis == 2 || planes == 1 ? 1 : 2); ++c)
        for (int b = 0; b < (axis == 1 ? 1 : 2); ++b)
            for (int a = 0; a < (axis == 0 ? 1 : 2); ++a) {
                const long long z = planes == 1 ? k : clamped(2 * k - 1 + c + shift[2], mz);
                const long long y = clamped(2 * j - 1 + b + shift[1], my),
                                x = clamped(2 * i - 1 + a + shift[0], mx);
                const float value = fine[(z * my + y) * mx + x];
                sum += value;
                least = value < least ? value : least;
                ++count;
            }
    out[i] = least < 0.0f ? -1.0f : sum / (float)count;
}

// kernel fluids.viscosity.coarse_diagonal: Diagonal of a component's rows on a coarse level; and
// the places that finer levels interpolate from: unknowns, and faces that a wall holds
//   compute    float32
//   box        float32 diagonal, there, h, volume, drag, cell, xb, xc?
//   numbers    int axis, planes
const int nx = given.h.shape[2] - 2, ny = given.h.shape[1] - 2, nz = given.h.shape[0] - 2;
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0],
                sc = step[axis == 2 ? 1 : 2];
for (int i = first; i < last; ++i) {
    const int at = axis == 0 ? i : (axis == 1 ? j : k);
    diagonal[i] = 0.0f;
    there[i] = h[i] > 0.0f ? h[i] : 0.0f;
    const bool inside =
        i >= 1 && i <= nx && j >= 1 && j <= ny && (planes == 1 || (k >= 1 && k <= nz));
    if (!inside || at == 1 || h[i] >= 0.0f) continue;
    float free = volume[i], wall = drag[i], least = 0.0f;
    const auto link = [&](long long q, float weight, float held) {
        if (h[q] < 0.0f)
            free += weight;
        else {
            wall += held * weight;
            least += weight;
        }
    };
    link(i + sa, cell[i], h[i + sa]);
    link(i - sa, cell[i - sa], h[i - sa]);
    link(i + sb, xb[i + sb], 0.0f);
    link(i - sb, xb[i], 0.0f);
    if (planes == 2) {
        link(i + sc, xc[i + sc], 0.0f);
        link(i - sc, xc[i], 0.0f);
    }
    const float sum = free + (wall > least ? wall : least);
    diagonal[i] = sum;
    there[i] = sum > 0.0f ? 1.0f : 0.0f;
}

// kernel fluids.viscosity.prolong: Prolongation: add the coarse correction. NORM: the reciprocal of
// the interpolation of 1 where it is not 0, 0 elsewhere
//   compute    float32
//   whole      float32 coarse; int32 span
//   box        float32 norm, diagonal?, x?
//   numbers    int axis, planes, shift_x, shift_y, shift_z
//   constants  NORM
#include "viscous_levels"
const int mx = given.coarse.shape[2], my = given.coarse.shape[1], mz = given.coarse.shape[0];
const int* reach = span + 4 * (k * (int)(s1 / s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
if (NORM)
    for (int i = first; i < last; ++i) norm[i] = 0.0f;
int z[2], y[2];
float wz[2], wy[2];
// the two coarse places beside place n along an axis
const auto places = [&](int other, int n, int size, int* to, float* weight) {
    const int odd = n & 1, half = (n + 1) / 2;
    to[0] = other == axis ? n / 2 + odd : half;
    to[1] = clamped(other == axis ? n / 2 + 1 : (odd ? half - 1 : half + 1), size);
    weight[0] = other == axis ? (odd ? 1.0f : 0.5f) : 0.75f;
    weight[1] = 1.0f - weight[0];
    if (other == 2 && planes == 1) {
        to[0] = to[1] = n;
        weight[0] = 1.0f;
        weight[1] = 0.0f;
    }
};
places(2, k - shift[2], mz, z, wz);
places(1, j - shift[1], my, y, wy);
const float* row[4];
float weight[4];
for (int n = 0; n < 4; ++n) {
    row[n] = coarse + ((long long)z[n >> 1] * my + y[n & 1]) * mx;
    weight[n] = wz[n >> 1] * wy[n & 1];
}
float line[M / 2 + 3];
for (int start = low; start < high; start += M) {
    const int end = start + M < high ? start + M : high, half = (start - shift[0]) / 2,
              base = half > 0 ? half - 1 : 0;
    const int most = clamped((end - shift[0]) / 2 + 2, mx) - base,
              count = most < (int)M / 2 + 3 ? most + 1 : (int)M / 2 + 3;
    SIMD for (int n = 0; n < count; ++n) {
        line[n] = weight[0] * row[0][base + n] + weight[1] * row[1][base + n] +
                  weight[2] * row[2][base + n] + weight[3] * row[3][base + n];
    }
    for (int i = start; i < end; ++i) {
        const int odd = (i - shift[0]) & 1, n = (i - shift[0] + 1) / 2 - base;
        const float value = axis == 0 ? (odd ? line[n] : 0.5f * (line[n] + line[n + 1]))
                                      : 0.75f * line[n] + 0.25f * line[odd ? n - 1 : n + 1];
        if (NORM)
            norm[i] = diagonal[i] > 0.0f && value > 0.0f ? 1.0f / value : 0.0f;
        else
            x[NORM ? 0 : i] += norm[i] * value;
    }
}

// kernel fluids.viscosity.restrict: Restriction: the transpose of the interpolation, a mean over
// the cells of the finer level
//   compute    float32
//   whole      float32 fine, norm; int32 span
//   box        float32 out, diagonal
//   numbers    int axis, planes, shift_x, shift_y, shift_z
#include "viscous_levels"
const int mx = given.fine.shape[2], my = given.fine.shape[1], mz = given.fine.shape[0];
const int* reach = span + 4 * (k * (int)(s1 / s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
const auto weigh = [&](int other, int c) {
    return other == axis ? (c == 1 ? 1.0f : (c < 3 ? 0.5f : 0.0f))
                         : (c == 1 || c == 2 ? 0.75f : 0.25f);
};
const float share = planes == 2 ? 0.125f : 0.25f;
float line[2 * M + 4];
for (int start = low; start < high; start += M) {
    const int end = start + M < high ? start + M : high, base = 2 * start - 2 + shift[0],
              last_one = 2 * end + 1 + shift[0];
    const int count = last_one < mx ? last_one - base : mx - base;
    SIMD for (int n = 0; n < 2 * (end - start) + 4; ++n) line[n] = 0.0f;
    for (int c = 0; c < (planes == 2 ? 4 : 1); ++c)
        for (int b = 0; b < 4; ++b) {
            const int z = planes == 2 ? 2 * k - 2 + c + shift[2] : k, y = 2 * j - 2 + b + shift[1];
            const float w = share * (planes == 2 ? weigh(2, c) : 1.0f) * weigh(1, b);
            if (w == 0.0f || z >= mz || y >= my) continue;
            const long long row = ((long long)z * my + y) * mx + base;
            SIMD for (int n = 0; n < count; ++n) line[n] += w * norm[row + n] * fine[row + n];
        }
    for (int i = start; i < end; ++i) {
        const float* at = line + 2 * (i - start);
        const float sum = axis == 0 ? at[1] + 0.5f * (at[0] + at[2])
                                    : 0.75f * (at[1] + at[2]) + 0.25f * (at[0] + at[3]);
        out[i] = diagonal[i] > 0.0f ? sum : 0.0f;
    }
}
