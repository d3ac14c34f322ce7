// Solve for all cells of each column of the color at once; beside it are columns of the other one, which move by 0.
const T *before = weights + size + p; const long long end = (long long)count*step; const int even = (P.first + color) % 2;
for (long long at = 0; at < end; at += step) {
    const T *e = d + at, *w = before + at, *f = pivots + at, *v = b + at, *u = x + at, *below = t + at - (at ? step : 0); T* to = t + at;
    SIMD for (int k = 0; k < n; ++k) {
        const T g = unit*e[k], r = v[k] - g*u[k] + neighbors(x, (int)at + k), s = at ? w[k]*below[k] : (T)0;
        to[k] = k % 2 == even && g != 0 ? (r + s)*f[k] : (T)0; } }
for (long long at = end - 2*step; at >= 0; at -= step) {
    const T *m = multiples + at, *above = t + at + step; T* to = t + at;
    SIMD for (int k = 0; k < n; ++k) to[k] += m[k]*above[k]; }
for (long long at = 0; at < end; at += step) { T *u = x + at, *s = t + at; SIMD for (int k = 0; k < n; ++k) u[k] += s[k]; }
