// Kernels of multigrid cycles on grids.

// snippet relax: x + weight (b - A x) / diagonal at cell k, from x there and the weighted sum of x
// around it.
const auto relaxed = [&](T x, T sum_around, T weight, int k, T e) -> T {
    return x + weight * (quotient(b[k] + sum_around, e) - x);
};

// snippet sweep: y = the relaxed value, clipped to the bounds if projected; 0 where there is no
// unknown.
#include "relax"
const auto from_b = [&](int k, T e) -> T { return quotient(omega * b[k], e); };
const auto from_x = [&](int k, T e) -> T {
    return relaxed(x[k], around(x, k, down, up), omega, k, e);
};
const auto sweep = [&](auto value, auto clip) {
    SIMD for (int k = 0; k < n; ++k) {
        const T e = diagonal(k), u = value(k, e != 0 ? e : (T)1), v = e != 0 ? u : (T)0;
        y[k] = clip(k, v);
    }
};
const auto clips = [&](auto value) {
    if (!projected)
        sweep(value, [](int, T v) { return v; });
    else if (upper)
        sweep(value, [&](int k, T v) { return clipped(v, lower[k], upper[k]); });
    else
        sweep(value, [&](int k, T v) { return v < lower[k] ? lower[k] : v; });
};

// kernel cycle.sweep: Jacobi sweep: y = x + omega (b - A x) / diagonal, clipped to the bounds if
// projected; from_zero: with x = 0
//   compute    S
//   stencil    F, S
//   reads      S x, b, lower?, upper?
//   writes     S y
//   numbers    S omega; bool from_zero, projected
#include "sweep"
if (from_zero)
    clips(from_b);
else
    clips(from_x);

// snippet sweep_again: y = a sweep of `value(k, at)`, the value at cell k of a row `at` elements
// from this one. Values are computed again for each neighbor instead of stored. `choose_clip`
// passes a function that clips values to the bounds.
// Without inlining the compiler calls the functions, with their fields in memory.
#define INLINED __attribute__((always_inline))
const auto diagonal_of = [&](int k, int at) -> T { return unit * (T)(d + at)[k]; };
const auto sweep_again = [&](auto value, auto clip) INLINED {
    SIMD for (int k = 0; k < n; ++k) {
        const auto there = [&](int i, int rows, int planes) {
            return value(i, (int)beside(rows, planes, zm, zp));
        };
        const T e = diagonal(k), u = value(k, 0), r = b[k] + around_of(there, k);
        const T v = u + omega * (quotient(r, e != 0 ? e : (T)1) - u);
        y[k] = clip(k, 0, e != 0 ? v : (T)0);
    }
};
const auto choose_clip = [&](auto sweeps) INLINED {
    if (!projected)
        sweeps([](int, int, T v) { return v; });
    else if (upper)
        sweeps([&](int k, int at, T v) { return clipped(v, (lower + at)[k], (upper + at)[k]); });
    else
        sweeps([&](int k, int at, T v) {
            const T l = (lower + at)[k];
            return v < l ? l : v;
        });
};

// kernel cycle.out_of_ring: As cycle.sweep, from a ring buffer of planes, never from zero
//   compute    S
//   stencil    F, S
//   reads      S x, b, lower?, upper?
//   writes     S y
//   ring       x
//   numbers    S omega; bool projected
//   module     multigrid
#include "sweep"
clips(from_x);

// kernel cycle.into_ring: As cycle.sweep, into a ring buffer of planes. The buffer's previous plane
// may be wider: clear what rows beside this one read of it
//   compute    S
//   stencil    F, S
//   reads      S x, b, lower?, upper?
//   writes     S y
//   ring       y
//   numbers    S omega; bool from_zero, projected
//   module     multigrid
if (L.spans.data) {
    int from = P.first, to = P.first + n;
    const auto look = [&](int k, int j) {
        const auto span = L.spans.data[(k + L.planes) % L.planes * L.rows + (j + L.rows) % L.rows];
        if (span[1] > span[0]) {
            from = span[0] < from ? span[0] : from;
            to = span[1] > to ? span[1] : to;
        }
    };
    look(P.k - 1, P.j);
    look(P.k + 1, P.j);
    look(P.k, P.j - 1);
    look(P.k, P.j + 1);
    for (int k = (from > 0 ? from - 1 : 0) - P.first; k < 0; ++k) y[k] = 0;
    for (int k = n; k < (to < L.nx ? to + 1 : L.nx) - P.first; ++k) y[k] = 0;
}
#include "cycle.sweep"

// kernel cycle.restrict: Restriction: sums of b - A x over the cells of aggregates, which are pairs
// along x or single cells, in `deep` planes and `wide` rows
//   compute    S
//   stencil    F, S
//   writes     S coarse
//   other      S x, b
//   finer
//   module     multigrid
T r[2 * M];
with_pairs(pairs, [&](auto fx) {
    for (int begin = 0; begin < n; begin += M) {
        const int m = n - begin < M ? n - begin : (int)M;
        SIMD for (int k = 0; k < fx * m; ++k) r[k] = 0;
        each_row(deep, wide, [&](int z, int y) {
            const long long at = z * zp + y * yp + fx * begin;
            const auto here = x + at, right = b + at;
            SIMD for (int k = 0; k < fx * m; ++k) {
                const T e = diagonal(k, at),
                        v = right[k] - e * here[k] + around(here, k, zm, zp, at);
                r[k] += e != 0 ? v : (T)0;
            }
        });
        if (fx == 2) {
            SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = r[2 * k] + r[2 * k + 1];
        } else {
            SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = r[k];
        }
    }
});

// kernel cycle.correct: Prolongation: x += scale times the correction of its aggregate, clipped to
// the bounds if projected
//   compute    S
//   stencil    F, S
//   reads      S lower?, upper?
//   writes     S x
//   other      S coarse
//   numbers    S scale; bool projected
//   module     multigrid
if (projected) {
    // Correction of each cell, so that the next loop reads all fields with stride one.
    T e[2 * M];
    for (int begin = 0; begin < n; begin += 2 * M) {
        const int m = n - begin < 2 * M ? n - begin : (int)(2 * M);
        const auto* c = coarse + (pairs ? begin / 2 : begin);
        if (!pairs) {
            SIMD for (int k = 0; k < m; ++k) e[k] = scale * c[k];
        } else {
            SIMD for (int k = 0; k < m / 2; ++k) {
                const T v = scale * c[k];
                e[2 * k] = v;
                e[2 * k + 1] = v;
            }
            if (m % 2) e[m - 1] = scale * c[m / 2];
        }
        const auto moved = [&](int k) { return d[begin + k] != 0 ? x[begin + k] + e[k] : (T)0; };
        if (upper)
            SIMD for (int k = 0; k < m; ++k) x[begin + k] =
                clipped(moved(k), lower[begin + k], upper[begin + k]);
        else
            SIMD for (int k = 0; k < m; ++k) {
                const T v = moved(k), l = lower[begin + k];
                x[begin + k] = v < l ? l : v;
            }
    }
} else if (!pairs) {
    SIMD for (int k = 0; k < n; ++k) x[k] += d[k] != 0 ? scale * coarse[k] : (T)0;
} else {
    SIMD for (int k = 0; k < n / 2; ++k) {
        const T v = scale * coarse[k];
        x[2 * k] += d[2 * k] != 0 ? v : (T)0;
        x[2 * k + 1] += d[2 * k + 1] != 0 ? v : (T)0;
    }
    if (n % 2) x[n - 1] += d[n - 1] != 0 ? scale * coarse[n / 2] : (T)0;
}

// kernel cycle.two_sweeps: y = two sweeps from 0 with the weights `first` and `omega`, each clipped
// to the bounds if projected. A sweep from 0 needs no neighbors, so that it is computed again for
// each of them. For CUDA, where a launch costs more.
//   compute    S
//   stencil    F, S
//   reads      S b, lower?, upper?
//   writes     S y
//   numbers    S first, omega; bool projected
#include "sweep_again"
const auto sweeps = [&](auto clip) INLINED {
    // first sweep at a cell of a row `at` elements from this one
    sweep_again(
        [&](int k, int at) -> T {
            const T e = diagonal_of(k, at), v = quotient(first * (b + at)[k], e != 0 ? e : (T)1);
            return clip(k, at, e != 0 ? v : (T)0);
        },
        clip);
};
choose_clip(sweeps);

// kernel cycle.correct_and_sweep: y = a sweep of x + scale times the correction of its aggregate,
// both clipped to the bounds if projected. For CUDA: the correction is computed again for each
// neighbor
//   compute    S
//   stencil    F, S
//   reads      S x, b, lower?, upper?
//   writes     S y
//   other      S coarse
//   numbers    S scale, omega; bool projected
#include "sweep_again"
// Offset from this row's or plane's aggregates to those of one beside it; they are `stride`
// elements apart.
const auto aside = [](int at, int by, int factor, long long stride) -> int {
    return (int)stride * (factor < -1 ? ((at + by) >> 1) - (at >> 1) : by);
};
const int below_y = aside(P.j, -1, L.fy, L.o2), above_y = aside(P.j, 1, L.fy, L.o2);
const int below_z = aside(P.k, -1, L.fz, L.o1), above_z = aside(P.k, 1, L.fz, L.o1);
const auto aggregates = [&](int at) -> int {
    return at == 0 ? 0 : at == yp ? above_y : at == ym ? below_y : at == zp ? above_z : below_z;
};
#ifdef QUADS
constexpr int odd = 0;  // quads and spans begin with even cells
#else
const int odd = P.first & 1;
#endif
const auto by_pairs = [&](auto fx) INLINED {
    const auto sweeps = [&](auto clip) INLINED {
        sweep_again(
            [&](int k, int at) -> T {
                const T c = (coarse + aggregates(at))[fx == 2 ? (k + odd) >> 1 : k], v = scale * c,
                        e = diagonal_of(k, at);
                return clip(k, at, (x + at)[k] + (e != 0 ? v : (T)0));
            },
            clip);
    };
    choose_clip(sweeps);
};
#ifdef QUADS
if (pairs)
    by_pairs(Two());
else
    by_pairs(One());
#else
by_pairs(pairs ? 2 : 1);
#endif

// kernel cycle.bounds: Bounds of a coarse correction: the smallest gaps of its cells, divided by
// the over-correction; 0 is always allowed
//   compute    S
//   stencil    F, S
//   writes     S coarse_lower, coarse_upper?
//   other      S x, lower, upper?
//   finer
//   numbers    S scale
//   module     multigrid
T low[2 * M], high[2 * M];
const T big = (T)1e30, inverse = reciprocal(scale);
with_pairs(pairs, [&](auto fx) {
    for (int begin = 0; begin < n; begin += M) {
        const int m = n - begin < M ? n - begin : (int)M;
        SIMD for (int k = 0; k < fx * m; ++k) {
            low[k] = -big;
            high[k] = big;
        }
        for (int z = 0; z < deep; ++z)
            for (int y = 0; y < wide; ++y) {
                const long long at = z * zp + y * yp + fx * begin;
                const auto e = d + at;
                const auto to = x + at, l = lower + at, u = upper ? upper + at : l;
                SIMD for (int k = 0; k < fx * m; ++k) {
                    const T a0 = (l[k] - to[k]) * inverse, b0 = (u[k] - to[k]) * inverse,
                            a1 = a0 > 0 ? (T)0 : a0, b1 = b0 < 0 ? (T)0 : b0;
                    const T a = e[k] != 0 ? a1 : -big, b = e[k] != 0 ? b1 : big;
                    low[k] = a > low[k] ? a : low[k];
                    high[k] = b < high[k] ? b : high[k];
                }
            }
        const auto tightest = [&](auto& coarse, const T* v, auto better) {
            if (fx == 2) {
                SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = better(v[2 * k], v[2 * k + 1]);
            } else {
                SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = v[k];
            }
        };
        tightest(coarse_lower, low, [](T a, T b) { return a > b ? a : b; });
        if (coarse_upper) tightest(coarse_upper, high, [](T a, T b) { return a < b ? a : b; });
    }
});

// kernel cycle.clear: x = 0
//   compute    S
//   writes     S x
SIMD64 for (int k = 0; k < n; ++k) x[k] = 0;
