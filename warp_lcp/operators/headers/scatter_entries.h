#include "times.h"
// result = base + sign U f on U's rows where the mask is not 0; the first entry of a row writes for all of them
const int last = count[0];
for (int k = 0; k < n && p + k < last; ++k) {
    const long long e = p + k; const int row = entry_rows[e]; double s = 0;
    if ((e > 0 && entry_rows[e - 1] == row) || (mask && mask[row] == 0)) continue;
    for (long long m = e; m < last && entry_rows[m] == row; ++m) {
        const auto* u = values + m*width; const double* f = factors + (long long)blocks[m]*width;
        for (int q = 0; q < width; ++q) s += times((double)u[q], f[q]); }
    result[row] = sign > 0 ? base[row] + s : base[row] - s; }
