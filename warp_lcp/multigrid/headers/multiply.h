#include "entries.h"
// A row of A B into a known pattern: `place` says where in it each product of an entry of A and one of B is added
ROWS {
    T* o = result + starts[i]; const int entries = starts[i + 1] - starts[i]; long long c = begins[k];
    for (int q = 0; q < entries; ++q) o[q] = 0;
    ENTRIES {
        const T v = a[e]; const int begin = right[col[e]], length = right[col[e] + 1] - begin;
        if (v != 0) for (int q = 0; q < length; ++q) o[place[c + q]] += v*b[begin + q];
        c += length; } }
