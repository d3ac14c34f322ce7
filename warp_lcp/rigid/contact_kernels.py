# mypy: ignore-errors
"""Kernel of contacts: nonlinear conjugate gradients on projected sweeps, a whole solve of an island of bodies by one thread.

`warp_lcp.solvers.nncg` on B = J J' + diag(e), whose rows live at bodies: a sweep costs the entries of J, not those of B, and a solve one
launch. Contacts of a pile are so few that launches would take all of the time: 0.2 ms an iteration where the arithmetic takes 0.002 ms.
"""

import warp as wp

f64, i32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)

# J: rows, 2 q entries each, for the first and the second body of the row's contact; w = J' x, q entries a body.
NNCG = """
    const int q = q_, dim = dim_, m = 2*q, low = dim*begin, high = dim*end;
    const double *J = J_.data, *b = b_.data, *e = e_.data, *d = d_.data, *mu = mu_.data;
    const int *first = first_.data, *second = second_.data;
    double *x = x_.data, *g = g_.data, *p = p_.data, *best = best_.data, *w = w_.data;
    auto velocity = [&](int i) {
        const double *r = J + i*m, *u = w + q*first[i/dim], *v = w + q*second[i/dim];
        double s = b[i] + e[i]*x[i];
        for (int k = 0; k < q; ++k) s += r[k]*u[k] + r[q + k]*v[k];
        return s;
    };
    auto push = [&](int i, double change) {
        const double *r = J + i*m;
        double *u = w + q*first[i/dim], *v = w + q*second[i/dim];
        for (int k = 0; k < q; ++k) { u[k] += change*r[k]; v[k] += change*r[q + k]; }
    };
    auto clipped = [&](int i, double value) {
        const int t = i % dim;
        if (t == 0) return value > 0.0 ? value : 0.0;
        const double h = mu[i/dim]*x[i - t];
        return value > h ? h : (value < -h ? -h : value);
    };
    auto gather = [&]() {
        for (int i = low; i < high; ++i)
            for (int k = 0; k < q; ++k) { w[q*first[i/dim] + k] = 0.0; w[q*second[i/dim] + k] = 0.0; }
        for (int i = low; i < high; ++i) push(i, x[i]);
    };
    auto residual = [&]() {
        double s = 0.0;
        for (int i = low; i < high; ++i) { const double r = d[i]*(x[i] - clipped(i, x[i] - velocity(i)/d[i])); s += r*r; }
        return sqrt(s);
    };
    double reference = 0.0, size = 0.0;
    for (int i = low; i < high; ++i) {
        size += b[i]*b[i];
        if (i % dim == 0 && b[i] < 0.0) reference += b[i]*b[i];
    }
    reference = sqrt(reference);
    if (reference <= 1e-15*sqrt(size)) {
        for (int i = low; i < high; ++i) x[i] = 0.0;
        return 0.0;
    }
    for (int i = low; i < high; ++i) { x[i] = clipped(i, x[i]); p[i] = 0.0; }
    gather();
    double norm = residual(), least = norm, before = 0.0;
    for (int i = low; i < high; ++i) best[i] = x[i];
    for (int round = 1; round <= most && least > rtol*reference; ++round) {
        double square = 0.0, change = 0.0;
        for (int i = low; i < high; ++i) {
            const double old = x[i], fresh = clipped(i, old - velocity(i)/d[i]);
            push(i, fresh - old);
            x[i] = fresh;
            g[i] = old - fresh;
            square += g[i]*g[i];
            change += d[i]*d[i]*g[i]*g[i];
        }
        double beta = before > 0.0 ? square/before : 0.0, keep = 1.0;
        if (beta > 1.0) { beta = 0.0; keep = 0.0; }
        before = square;
        for (int i = low; i < high; ++i) {
            x[i] += beta*p[i];
            p[i] = beta*p[i] - keep*g[i];
        }
        for (int i = low; i < high; ++i) x[i] = clipped(i, x[i]);
        gather();
        if (round % EACH && change > 0.0 && round < most) continue;
        norm = residual();
        if (norm < least) {
            least = norm;
            for (int i = low; i < high; ++i) best[i] = x[i];
        }
    }
    for (int i = low; i < high; ++i) x[i] = best[i];
    return least/reference;
""".replace("EACH", "8")  # iterations between looks at the residual, which costs as much as a sweep


@wp.func_native(NNCG)
def nncg_island(
    J_: f64, b_: f64, e_: f64, d_: f64, mu_: f64, first_: i32, second_: i32, q_: int, dim_: int, begin: int, end: int, rtol: wp.float64,
    most: int, w_: f64, g_: f64, p_: f64, best_: f64, x_: f64,
) -> wp.float64: ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.rigid.contacts")
def solve_islands(
    J: f64, b: f64, e: f64, d: f64, mu: f64, first: i32, second: i32, q: int, dim: int, starts: i32, rtol: wp.float64, most: int,
    w: f64, g: f64, p: f64, best: f64, x: f64, residual: f64,
):  # fmt: skip
    """Solve each island, whose contacts follow each other; residual: what is left of it, relative to that of x = 0."""
    t = wp.tid()
    residual[t] = nncg_island(
        J, b, e, d, mu, first, second, q, dim, starts[t], starts[t + 1], rtol, most, w, g, p, best, x
    )  # fmt: skip
