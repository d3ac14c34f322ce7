// Kernel of contacts between rigid bodies. one, other: the bodies of a contact; starts: the first
// contact of each island.

// snippet island: One island t of the kernel below: its x, `residual[t]` and `rounds[t]`.
for (;;) {
    const int low = dim * starts[t], high = dim * starts[t + 1];
    auto velocity = [&](int i) {
        const double *r = J + i * m, *u = w + q * one[i / dim], *v = w + q * other[i / dim];
        double s = b[i] + e[i] * x[i];
        for (int k = 0; k < q; ++k) s += r[k] * u[k] + r[q + k] * v[k];
        return s;
    };
    auto push = [&](int i, double change) {
        const double* r = J + i * m;
        double *u = w + q * one[i / dim], *v = w + q * other[i / dim];
        for (int k = 0; k < q; ++k) {
            u[k] += change * r[k];
            v[k] += change * r[q + k];
        }
    };
    auto clipped = [&](int i, double value) {
        const int t = i % dim;
        if (t == 0) return value > 0.0 ? value : 0.0;
        const double h = mu[i / dim] * x[i - t];
        return value > h ? h : (value < -h ? -h : value);
    };
    auto gather = [&]() {
        for (int i = low; i < high; ++i)
            for (int k = 0; k < q; ++k) {
                w[q * one[i / dim] + k] = 0.0;
                w[q * other[i / dim] + k] = 0.0;
            }
        for (int i = low; i < high; ++i) push(i, x[i]);
    };
    auto left = [&]() {
        double s = 0.0;
        for (int i = low; i < high; ++i) {
            const double r = d[i] * (x[i] - clipped(i, x[i] - velocity(i) / d[i]));
            s += r * r;
        }
        return sqrt(s);
    };
    double reference = 0.0, squares = 0.0;
    for (int i = low; i < high; ++i) {
        squares += b[i] * b[i];
        if (i % dim == 0 && b[i] < 0.0) reference += b[i] * b[i];
    }
    reference = sqrt(reference);
    if (reference <= 1e-15 * sqrt(squares)) {
        for (int i = low; i < high; ++i) x[i] = 0.0;
        residual[t] = 0.0;
        rounds[t] = 0.0;
        break;
    }
    for (int i = low; i < high; ++i) {
        x[i] = clipped(i, x[i]);
        way[i] = 0.0;
    }
    gather();
    double norm = left(), least = norm, before = 0.0;
    int done = 0;
    for (int i = low; i < high; ++i) best[i] = x[i];
    for (int round = 1; round <= most && least > rtol * reference; ++round) {
        done = round;
        double square = 0.0, change = 0.0;
        for (int i = low; i < high; ++i) {
            const double old = x[i], fresh = clipped(i, old - velocity(i) / d[i]);
            push(i, fresh - old);
            x[i] = fresh;
            g[i] = old - fresh;
            square += g[i] * g[i];
            change += d[i] * d[i] * g[i] * g[i];
        }
        const double fresh = square, old = before;
#include "snippets.h:fletcher_reeves"
        before = square;
        for (int i = low; i < high; ++i) {
            x[i] += beta * way[i];
            way[i] = beta * way[i] - keep * g[i];
        }
        for (int i = low; i < high; ++i) x[i] = clipped(i, x[i]);
        gather();
        if (round % EACH && change > 0.0 && round < most) continue;
        norm = left();
        if (norm < least) {
            least = norm;
            for (int i = low; i < high; ++i) best[i] = x[i];
        }
    }
    for (int i = low; i < high; ++i) x[i] = best[i];
    residual[t] = least / reference;
    rounds[t] = done;
    break;
}

// kernel warp_lcp.rigid.contacts.nncg: Solve the islands first <= t < last, whose contacts follow
// each other, by nonlinear conjugate gradients on projected sweeps. `reals` holds x, J, b, e, d,
// mu, then room for g, way, best and w. J has rows of 2 q entries, for the first and the second
// body of the row's contact; w = J' x has q entries per body. `indices` holds the bodies of each
// contact, and the first contact of each island. Of each island, `residual` is relative to the
// residual of x = 0, and `rounds` is the number of iterations. The residual is tested every EACH
// iterations, since it costs as much as a sweep.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 residual, rounds
//   numbers    int q, dim, contacts; float64 rtol; int most
//   constants  EACH = 8
EXACT_MATH
const int m = 2 * q, size = dim * contacts;
double *x = reals, *J = x + size, *b = J + size * m, *e = b + size, *d = e + size, *mu = d + size;
double *g = mu + contacts, *way = g + size, *best = way + size, *w = best + size;
const int *one = indices, *other = one + contacts, *starts = other + contacts;
for (int t = first; t < last; ++t) {
#include "island"
}
