// The transpose of the interpolation, a mean over the cells of the finer level.
#include "viscous_levels.h"
const int mx = given.fine.shape[2], my = given.fine.shape[1], mz = given.fine.shape[0];
const int* reach = span + 4*(k*(int)(s1/s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
const auto weigh = [&](int other, int c) { return other == axis ? (c == 1 ? 1.0f : (c < 3 ? 0.5f : 0.0f)) : (c == 1 || c == 2 ? 0.75f : 0.25f); };
const float share = planes == 2 ? 0.125f : 0.25f;
float line[2*M + 4];
for (int start = low; start < high; start += M) {
    const int end = start + M < high ? start + M : high, base = 2*start - 2 + shift[0], last_one = 2*end + 1 + shift[0];
    const int count = last_one < mx ? last_one - base : mx - base;
    SIMD for (int n = 0; n < 2*(end - start) + 4; ++n) line[n] = 0.0f;
    for (int c = 0; c < (planes == 2 ? 4 : 1); ++c) for (int b = 0; b < 4; ++b) {
        const int z = planes == 2 ? 2*k - 2 + c + shift[2] : k, y = 2*j - 2 + b + shift[1];
        const float w = share*(planes == 2 ? weigh(2, c) : 1.0f)*weigh(1, b);
        if (w == 0.0f || z >= mz || y >= my) continue;
        const long long row = ((long long)z*my + y)*mx + base;
        SIMD for (int n = 0; n < count; ++n) line[n] += w*norm[row + n]*fine[row + n];
    }
    for (int i = start; i < end; ++i) {
        const float* at = line + 2*(i - start);
        const float sum = axis == 0 ? at[1] + 0.5f*(at[0] + at[2]) : 0.75f*(at[1] + at[2]) + 0.25f*(at[0] + at[3]);
        out[i] = diagonal[i] > 0.0f ? sum : 0.0f;
    }
}
