// Kernels of matrices: in compressed sparse row format (ptr: begin of each row; col: column of each
// entry), dense, and of low rank.

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

// kernel dense.product: y = A x or A' x, summed in the order of the columns
//   compute    S
//   writes     S y
//   whole      A a; S x
//   numbers    int64 size; bool transposed
//   by_cell
for (int k = 0; k < n; ++k) {
    EXACT_MATH const auto* row = a + (transposed ? p + k : (p + k) * size);
    const long long step = transposed ? size : 1;
    T s = 0;
    for (long long j = 0; j < size; ++j) s += (T)row[j * step] * x[j];
    y[k] = s;
}

// kernel dense.relax: Projected SOR: x = clip(x - omega (A x + b) / d, lower, upper), row after row
// forward or backward; each row uses the values before it
//   compute    S
//   reads      S b, lower, upper
//   writes     S x
//   whole      A a
//   numbers    float64 omega; bool forward
//   by_cell
for (int k = 0; k < n; ++k) {
    EXACT_MATH const long long i = forward ? k : n - 1 - k;
    const auto* row = a + i * n;
    T s = b[i];
    if (row[i] == 0) continue;
    for (int j = 0; j < n; ++j) s += (T)row[j] * x[j];
    x[i] = wp::clamp(x[i] - (T)omega * s / (T)row[i], lower[i], upper[i]);
}

// snippet times: A product that is rounded on its own, or once together with the sum that it is
// added to.
const auto times = [](double u, double f) {
    if constexpr (FUSED)
        return u * f;
    else {
        EXACT_MATH return u * f;
    }
};

// kernel low_rank.gather: U'x over the entries of the columns, a column of sums each; rows with
// mask 0 are left out
//   compute    float64
//   whole      int32 entry_rows, blocks; V values; int32 count; S x; K mask?
//   numbers    int width, rank
//   sums       first
//   constants  FUSED = 1
//   by_cell
#include "times"
double* sums = given.out.data + P.t;
const int last = count[0];
if (!P.more)
    for (int q = 0; q < rank; ++q) sums[q * places] = 0;
for (int k = 0; k < n && p + k < last; ++k) {
    const long long e = p + k, column = (long long)blocks[e] * width;
    const double v = mask && mask[entry_rows[e]] == 0 ? 0.0 : (double)x[entry_rows[e]];
    for (int q = 0; q < width; ++q)
        sums[(column + q) * places] += times((double)values[e * width + q], v);
}
const double first = P.more ? 0 : sums[0];

// kernel low_rank.scatter: result = base + sign U f on the rows of U with a mask other than 0; the
// first entry of a row writes the sum of all
//   compute    float64
//   whole      int32 entry_rows, blocks; V values; int32 count; float64 factors; K mask?; S base,
//              result
//   numbers    int width; float64 sign
//   constants  FUSED = 1
//   by_cell
#include "times"
const int last = count[0];
for (int k = 0; k < n && p + k < last; ++k) {
    const long long e = p + k;
    const int row = entry_rows[e];
    double s = 0;
    if ((e > 0 && entry_rows[e - 1] == row) || (mask && mask[row] == 0)) continue;
    for (long long m = e; m < last && entry_rows[m] == row; ++m) {
        const auto* u = values + m * width;
        const double* f = factors + (long long)blocks[m] * width;
        for (int q = 0; q < width; ++q) s += times((double)u[q], f[q]);
    }
    result[row] = sign > 0 ? base[row] + s : base[row] - s;
}

// kernel low_rank.diagonal: result += the diagonal of U W U'
//   compute    float64
//   whole      int32 entry_rows, blocks; V values; int32 count; float64 weights, result
//   numbers    int width, rank
//   by_cell
const int last = count[0];
for (int k = 0; k < n && p + k < last; ++k) {
    EXACT_MATH const long long e = p + k;
    const int row = entry_rows[e];
    double s = 0;
    if (e > 0 && entry_rows[e - 1] == row) continue;
    for (long long m = e; m < last && entry_rows[m] == row; ++m)
        for (long long o = e; o < last && entry_rows[o] == row; ++o)
            for (int i = 0; i < width; ++i)
                for (int j = 0; j < width; ++j)
                    s += (double)values[m * width + i] * (double)values[o * width + j] *
                         weights[((long long)blocks[m] * width + i) * rank +
                                 (long long)blocks[o] * width + j];
    result[row] += s;
}
