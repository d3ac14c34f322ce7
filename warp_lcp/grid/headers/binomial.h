// One binomial pass (1, 2, 1)/4 along every axis; there is nothing outside the array.
const int nz = given.source.shape[0], ny = given.source.shape[1], nx = given.source.shape[2];
const T wy[3] = {j > 0 ? (T)0.25 : (T)0, (T)0.5, j + 1 < ny ? (T)0.25 : (T)0};
const T wz[3] = {planes == 2 && k > 0 ? (T)0.25 : (T)0, planes == 2 ? (T)0.5 : (T)1, planes == 2 && k + 1 < nz ? (T)0.25 : (T)0};
T sum[M + 2];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    const int low = start > 0 ? -1 : 0, high = start + n < nx ? n + 1 : n;
    sum[0] = 0; sum[n + 1] = 0;
    SIMD for (int m = low; m < high; ++m) sum[m + 1] = 0;
    for (int c = 0; c < 3; ++c) for (int b = 0; b < 3; ++b) {
        const T w = wz[c]*wy[b];
        if (w == 0) continue;
        const T* row = source + ((c - 1)*s1 + (b - 1)*s2 + start);
        SIMD for (int m = low; m < high; ++m) sum[m + 1] += w*row[m];
    }
    SIMD for (int m = 0; m < n; ++m) out[start + m] = (T)0.5*sum[m + 1] + (T)0.25*(sum[m] + sum[m + 2]);
}
