// Kernels of Gauss-Seidel sweeps, also over lines of a grid.

// kernel sweep.change: Largest |x - old|; then old = x. clang does not vectorize a maximum of
// float64, since a value may be NaN. out_of[0] is 0 before
//   compute    float64
//   reads      float64 x
//   writes     float64 old
//   whole      float64 out_of
double s = 0;
for (int i = 0; i < n; ++i) {
    const double e = x[i] - old[i], v = e < 0 ? -e : e;
    s = v > s ? v : s;
    old[i] = x[i];
}
make_at_least(out_of, s);

// kernel grid_lines.solve: Solve the line of n cells along an axis that begins at this cell, if it
// has the color; lines of one color do not touch. The active set is changed until it is consistent.
// s: 1 free, 0 at l, 2 at u, 3 no unknown. Rows: -before z[k-st] + e z[k] - after z[k+st] + c = 0
// where free, z = bound elsewhere. The launch is over the first cells of the lines.
//   compute    float64
//   stencil    D, W
//   reads      float64 b, l, u
//   writes     float64 x, c, q, z; uint8 s
//   numbers    int64 s1, s2; int cells, most, color; float64 omega
//   constants  AXIS = 0
//   by_cell
#ifdef EACH_WEIGHT
#define STEP(X, Y, Z) ((X) + (Y) * s2 + (Z) * s1)
#define BEFORE(W, X, Y, Z) visit(STEP(X, Y, Z), W(k));
#define AND_AFTER(W, X, Y, Z) BEFORE(W, X, Y, Z) visit(-STEP(X, Y, Z), W(k - STEP(X, Y, Z)));
const auto visit_all = [&](long long k, auto visit) {
    if constexpr (SYMMETRIC) {
        EACH_WEIGHT(AND_AFTER)
    } else {
        EACH_WEIGHT(BEFORE)
    }
};
const auto coupling = [&](long long k, long long step) {
    T v = 0;
    visit_all(k, [&](long long s, T w) { v += s == step ? w : (T)0; });
    return v;
};
#define BEFORE_IT(K) coupling(K, -st)
#define AFTER_IT(K) coupling(K, st)
#else
#define BEFORE_IT(K) WEIGHT(K)
#define AFTER_IT(K) WEIGHT(K + st)
#endif
#define FACES(W, S) W[k] * x[k - S] + W[k + S] * x[k + S]
#define EQUAL(C, S) C*(x[k - S] + x[k + S])
#define WEIGHT(K)                              \
    (STENCIL == 'v' ? (T)(AXIS == 0   ? wx[K]  \
                          : AXIS == 1 ? wy[K]  \
                                      : wz[K]) \
     : AXIS == 0    ? cx                       \
     : AXIS == 1    ? cy                       \
                    : cz)
const long long st = AXIS == 0 ? 1 : AXIS == 1 ? s2 : s1, end = cells * st;
const T eps = 1e-14;
const bool four = STENCIL == 'c' && L.planes > 1;  // lines that touch diagonally
if ((four ? P.j % 2 + 2 * (P.k % 2) : (P.k + P.j) % 2) == color) {
    for (long long k = 0; k < end; k += st) {
#ifdef EACH_WEIGHT
        c[k] = b[k];
        visit_all(k, [&](long long s, T w) {
            if (s != st && s != -st) c[k] -= w * x[k + s];
        });
#else
        if constexpr (STENCIL == 'v')
            c[k] = b[k] - (AXIS == 0   ? FACES(wy, s2) + FACES(wz, s1)
                           : AXIS == 1 ? FACES(wx, 1) + FACES(wz, s1)
                                       : FACES(wx, 1) + FACES(wy, s2));
        else
            c[k] = b[k] - (AXIS == 0   ? EQUAL(cy, s2) + EQUAL(cz, s1)
                           : AXIS == 1 ? EQUAL(cx, 1) + EQUAL(cz, s1)
                                       : EQUAL(cx, 1) + EQUAL(cy, s2));
#endif
        s[k] = d[k] == 0 ? 3 : (x[k] <= l[k] ? 0 : (x[k] >= u[k] ? 2 : 1));
    }
    for (int pass = 0; pass < most; ++pass) {
        T q0 = 0, z0 = 0;
        int wrong = 0;
        for (long long k = 0; k < end; k += st) {
            const T before = BEFORE_IT(k), after = AFTER_IT(k), e = unit * (T)d[k],
                    pivot = e - before * q0;
            if (s[k] == 1 && pivot > 0) {
                q0 = after / pivot;
                z0 = (before * z0 - c[k]) / pivot;
            } else {
                q0 = 0;
                z0 = s[k] == 0 ? l[k] : (s[k] == 2 ? u[k] : (s[k] == 3 ? (T)0 : x[k]));
            }
            q[k] = q0;
            z[k] = z0;
        }
        for (long long k = end - 2 * st; k >= 0; k -= st) z[k] += q[k] * z[k + st];
        for (long long k = 0; k < end; k += st) {
            if (s[k] == 3) continue;
            const T before = BEFORE_IT(k), after = AFTER_IT(k), e = unit * (T)d[k];
            const T low = k > 0 ? before * z[k - st] : (T)0,
                    high = k + st < end ? after * z[k + st] : (T)0,
                    y = e * z[k] - low - high + c[k];
            const T scale = eps * (fabs(e * z[k]) + fabs(low) + fabs(high) + fabs(c[k]));
            if (s[k] == 1) {
                if (e * (z[k] - l[k]) < -scale) {
                    s[k] = 0;
                    ++wrong;
                } else if (e * (z[k] - u[k]) > scale) {
                    s[k] = 2;
                    ++wrong;
                }
            } else if (l[k] < u[k]) {
                if (s[k] == 0 ? y < -scale : y > scale) {
                    s[k] = 1;
                    ++wrong;
                }
            }
        }
        if (!wrong) break;
    }
    for (long long k = 0; k < end; k += st) {
        if (s[k] == 3) continue;
        T v = x[k] + omega * (z[k] - x[k]);
        v = v > l[k] ? v : l[k];
        x[k] = v < u[k] ? v : u[k];
    }
}
#undef FACES
#undef EQUAL
#undef WEIGHT
#undef BEFORE_IT
#undef AFTER_IT
#undef STEP
#undef BEFORE
#undef AND_AFTER
