// Kernels of algebraic multigrid.

// kernel algebraic.fill: A row of P A P + P D P in a pattern with a full diagonal, and the values
// derived from it
//   compute    S
//   reads      A d; float64 shift?
//   writes     S inverse, scale, weight
//   whole      int32 ptr, col; A a; int32 order?; uint8 free; S m
//   by_cell
#include "snippets.h:entries"
ROWS {
    const bool own = free[i];
    const double extra = own && shift ? shift[k] : 0.0;
    double sum = 0, mid = 0;
    ENTRIES {
        const int j = col[e], from = order ? order[e] : e;
        double v = (own && free[j] && from >= 0) ? (double)a[from] : 0.0;
        if (j == i) {
            v += extra;
            mid = v;
        }
        m[e] = (T)v;
        sum += v < 0 ? -v : v;
    }
    const double size = (double)d[k] < 0 ? -(double)d[k] : (double)d[k];
    inverse[k] = sum > 0 ? (T)(1.0 / sum) : (T)0;
    scale[k] = own ? (extra > 0 ? (T)(size / (size + extra)) : (T)1) : (T)0;
    weight[k] = mid > 0 ? (T)(1.0 / mid) : (mid < 0 ? (T)(-1.0 / mid) : (T)(own ? 1 : 0));
}

// kernel algebraic.scale_rows: Rows of a matrix, each times its scale
//   compute    S
//   reads      S scale
//   whole      int32 ptr; S a, scaled
//   by_cell
#include "snippets.h:entries"
ROWS {
    const T f = scale[k];
    ENTRIES scaled[e] = f * a[e];
}

// kernel algebraic.multiply: A row of A B in a known pattern: `place` is the place of each product
// of an entry of A and one of B
//   compute    S
//   reads      int64 begins
//   whole      int32 ptr, col; S a; int32 right; S b; int32 starts; uint16 place; S result
//   by_cell
#include "snippets.h:entries"
ROWS {
    T* o = result + starts[i];
    const int entries = starts[i + 1] - starts[i];
    long long c = begins[k];
    for (int q = 0; q < entries; ++q) o[q] = 0;
    ENTRIES {
        const T v = a[e];
        const int begin = right[col[e]], length = right[col[e] + 1] - begin;
        if (v != 0)
            for (int q = 0; q < length; ++q) o[place[c + q]] += v * b[begin + q];
        c += length;
    }
}

// kernel algebraic.inverse: Reciprocal of the sum of the magnitudes of each row (l1 norm); 0 for
// rows of zeros
//   compute    S
//   writes     S inverse
//   whole      int32 ptr; S a
//   by_cell
#include "snippets.h:entries"
ROWS {
    T s = 0;
    ENTRIES s += a[e] < 0 ? -a[e] : a[e];
    inverse[k] = s > 0 ? (T)1 / s : (T)0;
}

// kernel algebraic.smooth: Jacobi sweep with l1 norms: y = x + omega (b - A x) / (norm of the row),
// from x = 0 if from_zero
//   compute    S
//   reads      S inverse, b
//   writes     S y
//   whole      int32 ptr, col; S a, x
//   numbers    S omega; bool from_zero
//   by_cell
#include "snippets.h:entries"
if (from_zero) {
    for (int k = 0; k < n; ++k) y[k] = omega * inverse[k] * b[k];
} else {
    ROWS {
        T s = b[k];
        ENTRIES s -= a[e] * x[col[e]];
        y[k] = x[i] + omega * inverse[k] * s;
    }
}

// kernel algebraic.remainder: Residual y = b - A x
//   compute    S
//   reads      S b
//   writes     S y
//   whole      int32 ptr, col; S a, x
//   by_cell
#include "snippets.h:entries"
ROWS {
    T s = b[k];
    ENTRIES s -= a[e] * x[col[e]];
    y[k] = s;
}
