// Open fractions a and wall numbers w of all faces inside the domain from the distance d at nodes; d2: of the next solid, o, o2: whose they are.
// Solids are far from most rows: those blocks are filled at once. Counted are the dropped and the partial faces.
#include "cut_area.h"
const long long sz = planes == 2 ? s1 : 0;
const bool has_y = j > 1, has_z = planes == 2 && k > 1;
int dropped = 0, partial = 0;
auto low_of = [](float a, float b) { return a < b ? a : b; };
auto clear = [&](long long i) {  // whether all of a cell with a face of distance 0 is open
    float low = 0.0f, high = 0.0f;
    for (int c = 0; c < 8; ++c) {
        const float v = d[i + (c & 1) + ((c & 2) ? s2 : 0) + ((c & 4) ? sz : 0)];
        low = v < low ? v : low; high = v > high ? v : high;
    }
    return low == 0.0f && (high > 0.0f || marks[i] == HOLLOW);
};
auto nearest = [&](const long long* node) {
    float best = 1e30f; short found = 0;
    for (int c = 0; c < 4; ++c) {
        const short candidate = o[node[c]];
        if (candidate <= 0) continue;
        float sum = 0.0f;
        for (int n = 0; n < 4; ++n) sum += o[node[n]] == candidate ? d[node[n]] : d2[node[n]];
        if (sum < best || (sum == best && candidate < found)) { best = sum; found = candidate; }
    }
    return found;
};
auto face = [&](long long i, long long a, long long b, long long back, float* open, short* wall) {
    const long long node[4] = {i, i + a, i + a + b, i + b};
    const float v[4] = {d[node[0]], d[node[1]], d[node[2]], d[node[3]]};
    const float low = low_of(low_of(v[0], v[1]), low_of(v[2], v[3])), high = -low_of(low_of(-v[0], -v[1]), low_of(-v[2], -v[3]));
    float f;
    if (high <= 0.0f) f = low == 0.0f && clear(i) && clear(i - back) ? 1.0f : 0.0f;
    else f = low >= 0.0f ? 1.0f : area(v);
    if (f > 0.0f && f < (float)DROP) { f = 0.0f; ++dropped; }
    partial += f > 0.0f && f < 1.0f;
    open[i] = f; wall[i] = f == 1.0f ? -1 : nearest(node);
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
        near |= (d[i] <= 0.0f) | (d[i + s2] <= 0.0f) | (d[i + sz] <= 0.0f) | (d[i + sz + s2] <= 0.0f);
    }
    if (!near) {
        const int from = start == 1;
        SIMD for (int m = from; m < n; ++m) { ax[start + m] = 1.0f; wx[start + m] = -1; }
        if (has_y) { SIMD for (int m = 0; m < n; ++m) { ay[start + m] = 1.0f; wy[start + m] = -1; } }
        if (has_z) { SIMD for (int m = 0; m < n; ++m) { az[start + m] = 1.0f; wz[start + m] = -1; } }
        continue;
    }
#endif
    for (int m = 0; m < n; ++m) cell(start + m);
}
if (dropped) count_up(counts, dropped);
if (partial) count_up(counts + 1, partial);
