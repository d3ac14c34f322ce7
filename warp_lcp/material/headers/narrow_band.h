// Kernel of the narrow band of particles.

// kernel warp_lcp.material.narrow_band.relax_depth: One pass of depth_i = min of depth_n + |i - n|
// over the 3^dimension - 1 cells n around i. In place: values only decrease, to a minimum that does
// not depend on the order of cells. If there is a `last_row`, rows are processed from the last one
// on.
//   compute    float32
//   whole      int32 changed
//   box        float32 depth
//   numbers    int planes, last_plane, last_row
const int nz = given.depth.shape[0], ny = given.depth.shape[1], nx = given.depth.shape[2];
const int k = last_row > 0 ? last_plane - P.k : P.k + k0,
          j = last_row > 0 ? last_row - P.j : P.j + j0;
T* d = given.depth.data + k * s1 + j * s2;
T best[M];
int shorter = 0;
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    T* here = d + start;
    int deep = 0;
    SIMD for (int m = 0; m < n; ++m) {
        best[m] = here[m];
        deep |= (int)(here[m] > (T)0.5);
    }
    if (!deep) continue;  // only air and the cells beside it
    const int low = start > 0 ? 0 : 1, high = start + n < nx ? n : n - 1;
    for (int c = planes == 2 && k > 0 ? -1 : 0; c <= (planes == 2 && k + 1 < nz ? 1 : 0); ++c)
        for (int b = j > 0 ? -1 : 0; b <= (j + 1 < ny ? 1 : 0); ++b) {
            const int across = (b != 0) + (c != 0);
            const T straight = across == 0 ? (T)0 : across == 1 ? (T)1 : (T)1.41421356;
            const T slant = across == 0 ? (T)1 : across == 1 ? (T)1.41421356 : (T)1.73205081;
            const T* row = here + c * s1 + b * s2;
            SIMD for (int m = 0; m < n; ++m) {
                const T v = row[m] + straight;
                best[m] = v < best[m] ? v : best[m];
            }
            SIMD for (int m = low; m < n; ++m) {
                const T v = row[m - 1] + slant;
                best[m] = v < best[m] ? v : best[m];
            }
            SIMD for (int m = 0; m < high; ++m) {
                const T v = row[m + 1] + slant;
                best[m] = v < best[m] ? v : best[m];
            }
        }
    SIMD for (int m = 0; m < n; ++m) {
        shorter |= (int)(best[m] < here[m]);
        here[m] = best[m];
    }
}
if (shorter) changed[0] = 1;
