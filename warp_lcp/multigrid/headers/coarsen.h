// Kernels that build coarse levels: Galerkin products over aggregates, and the matrix of the
// coarsest level.

// kernel coarsen.aggregates: Diagonals and weights of aggregates from the rows of the finer level,
// if one of these rows or one beside them has changed, since a face depends on both its cells. All
// kernels compute a row with the same bits. With equal weights the faces are counted in bytes and
// scaled at the end.
//   compute    S
//   stencil    F, S
//   writes     S coarse_d, coarse_wx, coarse_wy, coarse_wz
//   finer
//   by_row     uint8 coarse_changed
//   whole      uint8 changed
//   numbers    int cells; bool periodic_x, periodic_y, periodic_z; S stiffen, held
//   module     multigrid
#include "snippets.h:bytes"
const int fx = pairs ? 2 : 1, z0 = L.fz * P.k, y0 = L.fy * P.j, z_last = z0 + deep - 1,
          y_last = y0 + wide - 1;
const bool all = fx * L.fy * L.fz == 8, begins_y = y0 == 0, ends_y = y_last == L.n2 - 1,
           begins_z = z0 == 0, ends_z = z_last == L.n1 - 1;
const auto due = [&]() {
    for (int a = -1; a <= deep; ++a)
        for (int b = -1; b <= wide; ++b) {
            int z = z0 + a, y = y0 + b;
            if ((a < 0 || a >= deep) && (b < 0 || b >= wide)) continue;
            if (periodic_z) z = (z + L.n1) % L.n1;
            if (periodic_y) y = (y + L.n2) % L.n2;
            if (z >= 0 && z < L.n1 && y >= 0 && y < L.n2 && changed[z * L.n2 + y]) return true;
        }
    return false;
};
const bool make = due();
coarse_changed[P.row] = make;
if (make) {
    EXACT_MATH
    const auto counted = [](auto v) {
        if constexpr (sizeof(v) == 1)
            return v;
        else
            return (T)0;
    };
    typedef decltype(counted(*d)) B;
    constexpr bool COUNTS = sizeof(B) == 1;
    // of the diagonal: a smaller excess is rounding error
    constexpr T least = sizeof(T) == 4 ? (T)1e-6 : (T)1e-14;
    struct No {
        enum { value = 0 };
    };
    struct Yes {
        enum { value = 1 };
    };
    // Offsets to the rows around: a ghost row beyond the first or the last one, unless they wrap
    // around.
    const long long below_x = periodic_x ? cells - 1 : -1, above_x = periodic_x ? 1 - cells : 1;
    const long long below_y = begins_y && periodic_y ? (L.n2 - 1) * yp : -yp,
                    above_y = ends_y && periodic_y ? (1 - L.n2) * yp : yp;
    const long long below_z = begins_z && periodic_z ? (L.n1 - 1) * zp : -zp,
                    above_z = ends_z && periodic_z ? (1 - L.n1) * zp : zp;
    // a periodic axis of two cells has one aggregate and no outer faces
    const bool whole_x = fx == 2 && below_x == 1, whole_y = wide == 2 && below_y == yp,
               whole_z = deep == 2 && below_z == zp;
    const T scale = COUNTS ? unit : (T)1, se = scale * (all ? held : stiffen),
            sx = whole_x   ? (T)0
                 : fx == 2 ? scale
                           : scale * stiffen;
    const T sy = whole_y     ? (T)0
                 : L.fy == 2 ? scale
                             : scale * stiffen,
            sz = whole_z     ? (T)0
                 : L.fz == 2 ? scale
                             : scale * stiffen;
    B excess[2 * M], bx[2 * M], ax[2 * M], by[2 * M], ay[2 * M], bz[2 * M], az[2 * M], none[2 * M];
    const auto one = [](B v) { return (unsigned char)(v < (B)1 ? v : (B)1); };
    // weight of the face between two cells with these diagonals
    const auto face = [&](auto here, auto there, T c, const auto* w, int i) -> B {
        if constexpr (COUNTS)
            return (B)(one(here) & one(there) & (unsigned char)(c > 0));
        else if constexpr (STENCIL == 'v')
            return ((here != 0) & (there != 0)) ? (B)w[i] : (B)0;
        else
            return ((here != 0) & (there != 0)) ? (B)c : (B)0;
    };
    const auto from = [&](const auto* field, long long first) {
        const auto* q = field + first;
        OPAQUE(q);
        return q;
    };
    for (int begin = 0; begin < n; begin += M) {
        const int m = n - begin < M ? n - begin : (int)M, last = cells - 1 - fx * (P.first + begin);
        const long long p = fx * begin;
        // Cell i of row y in one plane or both: what it adds to the aggregate's excess and to the
        // outer faces below and above it. Rows are processed one after another, since prefetching
        // works best along them; planes together, which halves the passes. One loop serves both
        // rows, since this kernel takes longest to compile.
        const auto row = [&](auto both, int y, int begin, int end, long long left,
                             long long right) {
            enum { BOTH = decltype(both)::value };
            const long long at = p + y * yp, low_y = y ? -yp : below_y;
            const long long high_y = y || wide == 1 ? above_y : yp;
            B* first_by = y ? none : by;
            // One row of a plane: diagonals of cells and their neighbors, weights between them.
            struct Plane {
                const decltype(d + 0) e, e_left, e_right, e_below, e_above, e_down, e_up;
                decltype(wx + 0) left, right, below, above, down, up;
            };
            const auto plane = [&](long long k, long long down, long long up) -> Plane {
                return {from(d, k),         from(d, k + left),   from(d, k + right),
                        from(d, k + low_y), from(d, k + high_y), from(d, k + down),
                        from(d, k + up),    from(wx, k),         from(wx, k + 1),
                        from(wy, k),        from(wy, k + yp),    from(wz, k),
                        from(wz, k + zp)};
            };
            const Plane lower = plane(at, below_z, BOTH ? zp : above_z);
            const Plane upper = BOTH ? plane(at + zp, -zp, above_z) : lower;
            const auto cell = [&](int i) {
                B sum = excess[i], bx_ = bx[i], ax_ = ax[i], by_ = 0, ay_ = 0, bz_ = bz[i],
                  az_ = az[i];
                const auto add = [&](const Plane& P, auto is_upper) {
                    enum { UPPER = decltype(is_upper)::value };
                    const auto e = P.e[i];
                    const B f = face(e, P.e_left[i], cx, P.left, i);
                    const B g = face(e, P.e_right[i], cx, P.right, i);
                    const B h = face(e, P.e_below[i], cy, P.below, i);
                    const B l = face(e, P.e_above[i], cy, P.above, i);
                    const B o = face(e, P.e_down[i], cz, P.down, i);
                    const B q = face(e, P.e_up[i], cz, P.up, i);
                    if constexpr (COUNTS)
                        sum += (B)(e - f - g - h - l - o - q);
                    else {
                        const B s = unit * (T)e, v = s - f - g - h - l - o - q;
                        sum += v > least * s ? v : (B)0;
                    }
                    bx_ += f;
                    ax_ += g;
                    by_ += h;
                    ay_ += l;  // the last row's l counts
                    if (!UPPER) bz_ += o;
                    if (UPPER || !BOTH) az_ += q;
                };
                add(lower, No());
                if (BOTH) add(upper, Yes());
                excess[i] = sum;
                bx[i] = bx_;
                ax[i] = ax_;
                ay[i] = ay_;
                bz[i] = bz_;
                az[i] = az_;
                first_by[i] = by_;
            };
            if constexpr (COUNTS && MASKED_BYTES) {
                MASKED64 for (int i = begin; i < end; ++i) cell(i);
                return;
            }
            const int bytes = COUNTS ? begin + (end - begin) / 64 * 64 : begin;
            SIMD64 for (int i = begin; i < bytes; ++i) cell(i);
            SIMD for (int i = bytes; i < end; ++i) cell(i);
        };
        // all cells; then those again whose neighbor is at the other end of the row
        for (int part = 0; part < 3; ++part) {
            const int from = part == 2 ? last : 0, to = part == 0 ? fx * m : from + 1;
            if (part == 1 && (P.first + begin > 0 || below_x == -1)) continue;
            if (part == 2 && (last >= fx * m || above_x == 1)) continue;
            const long long left = part == 1 ? below_x : -1, right = part == 2 ? above_x : 1;
            SIMD for (int i = from; i < to; ++i) {
                excess[i] = 0;
                bx[i] = 0;
                ax[i] = 0;
                bz[i] = 0;
                az[i] = 0;
            }
            for (int y = 0; y < wide; ++y) {
                if (deep == 1)
                    row(No(), y, from, to, left, right);
                else
                    row(Yes(), y, from, to, left, right);
            }
        }
        T *dc = coarse_d + begin, *wxc = coarse_wx + begin, *wyc = coarse_wy + begin,
          *wzc = coarse_wz + begin;
        if (fx == 2) {
            SIMD for (int k = 0; k < m; ++k) {
                const int a = 2 * k, b = a + 1;
                const T x = sx * (T)bx[a], y = sy * (T)(B)(by[a] + by[b]),
                        z = sz * (T)(B)(bz[a] + bz[b]);
                wxc[k] = x;
                wyc[k] = y;
                wzc[k] = z;
                const T above =
                    sx * (T)ax[b] + sy * (T)(B)(ay[a] + ay[b]) + sz * (T)(B)(az[a] + az[b]);
                dc[k] = se * (T)(B)(excess[a] + excess[b]) + x + y + z + above;
            }
            // the last cell of an odd row is an aggregate of its own
            if (last < 2 * m && last % 2 == 0) dc[last / 2] += sx * (T)ax[last];
        } else {
            SIMD for (int k = 0; k < m; ++k) {
                const T x = sx * (T)bx[k], y = sy * (T)by[k], z = sz * (T)bz[k];
                wxc[k] = x;
                wyc[k] = y;
                wzc[k] = z;
                dc[k] =
                    se * (T)excess[k] + x + y + z + sx * (T)ax[k] + sy * (T)ay[k] + sz * (T)az[k];
            }
        }
    }
}

// kernel coarsen.compact: As coarsen.aggregates, for a compact stencil: an aggregate's weight to
// another one, by offset, is the sum of the weights between their cells
//   compute    S
//   stencil    F, W
//   writes     S coarse_d
//   finer
//   by_row     uint8 coarse_changed
//   whole      uint8 changed; S coarse_weights
//   numbers    int cells; int64 coarse_size; bool periodic_x, periodic_y, periodic_z; S stiffen,
//              held
//   constants  MASK = 0
const int fx = pairs ? 2 : 1, z0 = L.fz * P.k, y0 = L.fy * P.j;
const auto due = [&]() {
    for (int a = -1; a <= deep; ++a)
        for (int b = -1; b <= wide; ++b) {
            int z = z0 + a, y = y0 + b;
            if (periodic_z) z = (z + L.n1) % L.n1;
            if (periodic_y) y = (y + L.n2) % L.n2;
            if (z >= 0 && z < L.n1 && y >= 0 && y < L.n2 && changed[z * L.n2 + y]) return true;
        }
    return false;
};
const bool make = due();
coarse_changed[P.row] = make;
if (make) {
    EXACT_MATH
    // of the diagonal: a smaller excess is rounding error
    constexpr T least = sizeof(T) == 4 ? (T)1e-6 : (T)1e-14;
    const bool all = fx * L.fy * L.fz == 8 || (L.n1 == 1 && fx * L.fy >= 4);
    const int counts[3] = {cells, L.n2, L.n1}, factors[3] = {fx, L.fy, L.fz};
    const bool turns[3] = {periodic_x, periodic_y, periodic_z};
    for (int k = 0; k < n; ++k) {
        const int first[3] = {fx * (P.first + k), y0, z0};
        T sums[27], excess = 0, outer = 0;
        for (int o = 0; o < 27; ++o) sums[o] = 0;
        for (int z = 0; z < deep; ++z)
            for (int y = 0; y < wide; ++y)
                for (int x = 0; x < fx && first[0] + x < cells; ++x) {
                    const long long i = fx * k + x + y * yp + z * zp;
                    const T e = diagonal((int)i);
                    T rest = e;
                    if (e == 0) continue;
                    // axes along which a neighbor is in another aggregate, and whether the neighbor
                    // is free
                    const auto visit_turning = [&](int X, int Y, int Z, T w) {
                        const int at[3] = {first[0] + x + X, first[1] + y + Y, first[2] + z + Z};
                        const int steps[3] = {X, Y, Z};
                        const long long strides[3] = {1, yp, zp};
                        long long q = i;
                        int place = 13;
                        for (int a = 0; a < 3; ++a) {
                            const int beyond = at[a] < 0 ? -1 : at[a] >= counts[a] ? 1 : 0;
                            q += steps[a] * strides[a];
                            if (beyond && !turns[a]) return;
                            if (beyond) q -= beyond * counts[a] * strides[a];
                            const int there = at[a] / factors[a], here = first[a] / factors[a],
                                      o = beyond ? beyond : there - here;
                            // otherwise there is one aggregate, which is its own neighbor
                            if (!(beyond && counts[a] <= factors[a]))
                                place += o * (a == 0 ? 1 : a == 1 ? 3 : 9);
                        }
                        if (d[q] == 0) return;
                        rest -= w;
                        sums[place] += w;
                    };
                    const auto visit = [&](int X, int Y, int Z, T w) {
                        const int a = x + X, b = y + Y, c = z + Z,
                                  place = 13 + (a >= fx) - (a < 0) + 3 * ((b >= L.fy) - (b < 0)) +
                                          9 * ((c >= L.fz) - (c < 0));
                        const T v = d[i + X + Y * yp + Z * zp] != 0 ? w : (T)0;
                        rest -= v;
                        sums[place] += v;
                    };
                    const auto visit_all = [&](auto visit) {
#define BEFORE(W, X, Y, Z) visit(X, Y, Z, (T)W(i));
#define AND_AFTER(W, X, Y, Z) \
    BEFORE(W, X, Y, Z) visit(-(X), -(Y), -(Z), (T)W(i - (X) - (Y) * yp - (Z) * zp));
                        if constexpr (SYMMETRIC) {
                            EACH_WEIGHT(AND_AFTER)
                        } else {
                            EACH_WEIGHT(BEFORE)
                        }
#undef BEFORE
#undef AND_AFTER
                    };
                    if (periodic_x || periodic_y || periodic_z)
                        visit_all(visit_turning);
                    else
                        visit_all(visit);
                    excess += rest > least * e || rest < -least * e ? rest : (T)0;
                }
        int slot = 0;
        for (int o = 0; o < 27; ++o)
            if (o != 13) {
                const bool along_x = o % 3 != 1 && fx == 2, along_y = o / 3 % 3 != 1 && L.fy == 2,
                           along_z = o / 9 != 1 && L.fz == 2;
                const T w = along_x || along_y || along_z ? sums[o] : stiffen * sums[o];
                outer += w;
                if (MASK >> o & 1) coarse_weights[(slot++) * coarse_size + p + k] = w;
            }
        coarse_d[k] = (all ? held : stiffen) * excess + outer;
    }
}

// kernel coarsen.hold: out = d where `free`, else 0; mark the row if that changes it
//   compute    B
//   reads      A d; uint8 free
//   writes     B out_d
//   by_row     uint8 changed
unsigned char moved = 0;
const auto hold = [&](int k) -> unsigned char {
    const auto v = free[k] != 0 ? (B)d[k] : (B)0;
    const unsigned char differs = v != out_d[k];
    out_d[k] = v;
    return differs;
};
const int bytes = sizeof(B) == 1 ? n / 64 * 64 : 0;
SIMD64 for (int k = 0; k < bytes; ++k) moved |= hold(k);
SIMD for (int k = bytes; k < n; ++k) moved |= hold(k);
if (moved) changed[P.row] = 1;

// kernel coarsen.assemble: Rows of a small level's matrix from a compact stencil; cells that are no
// unknowns have a row of zeros
//   compute    float64
//   stencil    F, W
//   whole      float64 matrix
//   numbers    int cells, lines, planes; bool periodic_x, periodic_y, periodic_z
//   by_cell
const int m = planes * lines * cells;
for (int k = 0; k < n; ++k) {
    const int at[3] = {P.first + k, P.j, P.k}, counts[3] = {cells, lines, planes},
              r = (at[2] * lines + at[1]) * cells + at[0];
    const bool turns[3] = {periodic_x, periodic_y, periodic_z};
    const T e = diagonal(k);
    double* row = matrix + (long long)r * m;
    for (int c = 0; c < m; ++c) row[c] = 0;
    if (e == 0) continue;
    row[r] = e;
    const auto visit = [&](int X, int Y, int Z, T w) {
        const int steps[3] = {X, Y, Z};
        const long long strides[3] = {1, yp, zp};
        int c = 0;
        long long q = k;
        for (int a = 2; a >= 0; --a) {
            int i = at[a] + steps[a];
            q += steps[a] * strides[a];
            if (i < 0 || i >= counts[a]) {
                if (!turns[a]) return;
                const int turn = i < 0 ? counts[a] : -counts[a];
                i += turn;
                q += turn * strides[a];
            }
            c = c * counts[a] + i;
        }
        if (d[q] != 0) row[c] -= w;
    };
    const auto visit_all = [&](auto) {
#define BEFORE(W, X, Y, Z) visit(X, Y, Z, (T)W(k));
#define AND_AFTER(W, X, Y, Z) \
    BEFORE(W, X, Y, Z) visit(-(X), -(Y), -(Z), (T)W(k - (X) - (Y) * yp - (Z) * zp));
        if constexpr (SYMMETRIC) {
            EACH_WEIGHT(AND_AFTER)
        } else {
            EACH_WEIGHT(BEFORE)
        }
#undef BEFORE
#undef AND_AFTER
    };
    visit_all(0);
}

// kernel coarsen.eliminate: Inverse, transposed, of a small level's matrix by Gauss-Jordan
// elimination. The inverse has a row of zeros where there is no unknown, or where a pivot is
// rounding error compared with its diagonal.
//   compute    float64
//   whole      float64 matrix, inverse, own
//   numbers    int m; float64 least
//   by_cell
for (int r = 0; r < m; ++r) {
    own[r] = matrix[r * m + r];
    for (int c = 0; c < m; ++c) inverse[c * m + r] = r == c;
}
for (int c = 0; c < m; ++c) {
    const double pivot = matrix[c * m + c],
                 f = own[c] > 0 && pivot > least * own[c] ? 1 / pivot : 0.0;
    for (int j = 0; j < m; ++j) {
        matrix[c * m + j] *= f;
        inverse[j * m + c] *= f;
    }
    for (int r = 0; r < m; ++r)
        if (r != c) {
            const double g = matrix[r * m + c];
            if (g != 0) {
                for (int j = 0; j < m; ++j) {
                    matrix[r * m + j] -= g * matrix[c * m + j];
                    inverse[j * m + r] -= g * inverse[j * m + c];
                }
            }
        }
}

// kernel coarsen.invert: Columns of the inverse from the factors L D L', if a row of cells has
// changed. The diagonal of L is 1; the pivots are stored in its place
//   compute    float64
//   whole      uint8 changed; float64 matrix, inverse
//   numbers    int m, flags
//   module     grid
//   by_cell
const auto due = [&]() {
    for (int r = 0; r < flags; ++r)
        if (changed[r]) return true;
    return false;
};
if (due()) {
    const int first = (int)p, end = first + n;
    const double* factors = matrix;
    double* X = inverse;
    for (int r = 0; r < m; ++r) {
        SIMD8 for (int c = first; c < end; ++c) X[r * m + c] = r == c ? 1.0 : 0.0;
        for (int s = 0; s < r; ++s) {
            const double l = factors[r * m + s];
            SIMD8 for (int c = first; c < end; ++c) X[r * m + c] -= l * X[s * m + c];
        }
    }
    for (int r = m - 1; r >= 0; --r) {
        const double pivot = factors[r * m + r];
        SIMD8 for (int c = first; c < end; ++c) X[r * m + c] =
            pivot > 0 ? X[r * m + c] / pivot : 0.0;
        for (int s = r + 1; s < m; ++s) {
            const double l = pivot > 0 ? factors[s * m + r] : 0.0;
            SIMD8 for (int c = first; c < end; ++c) X[r * m + c] -= l * X[s * m + c];
        }
    }
}

// kernel coarsen.solve: x = inverse b for the cells nx, ny, nz of a small grid, by its dense
// symmetric inverse; adjacent threads read adjacent columns
//   compute    float64
//   whole      float64 inverse; S b, x
//   numbers    int nx, ny, nz
//   by_cell
const long long s2 = nx + 2, s1 = (ny + 2) * s2;
const int m = nz * ny * nx;
enum { R = BUFFERED == 1 ? 1 : 64 };
double v[R];
for (int begin = 0; begin < n; begin += R) {
    const int count = n - begin < R ? n - begin : (int)R;
    for (int r = 0; r < count; ++r) v[r] = 0;
    const double* row = inverse + p + begin;
    for (int k = 1; k <= nz; ++k)
        for (int j = 1; j <= ny; ++j) UNROLLED for (int i = 1; i <= nx; ++i, row += m) {
                const double value = (double)b[k * s1 + j * s2 + i];
                SIMD8 for (int r = 0; r < count; ++r) v[r] += row[r] * value;
            }
    for (int r = 0; r < count; ++r) {
        const int q = (int)p + begin + r;
        x[(q / (ny * nx) + 1) * s1 + (q / nx % ny + 1) * s2 + q % nx + 1] = v[r];
    }
}

// kernel renew.clear: Clear the part of a row's old span that is not in its new one, and mark the
// row
//   compute    S
//   writes     S x, b, t; F diagonals; S lower_x?, lower_y?, lower_z?
//   by_row     vec2i spans, known; uint8 changed
const auto old = known[P.row], now = spans[P.row];
if (old[0] != now[0] || old[1] != now[1]) {
    const int below = old[1] < now[0] ? old[1] : now[0], above = old[0] > now[1] ? old[0] : now[1];
    const auto clear = [&](auto* field) {
        const auto zero = [&](int from, int to) {
#ifdef __CUDA_ARCH__
            for (int k = from; k < to; ++k) field[k] = 0;
#else
            // memset, since a loop would be vectorized and compiled seven times
            if (from < to) __builtin_memset(field + from, 0, (to - from) * sizeof(*field));
#endif
        };
        if (field) {
            zero(old[0], below);
            zero(above, old[1]);
        }
    };
    clear(x);
    clear(b);
    clear(t);
    clear(diagonals);
    clear(lower_x);
    clear(lower_y);
    clear(lower_z);
    known[P.row] = now;
    changed[P.row] = 1;
}

// kernel renew.sign: Mark the row if the 64-bit hash of its weights has changed
//   compute    S
//   reads      S weight_x, weight_y, weight_z
//   by_row     uint64 signs; uint8 changed
unsigned one = 0, two = 0;
const auto add = [&](const auto* w, unsigned seed) {
    // including the last cell's upper face
    const unsigned* bits = (const unsigned*)w;
    const int words = (n + 1) * (int)(sizeof(*w) / 4);
    SIMD for (int k = 0; k < words; ++k) {
        unsigned v = bits[k] * 0x9E3779B1u + ((unsigned)k + seed) * 0x85EBCA77u;
        v ^= v >> 15;
        v *= 0x2C1B3C6Du;
        v ^= v >> 12;
        one += v;
        unsigned u = (bits[k] ^ 0xC2B2AE3Du) * 0x27D4EB2Fu + ((unsigned)k + seed) * 0x165667B1u;
        u ^= u >> 13;
        u *= 0x297A2D39u;
        u ^= u >> 16;
        two += u;
    }
};
add(weight_x, 1u << 20);
add(weight_y, 2u << 20);
add(weight_z, 3u << 20);
const unsigned long long sign = ((unsigned long long)one << 32) | two;
if (sign != signs[P.row]) {
    signs[P.row] = sign;
    changed[P.row] = 1;
}
