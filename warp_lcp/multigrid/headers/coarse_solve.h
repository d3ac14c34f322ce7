// x = inverse b of the cells nx, ny, nz of a small grid, by its dense symmetric inverse; each thread reads columns beside its neighbor's
const long long s2 = nx + 2, s1 = (ny + 2)*s2; const int m = nz*ny*nx;
enum { R = BUFFERED == 1 ? 1 : 64 };
double v[R];
for (int begin = 0; begin < n; begin += R) {
    const int count = n - begin < R ? n - begin : (int)R;
    for (int r = 0; r < count; ++r) v[r] = 0;
    const double* row = inverse + p + begin;
    for (int k = 1; k <= nz; ++k) for (int j = 1; j <= ny; ++j) UNROLLED for (int i = 1; i <= nx; ++i, row += m) {
        const double value = (double)b[k*s1 + j*s2 + i];
        SIMD8 for (int r = 0; r < count; ++r) v[r] += row[r]*value; }
    for (int r = 0; r < count; ++r) {
        const int q = (int)p + begin + r; x[(q / (ny*nx) + 1)*s1 + (q / nx % ny + 1)*s2 + q % nx + 1] = v[r]; } }
