// Kernels of impulses at contacts between rigid bodies. `contacts.nncg` solves for them; one,
// other: the bodies of a contact; starts: the first contact of each island. `planar_impulses.push`:
// contacts in a plane, see `rigid/planar_contacts.py`: the loops of `ContactSolve.push_apart`,
// `ContactMemory` and `SupportedContacts`, equal to the last bit.

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

// kernel warp_lcp.rigid.planar_impulses.push: Impulses of contacts, as in
// `ContactSolve.push_apart`. `reals` holds the values, masses, inverse inertias and their roots of
// `count` bodies. It then holds the points, frames, sizes, rows for both bodies, velocities of
// walls, targets, frictions and gaps of `contacts` contacts, and `old` remembered ones, or initial
// impulses if `resumed`. The results follow: the impulses; the data of contacts to remember; of
// each body G'J'JG of the rows that hold it, the diagonal of G, displacements that reduce overlaps,
// and whether rows hold it. Then comes work. `indices` holds the contacts' bodies; then comes work.
// The values include the impulses if `worst` is at most `unsolved`. `iterations`: largest number
// over the islands. `deep`: number of contacts that will overlap in `dt`. `stacked`: number of
// contacts between a body that is held and another one.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 worst, iterations, deep, stacked
//   numbers    int count, contacts, old; bool resumed; float64 rtol; int most;
//              float64 unsolved, dt, YIELDS, SAME_PLACE, SLOP, BEARS, RATE, ROUGH_RTOL;
//              int ROUGH_MOST
//   constants  EACH = 8
EXACT_MATH
#include "snippets.h:algebra"
#include "motion.h:spins"
const int n = count, q = 3, dim = 2, m = 6, size = dim * contacts;
double* values = reals;
const double *mass = values + 26 * n, *inverse = mass + n, *inertias = inverse + 9 * n,
             *points = inertias + 9 * n, *frames = points + 3 * contacts;
const double *sizes = frames + 6 * contacts, *ones = sizes + contacts,
             *others = ones + 6 * contacts, *walls = others + 6 * contacts;
const double *targets = walls + 2 * contacts, *frictions = targets + contacts,
             *gaps = frictions + contacts, *before = gaps + contacts;
double *impulses = reals + 45 * n + 27 * contacts + (resumed ? size : 8 * old),
       *memory = impulses + size, *squares = memory + 8 * contacts;
double *roots = squares + 9 * n, *ways = roots + 3 * (n + 1), *holding = ways + 3 * n,
       *largest = holding + n, *V = largest + n + 1, *start = V + 3 * (n + 1), *x = start + size,
       *J = x + size, *b = J + size * m, *e = b + size, *d = e + size, *mu = d + size;
double *g = mu + contacts, *way = g + size, *best = way + size, *w = best + size,
       *places = w + q * (n + 1), *pushes = places + 3 * contacts;
double *far = pushes + 3 * (n + 1), *residual = far + contacts, *rounds = residual + contacts;
const int *first_of = indices, *second_of = first_of + contacts;
int *order = indices + 2 * contacts, *starts = order + contacts, *one = starts + contacts + 1,
    *other = one + contacts;
int *least = other + contacts, *nearest = least + n + 1;
const auto both = [&](const double* x, const double* rows) {
    return fused(x[0], rows[0], x[1] * rows[3]) + 0.0;
};
for (int i = 0; i <= n; ++i)
    for (int a = 0; a < 3; ++a) V[3 * i + a] = roots[3 * i + a] = pushes[3 * i + a] = 0.0;
const auto find_velocity = [&](int i) {
    double spin[3];
    spin_of(values + 26 * i + 3, inverse + 9 * i, values + 26 * i + 15, spin);
    V[3 * i] = values[26 * i + 12] / mass[i];
    V[3 * i + 1] = values[26 * i + 13] / mass[i];
    V[3 * i + 2] = spin[2];
};
const auto velocity_of = [&](int k, int r) {
    const double *u = ones + 6 * k + 3 * r, *v = others + 6 * k + 3 * r;
    return (along(u, 1, V + 3 * first_of[k], 1) + along(v, 1, V + 3 * second_of[k], 1)) +
           walls[dim * k + r];
};
for (int i = 0; i < n; ++i) {
    find_velocity(i);
    roots[3 * i] = roots[3 * i + 1] = 1.0 / sqrt(mass[i]);
    roots[3 * i + 2] = along(values + 26 * i + 9, 1, inertias + 9 * i + 2, 3);
    least[i] = i;
}
// Initial impulses: those of the nearest contact of the same pair, each used once.
for (int k = 0; k < contacts; ++k) {
    const int i = first_of[k];
    double arm[3];
    for (int a = 0; a < 3; ++a) arm[a] = points[3 * k + a] - values[26 * i + a];
    for (int a = 0; a < 3; ++a) places[3 * k + a] = along(arm, 1, values + 26 * i + 3 + a, 3);
    for (int r = 0; r < dim; ++r) start[dim * k + r] = resumed ? before[dim * k + r] : 0.0;
}
const auto distance_to = [&](int k, int o) {
    double c[3];
    for (int a = 0; a < 3; ++a) c[a] = places[3 * k + a] - before[8 * o + 2 + a];
    return length(c);
};
const auto same_pair = [&](int k, int o) {
    return before[8 * o] == first_of[k] && before[8 * o + 1] == second_of[k];
};
for (int k = 0; k < contacts && !resumed; ++k) {
    nearest[k] = -1;
    for (int o = 0; o < old; ++o)
        if (same_pair(k, o)) {
            const double c = distance_to(k, o);
            if (nearest[k] < 0 || c < far[k]) {
                nearest[k] = o;
                far[k] = c;
            }
        }
}
for (int k = 0; k < contacts && !resumed; ++k) {
    const int o = nearest[k];
    if (o < 0 || !(far[k] < SAME_PLACE * sizes[k])) continue;
    bool mine = true;
    for (int c = 0; c < contacts; ++c)
        if (c != k && same_pair(c, o)) {
            const double its = distance_to(c, o);
            mine &= !(its < far[k] || (its == far[k] && c < k));
        }
    for (int r = 0; r < dim && mine; ++r)
        start[dim * k + r] = across(frames + 6 * k + 3 * r, before + 8 * o + 5);
}
// Contacts sorted by islands. An island has the number of its first body.
const auto root = [&](int i) {
    while (least[i] != i) i = least[i];
    return i;
};
for (int k = 0; k < contacts; ++k)
    if (second_of[k] < n) {
        const int p = root(first_of[k]), s = root(second_of[k]);
        if (p < s)
            least[s] = p;
        else
            least[p] = s;
    }
int islands = 0, placed = 0;
for (int i = 0; i < n; ++i) {
    const int begin = placed;
    for (int k = 0; k < contacts; ++k)
        if (root(first_of[k]) == i) order[placed++] = k;
    if (placed > begin) starts[islands++] = begin;
}
starts[islands] = placed;
for (int p = 0; p < contacts; ++p) {
    const int k = order[p];
    one[p] = first_of[k];
    other[p] = second_of[k];
    mu[p] = frictions[k];
    for (int r = 0; r < dim; ++r) {
        const double *u = ones + 6 * k + 3 * r, *v = others + 6 * k + 3 * r;
        double* row = J + m * (dim * p + r);
        for (int a = 0; a < 3; ++a) {
            row[a] = u[a] * roots[3 * one[p] + a] + 0.0;
            row[3 + a] = v[a] * roots[3 * other[p] + a] + 0.0;
        }
        const int i = dim * p + r;
        x[i] = start[dim * k + r];
        b[i] = velocity_of(k, r);
        if (r == 0) b[i] -= targets[k];
        const double own = ((row[0] * row[0] + row[1] * row[1]) + row[2] * row[2]) +
                           ((row[3] * row[3] + row[4] * row[4]) + row[5] * row[5]);
        e[i] = r == 0 ? 0.0 : YIELDS * own;
        d[i] = own + e[i];
    }
}
for (int i = 0; i < q * (n + 1); ++i) w[i] = 0.0;
for (int t = 0; t < islands; ++t) {
#include "island"
}
for (int t = 0; t < islands; ++t) {
    worst[0] = residual[t] > worst[0] ? residual[t] : worst[0];
    iterations[0] = rounds[t] > iterations[0] ? rounds[t] : iterations[0];
}
for (int p = 0; p < contacts; ++p)
    for (int r = 0; r < dim; ++r) impulses[dim * order[p] + r] = x[dim * p + r];
for (int k = 0; k < contacts; ++k)
    for (int a = 0; a < 3; ++a)
        pushes[3 * first_of[k] + a] += both(impulses + dim * k, ones + 6 * k + a);
for (int k = 0; k < contacts; ++k)
    for (int a = 0; a < 3; ++a)
        pushes[3 * second_of[k] + a] += both(impulses + dim * k, others + 6 * k + a);
if (worst[0] <= unsolved)
    for (int i = 0; i < n; ++i) {
        double* momentum = values + 26 * i + 12;
        momentum[0] += pushes[3 * i];
        momentum[1] += pushes[3 * i + 1];
        momentum[2] += 0.0;
        momentum[3] += 0.0;
        momentum[4] += 0.0;
        momentum[5] += pushes[3 * i + 2];
        find_velocity(i);
    }
// data for the end of the step: overlaps, and contacts to remember
for (int k = 0; k < contacts; ++k) {
    double* kept = memory + 8 * k;
    kept[0] = first_of[k];
    kept[1] = second_of[k];
    for (int a = 0; a < 3; ++a) {
        kept[2 + a] = places[3 * k + a];
        kept[5 + a] = fused(impulses[dim * k + 1], frames[6 * k + 3 + a],
                            impulses[dim * k] * frames[6 * k + a]) +
                      0.0;
    }
    deep[0] += gaps[k] + dt * velocity_of(k, 0) < -SLOP * sizes[k];
}
// Smallest displacements that reduce these overlaps, see `ContactSolve.separation`: no friction.
for (int i = 0; i < 3 * n; ++i) ways[i] = 0.0;
if (deep[0] > 0.0) {
    const int dim = 1, most = ROUGH_MOST;
    const double rtol = ROUGH_RTOL;
    for (int p = 0; p < contacts; ++p) {
        const int k = order[p];
        const double gap = gaps[k] + dt * velocity_of(k, 0);
        for (int a = 0; a < m; ++a) J[m * p + a] = J[m * 2 * p + a];  // rows of the normals
        const double* row = J + m * p;
        b[p] = gap < -SLOP * sizes[k] ? RATE * gap : (gap > 0.0 ? gap : 0.0);
        x[p] = e[p] = mu[p] = 0.0;
        d[p] = ((row[0] * row[0] + row[1] * row[1]) + row[2] * row[2]) +
               ((row[3] * row[3] + row[4] * row[4]) + row[5] * row[5]);
    }
    for (int t = 0; t < islands; ++t) {
#include "island"
    }
    for (int i = 0; i < 3 * (n + 1); ++i) pushes[i] = 0.0;
    for (int p = 0; p < contacts; ++p) far[order[p]] = x[p];
    for (int k = 0; k < contacts; ++k)
        for (int a = 0; a < 3; ++a) pushes[3 * first_of[k] + a] += far[k] * ones[6 * k + a] + 0.0;
    for (int k = 0; k < contacts; ++k)
        for (int a = 0; a < 3; ++a)
            pushes[3 * second_of[k] + a] += far[k] * others[6 * k + a] + 0.0;
    for (int i = 0; i < 3 * n; ++i) ways[i] = roots[i] * (roots[i] * pushes[i] + 0.0) + 0.0;
}
// Bodies held by walls and other solids, see `SupportedContacts`: G' J' J G of their rows.
for (int i = 0; i <= n; ++i) largest[i] = 0.0;
for (int i = 0; i < n; ++i) {
    holding[i] = 0.0;
    for (int a = 0; a < 9; ++a) squares[9 * i + a] = 0.0;
}
for (int k = 0; k < contacts; ++k) {
    const double normal = impulses[dim * k];
    double &mine = largest[first_of[k]], &its = largest[second_of[k]];
    mine = normal > mine ? normal : mine;
    its = normal > its ? normal : its;
}
largest[n] = INFINITY;
for (int k = 0; k < contacts; ++k)
    if (second_of[k] == n) {
        const int i = first_of[k];
        const double normal = impulses[dim * k], *g = roots + 3 * i;
        if (!(normal > BEARS * (largest[i] < largest[n] ? largest[i] : largest[n]))) continue;
        const bool sticks = fabs(impulses[dim * k + 1]) < frictions[k] * normal * (1.0 - BEARS);
        holding[i] = 1.0;
        for (int r = 0; r < 1 + sticks; ++r) {
            double row[3];
            for (int a = 0; a < 3; ++a) row[a] = ones[6 * k + 3 * r + a] * g[a];
            for (int a = 0; a < 9; ++a)
                squares[9 * i + a] = fused(row[a / 3], row[a % 3], squares[9 * i + a]);
        }
    }
for (int k = 0; k < contacts; ++k)
    stacked[0] += second_of[k] < n && (holding[first_of[k]] > 0.0 || holding[second_of[k]] > 0.0);
