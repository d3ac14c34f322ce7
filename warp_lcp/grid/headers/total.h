// Add up particles: |v|^2, x, bad x and v, v; the largest |v|^2, highest x and lowest x with the other sign. On CUDA a thread takes every
// `chunks`-th, its neighbor the next.
#ifdef __CUDA_ARCH__
enum { LANES = 1 };
#else
enum { LANES = 16 };
#endif
const T* position = (const T*)given.position.data; const T* velocity = (const T*)given.velocity.data;
#ifdef __CUDA_ARCH__
const int begin = c_, end = L.nx, stride = L.chunks;
#else
const int begin = first, end = last, stride = LANES;
#endif
double squares[LANES], sum[3][LANES], way[3][LANES]; T low[3][LANES], high[3][LANES], fastest[LANES]; int bad_x[LANES], bad_v[LANES];
for (int m = 0; m < LANES; ++m) {
    squares[m] = 0; fastest[m] = 0; bad_x[m] = 0; bad_v[m] = 0;
    for (int d = 0; d < 3; ++d) { sum[d][m] = way[d][m] = 0; low[d][m] = high[d][m] = position[3*(long long)begin + d]; }
}
for (int start = begin; start < end; start += stride) {
    const int n = end - start < LANES ? end - start : (int)LANES;
    const T* X = position + 3*(long long)start; const T* V = velocity + 3*(long long)start;
    SIMD for (int m = 0; m < n; ++m) {
        const T x = X[3*m], y = X[3*m + 1], z = X[3*m + 2], u = V[3*m], v = V[3*m + 1], w = V[3*m + 2];
        const T speed = u*u + v*v + w*w, most = (T)3.4028234e38;
        squares[m] += (double)speed; sum[0][m] += (double)x; sum[1][m] += (double)y; sum[2][m] += (double)z;
        way[0][m] += (double)u; way[1][m] += (double)v; way[2][m] += (double)w;
        low[0][m] = x < low[0][m] ? x : low[0][m]; high[0][m] = x > high[0][m] ? x : high[0][m];
        low[1][m] = y < low[1][m] ? y : low[1][m]; high[1][m] = y > high[1][m] ? y : high[1][m];
        low[2][m] = z < low[2][m] ? z : low[2][m]; high[2][m] = z > high[2][m] ? z : high[2][m];
        fastest[m] = speed > fastest[m] ? speed : fastest[m];
        bad_v[m] += !(speed <= most);
        const int fine = (int)(x <= most) & (int)(x >= -most) & (int)(y <= most) & (int)(y >= -most);
        bad_x[m] += !(fine & (int)(z <= most) & (int)(z >= -most));
    }
}
for (int m = 1; m < LANES; ++m) {
    squares[0] += squares[m]; bad_x[0] += bad_x[m]; bad_v[0] += bad_v[m];
    fastest[0] = fastest[m] > fastest[0] ? fastest[m] : fastest[0];
    for (int d = 0; d < 3; ++d) {
        sum[d][0] += sum[d][m]; way[d][0] += way[d][m];
        low[d][0] = low[d][m] < low[d][0] ? low[d][m] : low[d][0]; high[d][0] = high[d][m] > high[d][0] ? high[d][m] : high[d][0];
    }
}
energy = squares[0]; top = fastest[0]; lost = bad_x[0]; wild = bad_v[0];
x = sum[0][0]; y = sum[1][0]; z = sum[2][0]; u = way[0][0]; v = way[1][0]; w = way[2][0];
high_x = high[0][0]; high_y = high[1][0]; high_z = high[2][0]; low_x = -low[0][0]; low_y = -low[1][0]; low_z = -low[2][0];
