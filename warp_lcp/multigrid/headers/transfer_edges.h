#include "transfer.h"
// How cells share in coarse ones, which are every second cell: as themselves; or, between two along an axis, by the weights towards them,
// summed across, over these and what holds the row (Dendy's black-box multigrid).
const bool odd_y = fy == 2 && P.j % 2;
for (int k = 0; k < n; ++k) {
    const long long at = p + k; const bool odd_x = fx == 2 && (P.first + k) % 2; const T e = d[k];
    T a = 0, b = 0, sum = 0, size_of = 0;
    if (e != 0 && odd_x != odd_y) {
        for (int y = -1; y < 2; ++y) for (int x = -1; x < 2; ++x) if (x || y) {
            const T w = v(x, y, at); sum += w; size_of += w < 0 ? -w : w;
            if ((odd_x ? x : y) < 0) a += w; else if ((odd_x ? x : y) > 0) b += w; }
        const T held = e - sum > (sizeof(T) == 4 ? (T)1e-6 : (T)1e-12)*(size_of + e) ? e - sum : (T)0;
        a = a > 0 ? a : (T)0; b = b > 0 ? b : (T)0;
        const T all = a + b + held;
        if (a + b > (T)1e-6*size_of) { a /= all; b /= all; }
        else { a = size_of > 0 ? (T)1 : (T)0; b = 0; } }  // one alone: two coarse cells that share in one would be the same
    shares[at] = odd_x || odd_y ? a : e != 0 ? (T)1 : (T)0;
    shares[size + at] = odd_x && !odd_y ? b : (T)0; shares[2*size + at] = odd_y && !odd_x ? b : (T)0; shares[3*size + at] = 0; }
