// Kernels of black-box multigrid in 2-D (Dendy): operator-dependent transfers, line relaxation.

// kernel lines.fill: Weights and diagonal of a level that is stored whole: weights from free cells
// to free neighbors; the diagonal includes the shift
//   compute    S
//   stencil    D, W
//   reads      uint8 free; float64 shift?
//   writes     S made, weight?
//   whole      S weights
//   numbers    int64 size
//   by_cell
for (int k = 0; k < n; ++k) {
    const T e = free[k] ? diagonal(k) + (shift ? (T)shift[k] : (T)0) : (T)0;
    T v[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0};
#define BEFORE(W, X, Y, Z) \
    v[3 * (Y) + (X) + 4] = free[k + (X) + beside(Y, Z, zm, zp)] ? (T)W(k) : (T)0;
#define AND_AFTER(W, X, Y, Z)                                               \
    BEFORE(W, X, Y, Z)                                                      \
    v[4 - 3 * (Y) - (X)] = free[k - (X) + beside(-(Y), -(Z), zm, zp)]       \
                               ? (T)W(k - (X) + beside(-(Y), -(Z), zm, zp)) \
                               : (T)0;
    if constexpr (SYMMETRIC) {
        EACH_WEIGHT(AND_AFTER)
    } else {
        EACH_WEIGHT(BEFORE)
    }
#undef BEFORE
#undef AND_AFTER
    made[k] = e;
    for (int o = 0; o < 9; ++o)
        if (o != 4) weights[(o < 4 ? o : o - 1) * size + p + k] = e != 0 ? v[o] : (T)0;
    if (weight) weight[k] = e != 0 ? 1 / e : (T)0;
}

// snippet transfer: Weights of a compact level for transfers: v(x, y, k) is the weight from cell k
// to a neighbor (SAME); for restriction that from the neighbor to the cell; for prolongation the
// mean of both.
const auto of_row = [&](int x, int y, long long k) -> T {
    const int o = 3 * y + x + 4;
    return weights[(o < 4 ? o : o - 1) * size + k];
};
const auto v = [&](int x, int y, long long k) -> T {
    if constexpr (SAME)
        return of_row(x, y, k);
    else {
        const T there = of_row(-x, -y, k + x + y * yp);
        return RESTRICTION ? there : (of_row(x, y, k) + there) / 2;
    }
};

// kernel lines.edges: Shares of cells in coarse cells, which are every second cell. A coarse cell
// has the share 1 in itself. A cell between two coarse ones along an axis has the weights towards
// them, summed across the axis, divided by the sum of these weights and what holds the row (Dendy's
// black-box multigrid).
//   compute    S
//   reads      S d
//   whole      S weights, shares
//   numbers    int64 size; int fx, fy
//   constants  SAME = 0, RESTRICTION = 0
//   by_cell
#include "transfer"
const bool odd_y = fy == 2 && P.j % 2;
for (int k = 0; k < n; ++k) {
    const long long at = p + k;
    const bool odd_x = fx == 2 && (P.first + k) % 2;
    const T e = d[k];
    T a = 0, b = 0, sum = 0, size_of = 0;
    if (e != 0 && odd_x != odd_y) {
        for (int y = -1; y < 2; ++y)
            for (int x = -1; x < 2; ++x)
                if (x || y) {
                    const T w = v(x, y, at);
                    sum += w;
                    size_of += w < 0 ? -w : w;
                    if ((odd_x ? x : y) < 0)
                        a += w;
                    else if ((odd_x ? x : y) > 0)
                        b += w;
                }
        const T held =
            e - sum > (sizeof(T) == 4 ? (T)1e-6 : (T)1e-12) * (size_of + e) ? e - sum : (T)0;
        a = a > 0 ? a : (T)0;
        b = b > 0 ? b : (T)0;
        const T all = a + b + held;
        if (a + b > (T)1e-6 * size_of) {
            a /= all;
            b /= all;
        } else {
            a = size_of > 0 ? (T)1 : (T)0;
            b = 0;
        }
    }
    // Without positive weights one coarse cell alone gets a share: two that share in the same cell
    // only would be equal.
    shares[at] = odd_x || odd_y ? a : e != 0 ? (T)1 : (T)0;
    shares[size + at] = odd_x && !odd_y ? b : (T)0;
    shares[2 * size + at] = odd_y && !odd_x ? b : (T)0;
    shares[3 * size + at] = 0;
}

// kernel lines.corners: Shares of cells between four coarse ones: the cell's row applied to its
// neighbors' shares
//   compute    S
//   reads      S d
//   whole      S weights, shares
//   numbers    int64 size; int fx, fy
//   constants  SAME = 0, RESTRICTION = 0
//   by_cell
#include "transfer"
if (fx == 2 && fy == 2 && P.j % 2)
    for (int k = 1 - P.first % 2; k < n; k += 2) {
        const long long at = p + k;
        const T e = d[k];
        const auto share = [&](int slot, int x, int y) -> T {
            return shares[slot * size + at + x + y * yp];
        };
        const T inverse = e != 0 ? 1 / e : (T)0, west = v(-1, 0, at), east = v(1, 0, at),
                south = v(0, -1, at), north = v(0, 1, at);
        shares[at] = inverse * (v(-1, -1, at) + south * share(0, 0, -1) + west * share(0, -1, 0));
        shares[size + at] =
            inverse * (v(1, -1, at) + south * share(1, 0, -1) + east * share(0, 1, 0));
        shares[2 * size + at] =
            inverse * (v(-1, 1, at) + north * share(0, 0, 1) + west * share(2, -1, 0));
        shares[3 * size + at] =
            inverse * (v(1, 1, at) + north * share(1, 0, 1) + east * share(2, 1, 0));
    }

// kernel lines.galerkin: A row of R A P. R and P are the shares of fine cells in the four coarse
// ones around them. The product of compact stencils is compact
//   compute    S
//   writes     S coarse_d
//   other      S unused
//   finer
//   whole      S weights, diagonals, shares, restricts, coarse_weights
//   numbers    int64 size, coarse_size; int cells
//   constants  FX = 2, FY = 2
//   by_cell
const int j0 = FY * P.j, below = FY == 2 && j0 > 0 ? -1 : 0,
          above = FY == 2 && j0 + 1 < L.n2 ? 1 : 0;
for (int k = 0; k < n; ++k) {
    const int i0 = FX * (P.first + k), left = FX == 2 && i0 > 0 ? -1 : 0,
              right = FX == 2 && i0 + 1 < cells ? 1 : 0;
    const long long at = P.q + FX * k;
    T C[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0}, magnitude = 0;
    for (int y = below; y <= above; ++y)
        for (int x = left; x <= right; ++x) {
            const long long f = at + x + y * yp;
            const T r = restricts[((x < 0) + 2 * (y < 0)) * size + f];
            if (r == 0) continue;
            for (int b = -1; b < 2; ++b)
                for (int a = -1; a < 2; ++a) {
                    const int o = 3 * b + a + 4, X = x + a, Y = y + b;
                    const long long g = f + a + b * yp;
                    const T w = o == 4 ? diagonals[f] : -weights[(o < 4 ? o : o - 1) * size + f],
                            v = r * w;
                    if (v == 0) continue;
                    const int to_x = FX == 2 ? (X + 2) / 2 - 1 : X,
                              to_y = FY == 2 ? (Y + 2) / 2 - 1 : Y;
                    const bool two_x = FX == 2 && (X & 1), two_y = FY == 2 && (Y & 1);
                    T* c = C + 3 * to_y + to_x + 4;
                    const T* s = shares + g;
                    const T q = v * s[0];
                    c[0] += q;
                    magnitude += q < 0 ? -q : q;
                    if (two_x) c[1] += v * s[size];
                    if (two_y) {
                        c[3] += v * s[2 * size];
                        if (two_x) c[4] += v * s[3 * size];
                    }
                }
        }
    const bool kept = C[4] > (sizeof(T) == 4 ? (T)1e-6 : (T)1e-13) * magnitude;
    coarse_d[k] = kept ? C[4] : (T)0;
    for (int o = 0; o < 9; ++o)
        if (o != 4) coarse_weights[(o < 4 ? o : o - 1) * coarse_size + p + k] = kept ? -C[o] : (T)0;
}

// kernel lines.factor: Factor the tridiagonal matrices of lines of cells, `step` apart: reciprocals
// of the pivots, and multiples that couple cells to the next ones
//   compute    S
//   reads      S unused
//   whole      S weights, diagonals, pivots, multiples
//   numbers    int64 size, step; int count
//   by_cell
// lines that are processed side by side
const int before = step == 1 ? 3 : 1, after = step == 1 ? 4 : 6, side = step == 1 ? 1 : n;
const T *e = diagonals + p, *w = weights + before * size + p, *v = weights + after * size + p;
T *f = pivots + p, *q = multiples + p;
for (int i = 0; i < count; ++i, e += step, w += step, v += step, f += step, q += step)
    SIMD for (int k = 0; k < side; ++k) {
        const T m = e[k] - (i ? w[k] * q[k - step] : (T)0), whole = m > (T)1e-6 * e[k] ? m : e[k],
                inverse = 1 / (whole != 0 ? whole : (T)1);
        f[k] = e[k] != 0 ? inverse : (T)0;
        q[k] = e[k] != 0 ? v[k] * inverse : (T)0;
    }

// kernel lines.zebra_x: Line relaxation along x: solve for all cells of a row at once, if it has
// the color
//   compute    S
//   stencil    S, S
//   reads      S b, pivots, multiples
//   writes     S x, t
//   whole      S weights
//   numbers    int64 size; int color
//   by_cell
if (P.j % 2 == color) {
    const T* before = weights + 3 * size + p;
    SIMD for (int k = 0; k < n; ++k) {
        const T e = diagonal(k);
        t[k] = e != 0 ? b[k] - e * x[k] + neighbors(x, k) : (T)0;
    }
    T z = 0;
    for (int k = 0; k < n; ++k) {
        z = (t[k] + before[k] * z) * pivots[k];
        t[k] = z;
    }
    z = 0;
    for (int k = n - 1; k >= 0; --k) {
        z = t[k] + multiples[k] * z;
        t[k] = z;
    }
    SIMD for (int k = 0; k < n; ++k) x[k] += t[k];
}

// kernel lines.zebra_y: Line relaxation along y: solve for all cells of each column of the color at
// once; the columns beside it have the other color and do not move
//   compute    S
//   stencil    S, S
//   reads      S b, pivots, multiples
//   writes     S x, t
//   whole      S weights
//   numbers    int64 size, step; int count, color
//   by_cell
const T* before = weights + size + p;
const long long end = (long long)count * step;
const int even = (P.first + color) % 2;
for (long long at = 0; at < end; at += step) {
    const T *e = d + at, *w = before + at, *f = pivots + at, *v = b + at, *u = x + at,
            *below = t + at - (at ? step : 0);
    T* to = t + at;
    SIMD for (int k = 0; k < n; ++k) {
        const T g = unit * e[k], r = v[k] - g * u[k] + neighbors(x, (int)at + k),
                s = at ? w[k] * below[k] : (T)0;
        to[k] = k % 2 == even && g != 0 ? (r + s) * f[k] : (T)0;
    }
}
for (long long at = end - 2 * step; at >= 0; at -= step) {
    const T *m = multiples + at, *above = t + at + step;
    T* to = t + at;
    SIMD for (int k = 0; k < n; ++k) to[k] += m[k] * above[k];
}
for (long long at = 0; at < end; at += step) {
    T *u = x + at, *s = t + at;
    SIMD for (int k = 0; k < n; ++k) u[k] += s[k];
}

// kernel lines.residual: Residual t = b - A x
//   compute    S
//   stencil    S, S
//   reads      S x, b
//   writes     S t
SIMD for (int k = 0; k < n; ++k) {
    const T e = diagonal(k), v = b[k] - e * x[k] + neighbors(x, k);
    t[k] = e != 0 ? v : (T)0;
}

// kernel lines.down: Restriction: sums of a fine field over the shares of coarse cells
//   compute    S
//   writes     S coarse
//   other      S t, shares
//   finer
//   numbers    int64 size; int cells, fx, fy
//   by_cell
const int j0 = fy * P.j;
const bool below = fy == 2 && j0 > 0, above = fy == 2 && j0 + 1 < L.n2;
for (int k = 0; k < n; ++k) {
    const int i0 = fx * (P.first + k);
    const long long at = fx * k;
    const bool left = fx == 2 && i0 > 0, right = fx == 2 && i0 + 1 < cells;
    const auto row = [&](long long f, int slot) -> T {
        const T* s = shares + slot * size;
        T v = s[f] * t[f];
        if (right) v += s[f + 1] * t[f + 1];
        if (left) v += s[size + f - 1] * t[f - 1];
        return v;
    };
    T v = row(at, 0);
    if (above) v += row(at + yp, 0);
    if (below) v += row(at - yp, 2);
    coarse[k] = v;
}

// kernel lines.up: Prolongation: x += the coarse field weighted by the cells' shares, or x = that
//   compute    S
//   reads      S d
//   writes     S x
//   other      S coarse
//   whole      S shares
//   numbers    int64 size; bool add
//   by_cell
const long long up_ = L.o2;
for (int k = 0; k < n; ++k) {
    const long long at = p + k;
    const T* c = coarse + (L.fx < -1 ? k / 2 : k);
    const T v = shares[at] * c[0] + shares[size + at] * c[1] + shares[2 * size + at] * c[up_] +
                shares[3 * size + at] * c[up_ + 1];
    x[k] = d[k] != 0 ? (add ? x[k] : (T)0) + v : (T)0;
}

// kernel lines.zero: x = 0
//   compute    S
//   writes     S x
SIMD for (int k = 0; k < n; ++k) x[k] = 0;
