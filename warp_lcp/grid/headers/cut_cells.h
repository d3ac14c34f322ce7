// Kernels of cut cells: open fractions of faces, states and capacities of cells.

// snippet cut_area: Area of the part of a face with d > 0, from d at its corners v in cyclic order.
// It is the area of the polygon whose vertices are the zeros of d, linear along the edges. Exact
// for planes.
auto area = [](const float* v) {
    int open = 0, start = 0;
    for (int c = 0; c < 4; ++c) open += v[c] > 0.0f;
    // open part of an edge, on a's side; a and b have different signs
    auto part = [](float a, float b) { return a / (a - b); };
    auto corner = [&](int c) {
        return 0.5f * part(v[c], v[(c + 1) & 3]) * part(v[c], v[(c + 3) & 3]);
    };
    if (open == 1) {
        while (v[start] <= 0.0f) ++start;
        return corner(start);
    }
    if (open == 3) {
        while (v[start] > 0.0f) ++start;
        return 1.0f - corner(start);
    }
    while (v[start] <= 0.0f) ++start;
    if (v[(start + 2) & 3] <= 0.0f) {  // two adjacent corners
        const int a = v[(start + 1) & 3] > 0.0f ? start : (start + 3) & 3, b = (a + 1) & 3;
        return 0.5f * (part(v[a], v[(a + 3) & 3]) + part(v[b], v[(b + 1) & 3]));
    }
    const int a = start & 1;  // two opposite corners: the mean tells whether they are connected
    const bool meet = v[0] + v[1] + v[2] + v[3] > 0.0f;
    return meet ? 1.0f - corner(1 - a) - corner(3 - a) : corner(a) + corner(a + 2);
};

// snippet cut_cell: Add the integral over the open part of a cut cell to the kernels of the cells
// around it. Along the axis in which the distance changes most, the open interval of a line is
// known; the kernel's integral is cubic in its ends. Across this axis there are three Gauss points
// (error for planes < 2e-4).
const long long s2 = near_.shape[2], s1 = s2 * near_.shape[1], cell = k * s1 + j * s2 + i,
                sz = planes == 2 ? s1 : 0;
const float* d = near_.data + cell;
float* out = out_.data + cell;
const long long step[3] = {1, s2, sz};
float v[8], slope[3] = {0.0f, 0.0f, 0.0f};
for (int c = 0; c < 8; ++c) {
    v[c] = d[(c & 1) + ((c & 2) ? s2 : 0) + ((c & 4) ? sz : 0)];
    for (int a = 0; a < 3; ++a) slope[a] += (c >> a) & 1 ? v[c] : -v[c];
}
int main = 0;
// Choose another axis only if its slope is clearly larger, so that cells along a plane at 45
// degrees choose the same axis in spite of rounding. Otherwise the error is 3e-3.
for (int a = 1; a <= planes; ++a)
    if (slope[a] * slope[a] > 1.05f * slope[main] * slope[main]) main = a;
const int p = (main + 1) % 3, q = (main + 2) % 3, dim = planes + 1;
const float at[3] = {0.1127016654f, 0.5f, 0.8872983346f},
            gauss[3] = {5.0f / 18.0f, 4.0f / 9.0f, 5.0f / 18.0f};
// Weights at the Gauss points: kernels of the cell below, of this cell and of the cell above.
float side[3][3];
for (int g = 0; g < 3; ++g) {
    const float t = at[g], r = t - 0.5f;
    side[0][g] = gauss[g] * 0.5f * (1.0f - t) * (1.0f - t);
    side[1][g] = gauss[g] * (0.75f - r * r);
    side[2][g] = gauss[g] * 0.5f * t * t;
}
float moment[3][3][3];
for (int a = 0; a < 27; ++a) (&moment[0][0][0])[a] = 0.0f;
for (int gp = 0; gp < (p < dim ? 3 : 1); ++gp)
    for (int gq = 0; gq < (q < dim ? 3 : 1); ++gq) {
        const float tp = p < dim ? at[gp] : 0.0f, tq = q < dim ? at[gq] : 0.0f;
        float end[2];
        for (int e = 0; e < 2; ++e) {
            const int c = e << main, cp = 1 << p, cq = 1 << q;
            end[e] = (1.0f - tq) * ((1.0f - tp) * v[c] + tp * v[c | cp]) +
                     tq * ((1.0f - tp) * v[c | cq] + tp * v[c | cp | cq]);
        }
        float from = 0.0f, to = 1.0f;
        if (end[0] <= 0.0f && end[1] <= 0.0f) continue;
        if (end[0] <= 0.0f)
            from = end[0] / (end[0] - end[1]);
        else if (end[1] <= 0.0f)
            to = end[0] / (end[0] - end[1]);
        auto below = [](float t) {
            const float s = 1.0f - t;
            return -s * s * s / 6.0f;
        };
        auto here = [](float t) {
            const float r = t - 0.5f;
            return 0.75f * t - r * r * r / 3.0f;
        };
        const float along[3] = {below(to) - below(from), here(to) - here(from),
                                (to * to * to - from * from * from) / 6.0f};
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) {
                const float wp_ = p < dim ? side[a][gp] : (float)(a == 1),
                            wq = q < dim ? side[b][gq] : (float)(b == 1);
                for (int m = 0; m < 3; ++m) moment[m][a][b] += along[m] * wp_ * wq;
            }
    }
for (int m = 0; m < 3; ++m)
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) {
            if ((p == dim && a != 1) || (q == dim && b != 1)) continue;
            out[(m - 1) * step[main] + (a - 1) * step[p] + (b - 1) * step[q]] += moment[m][a][b];
        }

// kernel warp_lcp.grid.cut_cells.fractions: Open fractions a and wall numbers w of all faces inside
// the domain, from the distance d at nodes. d2: distance to the next solid; o, o2: numbers of the
// solids. Most rows are far from solids: their blocks are filled at once. Counts: dropped faces and
// partial faces.
//   compute    float32
//   whole      int32 counts
//   box        float32 d, d2, ax, ay, az; int8 marks; int16 o, o2, wx, wy, wz
//   numbers    int planes
//   constants  DROP, HOLLOW
#include "cut_area"
const long long sz = planes == 2 ? s1 : 0;
const bool has_y = j > 1, has_z = planes == 2 && k > 1;
int dropped = 0, partial = 0;
auto low_of = [](float a, float b) { return a < b ? a : b; };
auto clear = [&](long long i) {  // whether a cell with a face of distance 0 is open as a whole
    float low = 0.0f, high = 0.0f;
    for (int c = 0; c < 8; ++c) {
        const float v = d[i + (c & 1) + ((c & 2) ? s2 : 0) + ((c & 4) ? sz : 0)];
        low = v < low ? v : low;
        high = v > high ? v : high;
    }
    return low == 0.0f && (high > 0.0f || marks[i] == HOLLOW);
};
auto nearest = [&](const long long* node) {
    float best = 1e30f;
    short found = 0;
    for (int c = 0; c < 4; ++c) {
        const short candidate = o[node[c]];
        if (candidate <= 0) continue;
        float sum = 0.0f;
        for (int n = 0; n < 4; ++n) sum += o[node[n]] == candidate ? d[node[n]] : d2[node[n]];
        if (sum < best || (sum == best && candidate < found)) {
            best = sum;
            found = candidate;
        }
    }
    return found;
};
auto face = [&](long long i, long long a, long long b, long long back, float* open, short* wall) {
    const long long node[4] = {i, i + a, i + a + b, i + b};
    const float v[4] = {d[node[0]], d[node[1]], d[node[2]], d[node[3]]};
    const float low = low_of(low_of(v[0], v[1]), low_of(v[2], v[3])),
                high = -low_of(low_of(-v[0], -v[1]), low_of(-v[2], -v[3]));
    float f;
    if (high <= 0.0f)
        f = low == 0.0f && clear(i) && clear(i - back) ? 1.0f : 0.0f;
    else
        f = low >= 0.0f ? 1.0f : area(v);
    if (f > 0.0f && f < (float)DROP) {
        f = 0.0f;
        ++dropped;
    }
    partial += f > 0.0f && f < 1.0f;
    open[i] = f;
    wall[i] = f == 1.0f ? -1 : nearest(node);
};
auto cell = [&](long long i) {
    if (i > 1) face(i, s2, sz, 1, ax, wx);
    if (has_y) face(i, 1, sz, s2, ay, wy);
    if (has_z) face(i, 1, s2, s1, az, wz);
};
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
#ifndef __CUDA_ARCH__
    unsigned char near = 0;
    SIMD for (int m = 0; m <= n; ++m) {
        const long long i = start + m;
        near |=
            (d[i] <= 0.0f) | (d[i + s2] <= 0.0f) | (d[i + sz] <= 0.0f) | (d[i + sz + s2] <= 0.0f);
    }
    if (!near) {
        const int from = start == 1;
        SIMD for (int m = from; m < n; ++m) {
            ax[start + m] = 1.0f;
            wx[start + m] = -1;
        }
        if (has_y) {
            SIMD for (int m = 0; m < n; ++m) {
                ay[start + m] = 1.0f;
                wy[start + m] = -1;
            }
        }
        if (has_z) {
            SIMD for (int m = 0; m < n; ++m) {
                az[start + m] = 1.0f;
                wz[start + m] = -1;
            }
        }
        continue;
    }
#endif
    for (int m = 0; m < n; ++m) cell(start + m);
}
if (dropped) count_up(counts, dropped);
if (partial) count_up(counts + 1, partial);

// kernel warp_lcp.grid.cut_cells.states: States of cells. `base`: SOLID if all faces are closed.
// `state`: 1 (open) if no corner is inside a solid, 0 (closed) if none is outside, else 2 (cut)
//   compute    float32
//   box        float32 d, ax, ay, az; int8 base, state
//   numbers    int planes
//   constants  AIR, SOLID
const long long sz = planes == 2 ? s1 : 0;
const float no_z = planes == 2 ? 1.0f : 0.0f;
SIMD for (int i = first; i < last; ++i) {
    const float open = ax[i] + ax[i + 1] + ay[i] + ay[i + s2] + no_z * (az[i] + az[i + sz]);
    const signed char kind = open > 0.0f ? AIR : SOLID;
    auto low_of = [](float a, float b) { return a < b ? a : b; };
    auto high_of = [](float a, float b) { return a > b ? a : b; };
    const float low = low_of(
        low_of(low_of(d[i], d[i + 1]), low_of(d[i + s2], d[i + s2 + 1])),
        low_of(low_of(d[i + sz], d[i + sz + 1]), low_of(d[i + sz + s2], d[i + sz + s2 + 1])));
    const float high = high_of(
        high_of(high_of(d[i], d[i + 1]), high_of(d[i + s2], d[i + s2 + 1])),
        high_of(high_of(d[i + sz], d[i + sz + 1]), high_of(d[i + sz + s2], d[i + sz + s2 + 1])));
    const signed char flat = kind == AIR ? 1 : 0;  // if the distance is 0 at all corners
    const signed char no_cut = high > 0.0f ? (signed char)1 : (low < 0.0f ? (signed char)0 : flat);
    base[i] = kind;
    state[i] = low < 0.0f && high > 0.0f ? (signed char)2 : no_cut;
}

// kernel warp_lcp.grid.capacity.open_cells: Integral of a cell's kernel over the open cells: along
// an axis it is 2/3 over its own cell and 1/6 over each neighbor. Cut cells are added afterwards
//   compute    float32
//   box        float32 capacity; int8 state
//   numbers    int planes
const int nz = given.state.shape[0], ny = given.state.shape[1], nx = given.state.shape[2];
const float side = 1.0f / 6.0f, middle = 2.0f / 3.0f;
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    float sum[M + 2];
    const int from = start > 0 ? start - 1 : 0, end = start + n < nx ? start + n + 1 : nx;
    for (int m = 0; m < n + 2; ++m) sum[m] = 0.0f;
    for (int dk = planes == 2 ? -1 : 0; dk < planes; ++dk) {
        if (k + dk < 0 || k + dk >= nz) continue;
        for (int dj = -1; dj <= 1; ++dj) {
            if (j + dj < 0 || j + dj >= ny) continue;
            const float weight =
                (dj == 0 ? middle : side) * (planes == 1 ? 1.0f : (dk == 0 ? middle : side));
            const signed char* line = state + dk * s1 + dj * s2;
            SIMD for (int i = from; i < end; ++i) sum[i - start + 1] +=
                line[i] == 1 ? weight : 0.0f;
        }
    }
    SIMD for (int m = 0; m < n; ++m) capacity[start + m] =
        side * (sum[m] + sum[m + 2]) + middle * sum[m + 1];
}
