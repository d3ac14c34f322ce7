// A cell's kernel over the open cells: over its own cell its integral is 2/3 along an axis, over either neighbor 1/6. Cut ones follow.
const int nz = given.state.shape[0], ny = given.state.shape[1], nx = given.state.shape[2];
const float side = 1.0f/6.0f, middle = 2.0f/3.0f;
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    float sum[M + 2];
    const int from = start > 0 ? start - 1 : 0, end = start + n < nx ? start + n + 1 : nx;
    for (int m = 0; m < n + 2; ++m) sum[m] = 0.0f;
    for (int dk = planes == 2 ? -1 : 0; dk < planes; ++dk) {
        if (k + dk < 0 || k + dk >= nz) continue;
        for (int dj = -1; dj <= 1; ++dj) {
            if (j + dj < 0 || j + dj >= ny) continue;
            const float weight = (dj == 0 ? middle : side)*(planes == 1 ? 1.0f : (dk == 0 ? middle : side));
            const signed char* line = state + dk*s1 + dj*s2;
            SIMD for (int i = from; i < end; ++i) sum[i - start + 1] += line[i] == 1 ? weight : 0.0f;
        }
    }
    SIMD for (int m = 0; m < n; ++m) capacity[start + m] = side*(sum[m] + sum[m + 2]) + middle*sum[m + 1];
}
