#include "times.h"
// U'x over the columns' entries, a column of sums each; rows whose mask is 0 count for nothing
double* sums = given.out.data + P.t; const int last = count[0];
if (!P.more) for (int q = 0; q < rank; ++q) sums[q*places] = 0;
for (int k = 0; k < n && p + k < last; ++k) {
    const long long e = p + k, column = (long long)blocks[e]*width; const double v = mask && mask[entry_rows[e]] == 0 ? 0.0 : (double)x[entry_rows[e]];
    for (int q = 0; q < width; ++q) sums[(column + q)*places] += times((double)values[e*width + q], v); }
const double first = P.more ? 0 : sums[0];
