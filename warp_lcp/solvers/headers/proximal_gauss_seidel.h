// Kernels of proximal Gauss-Seidel sweeps over frictional contacts.

// kernel warp_lcp.proximal_gauss_seidel.sweep: Sweep over the contacts first <= s < last of one
// color, which share no moving body. With w = J'r: r_n <- max(0, r_n - rho_n u_n), then r_t <-
// projection of r_t - rho_t u_t onto |r_t| <= mu r_n; g = r before - r.
//   compute    float64
//   whole      float64 J, b, e, laws, w, r, g, state
//   box        int32 contact, one, other
//   numbers    int bodies
//   constants  DIM, Q, FACTOR
const double factor = state[FACTOR];
for (int s = first; s < last; ++s) {
    const double *j = J + (long long)s * DIM * 2 * Q, *law = laws + 4 * s;
    double *x = r + DIM * contact[s], *taken = g + DIM * contact[s], *mine = w + Q * one[s],
           *theirs = w + Q * other[s];
    double v[2 * Q], u[DIM], change[DIM];
    for (int c = 0; c < Q; ++c) {
        v[c] = mine[c];
        v[Q + c] = theirs[c];
    }
    const auto velocity = [&](int i) {
        double sum = b[DIM * s + i] + e[DIM * s + i] * x[i];
        for (int c = 0; c < 2 * Q; ++c) sum += j[2 * Q * i + c] * v[c];
        return sum;
    };
    const auto push = [&](int i) {
        for (int c = 0; c < 2 * Q; ++c) v[c] += change[i] * j[2 * Q * i + c];
    };
    const double wanted = x[0] - factor * law[1] * velocity(0),
                 normal = wanted > 0.0 ? wanted : 0.0, radius = law[0] * normal;
    change[0] = normal - x[0];
    push(0);
    double square = 0.0;
    for (int i = 1; i < DIM; ++i) {
        u[i] = x[i] - factor * law[2] * velocity(i);
        square += u[i] * u[i];
    }
    const double length = sqrt(square), share = length > radius ? radius / length : 1.0;
    for (int i = 1; i < DIM; ++i) {
        change[i] = share * u[i] - x[i];
        push(i);
    }
    for (int i = 0; i < DIM; ++i) {
        x[i] += change[i];
        taken[i] = -change[i];
    }
    x[0] = normal;
    for (int c = 0; c < Q; ++c) mine[c] = v[c];
    if (other[s] < bodies)
        for (int c = 0; c < Q; ++c) theirs[c] = v[Q + c];
}

// kernel warp_lcp.proximal_gauss_seidel.residual: Squared residual |d (r - P(r - u^/d))|^2 with u^
// = (u_n + mu |u_t|, u_t), P the projection onto |r_t| <= mu r_n, d the mean of the contact's
// diagonal
//   compute    float64
//   whole      float64 J, b, e, laws, w, r
//   box        int32 contact, one, other
//   sums       square
//   constants  DIM, Q
for (int s = first; s < last; ++s) {
    const double *j = J + (long long)s * DIM * 2 * Q, *law = laws + 4 * s,
                 *x = r + DIM * contact[s], mu = law[0], d = law[3];
    const double *mine = w + Q * one[s], *theirs = w + Q * other[s];
    double z[DIM], slip = 0.0, length = 0.0;
    for (int i = 0; i < DIM; ++i) {
        double u = b[DIM * s + i] + e[DIM * s + i] * x[i];
        for (int c = 0; c < Q; ++c)
            u += j[2 * Q * i + c] * mine[c] + j[2 * Q * i + Q + c] * theirs[c];
        z[i] = u;
        if (i > 0) slip += u * u;
    }
    z[0] += mu * sqrt(slip);
    for (int i = 0; i < DIM; ++i) z[i] = x[i] - z[i] / d;
    for (int i = 1; i < DIM; ++i) length += z[i] * z[i];
    length = sqrt(length);
    const bool inside = length <= mu * z[0], polar = mu * length <= -z[0];
    const double side = (z[0] + mu * length) / (1.0 + mu * mu);
    for (int i = 0; i < DIM; ++i) {
        const double onto = i ? mu * side * z[i] / (length > 0.0 ? length : 1.0) : side,
                     off = d * (x[i] - (inside  ? z[i]
                                        : polar ? 0.0
                                                : onto));
        square += off * off;
    }
}

// kernel warp_lcp.proximal_gauss_seidel.gather: w = J'r of the bodies first <= t < last, contact
// by contact in their order
//   compute    float64
//   whole      int32 sides, contact; float64 J, r, w
//   box        int32 starts
//   constants  DIM, Q
for (int t = first; t < last; ++t) {
    double sum[Q] = {};
    for (int at = starts[t]; at < starts[t + 1]; ++at) {
        const int s = sides[at] / 2, side = sides[at] % 2;
        const double *j = J + (long long)s * DIM * 2 * Q + side * Q, *x = r + DIM * contact[s];
        for (int i = 0; i < DIM; ++i)
            for (int c = 0; c < Q; ++c) sum[c] += x[i] * j[2 * Q * i + c];
    }
    for (int c = 0; c < Q; ++c) w[Q * t + c] = sum[c];
}

// kernel proximal_gauss_seidel.carry: r <- r + beta p, p <- beta p - g with beta = |g|^2 / |g
// before|^2; p <- 0 if beta > 1
//   compute    float64
//   reads      float64 g
//   writes     float64 r, way
//   whole      float64 state
//   numbers    int now
//   by_cell
const double fresh = state[now], old = state[1 - now];
#include "snippets.h:fletcher_reeves"
SIMD8 for (int k = 0; k < n; ++k) {
    const double along = way[k], back = g[k];
    r[k] += beta * along;
    way[k] = beta * along - keep * back;
}

// kernel proximal_gauss_seidel.follow: As proximal_gauss_seidel.carry, for w = J'r; its change by
// the last sweep is w - before
//   compute    float64
//   writes     float64 w, before, way
//   whole      float64 state
//   numbers    int now
//   by_cell
const double fresh = state[now], old = state[1 - now];
#include "snippets.h:fletcher_reeves"
SIMD8 for (int k = 0; k < n; ++k) {
    const double along = way[k], at = w[k], moved = at + beta * along;
    way[k] = beta * along + keep * (at - before[k]);
    w[k] = moved;
    before[k] = moved;
}
