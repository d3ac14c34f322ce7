#include "entries.h"
// Each row's largest magnitude and diagonal; entries below the diagonal without an equal one above it, and how many more lie on one side.
const auto across = [&](int i, int j) {  // a_ij, of row i, whose columns ascend; beyond the last one, where there is none
    int first = ptr[i], last = ptr[i + 1];
    while (first < last) { const int middle = first + (last - first)/2; if (col[middle] < j) first = middle + 1; else last = middle; }
    return first; };
double differ = 0, more = 0;
ROWS {
    T most = 0, own = 0;
    ENTRIES {
        const T v = a[e], size = v < 0 ? -v : v; const int j = col[e]; most = most < size ? size : most;
        if (j == i) own = v;
        else if (j > i) more += 1;
        else { const int f = across(j, (int)i); more -= 1; differ += f == ptr[j + 1] || col[f] != i || a[f] != v; } }
    largest[k] = most; diagonal[k] = own; }
