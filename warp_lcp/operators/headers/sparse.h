// Kernels of sparse matrices in compressed sparse row format. ptr: begin of each row; col: column
// of each entry.

// kernel sparse.product: y = A x, or A x + plus
//   compute    S
//   reads      S plus?
//   writes     S y
//   whole      int32 ptr, col; A a; S x
//   by_cell
#include "snippets.h:entries"
ROWS {
    T s = plus ? plus[k] : (T)0;
    ENTRIES s += (T)a[e] * x[col[e]];
    y[k] = s;
}

// kernel sparse.relax: Projected SOR: x = clip(x - omega (A x + b) / d, lower, upper), row after
// row: all rows forward or backward, or the listed ones from place `first` on
//   compute    S
//   whole      int32 ptr, col; A a, d; int32 list?; S b, lower, upper, x
//   numbers    float64 omega; bool forward; int first
//   by_cell
#include "snippets.h:entries"
const auto relax = [&](long long i) {
    if (d[i] == 0) return;
    T s = b[i];
    ENTRIES s += (T)a[e] * x[col[e]];
    const T v = x[i] - (T)omega * s / (T)d[i], w = v < lower[i] ? lower[i] : v;
    x[i] = w > upper[i] ? upper[i] : w;
};
for (int k = 0; k < n; ++k)
    relax(list ? (long long)list[first + p + k] : forward ? p + k : p + n - 1 - k);

// kernel sparse.survey: Largest magnitude and diagonal of each row. Counts: entries below the
// diagonal without an equal one above it, and by how many entries one side has more
//   compute    float64
//   writes     float64 largest, diagonal
//   whole      int32 ptr, col; float64 a
//   sums       differ, more
//   by_cell
#include "snippets.h:entries"
// Place of a_ij in row i, whose columns ascend. If there is none: where it would be.
const auto across = [&](int i, int j) {
    int first = ptr[i], last = ptr[i + 1];
    while (first < last) {
        const int middle = first + (last - first) / 2;
        if (col[middle] < j)
            first = middle + 1;
        else
            last = middle;
    }
    return first;
};
double differ = 0, more = 0;
ROWS {
    T most = 0, own = 0;
    ENTRIES {
        const T v = a[e], size = v < 0 ? -v : v;
        const int j = col[e];
        most = most < size ? size : most;
        if (j == i)
            own = v;
        else if (j > i)
            more += 1;
        else {
            const int f = across(j, (int)i);
            more -= 1;
            differ += f == ptr[j + 1] || col[f] != i || a[f] != v;
        }
    }
    largest[k] = most;
    diagonal[k] = own;
}

// kernel sparse.gather: Entries in another order; 0 for an index below 0
//   compute    S
//   reads      int32 order
//   writes     S taken
//   whole      S source
//   by_cell
for (int k = 0; k < n; ++k) taken[k] = order[k] >= 0 ? source[order[k]] : 0;
