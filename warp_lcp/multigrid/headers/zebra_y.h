// Solve for all cells of each column of the color at once; beside it are columns of the other one.
const T *before = weights + size + p; const int from = (P.first + color) % 2; const long long end = (long long)count*step;
for (long long at = 0; at < end; at += step)
    for (int k = from; k < n; k += 2) {
        const long long i = at + k; const T e = unit*(T)d[i], r = e != 0 ? b[i] - e*x[i] + neighbors(x, (int)i) : (T)0;
        t[i] = (r + (at ? before[i]*t[i - step] : (T)0))*pivots[i]; }
for (long long at = end - 2*step; at >= 0; at -= step) for (int k = from; k < n; k += 2) t[at + k] += multiples[at + k]*t[at + k + step];
for (long long at = 0; at < end; at += step) for (int k = from; k < n; k += 2) x[at + k] += t[at + k];
