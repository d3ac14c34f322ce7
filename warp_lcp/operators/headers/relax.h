#include "entries.h"
// x = clip(x - omega (A x + b) / d, lower, upper), row after row: all forward or backwards, or those listed from place `first` on
const auto relax = [&](long long i) {
    if (d[i] == 0) return;
    T s = b[i]; ENTRIES s += (T)a[e]*x[col[e]];
    const T v = x[i] - (T)omega*s/(T)d[i], w = v < lower[i] ? lower[i] : v;
    x[i] = w > upper[i] ? upper[i] : w; };
for (int k = 0; k < n; ++k) relax(list ? (long long)list[first + p + k] : forward ? p + k : p + n - 1 - k);
