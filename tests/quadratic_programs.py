"""Random convex quadratic programs with known answers, badly scaled.

Each is constructed from a point x and multipliers; q follows by the first-order conditions. Some
are then made infeasible by a contradiction, or unbounded by an unlimited direction of descent.
Costs, rows and unknowns are scaled afterwards, so that the program in plain units is known as well:
it tests solvers that fail on the scaled one.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse

INFINITIES = (1e20, 1e30, np.inf)
VERDICTS = ("solvable",) * 7 + ("infeasible",) * 2 + ("unbounded",)
# Relative singular value of the active rows and P from which a minimizer counts as unique.
DISTINCT = 1e-3


@dataclass(frozen=True)
class RandomProgram:
    """Program, its verdict and, if it is solvable, a minimizer.

    Attributes:
        plain: keyword arguments of qpsolvers.Problem, in plain units, infinity as inf.
        scaled: the same in other units, infinity as 1e20, 1e30 or inf.
        verdict: "solvable", "infeasible" or "unbounded".
        x: a minimizer in plain units, which are those of `scaled` times `units`.
        unique: whether x is the only minimizer.
        cost: factor of P and q.
        units: unit of x in `scaled`, in plain units, shape (n,).
    """

    plain: dict
    scaled: dict
    verdict: str
    x: np.ndarray
    unique: bool
    cost: float
    units: np.ndarray


def draw(seed, *, widest=8.0, columns=0.0, most=14):
    """Return a program.

    Args:
        seed: seed of the draw.
        widest: largest exponent of the powers of 10 that scale costs and rows.
        columns: whether unknowns are scaled, too.
        most: largest number of unknowns.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, most + 1))
    kind, verdict = (
        rng.choice(["definite", "semidefinite", "linear"], p=[0.4, 0.35, 0.25]),
        str(rng.choice(VERDICTS)),
    )
    rank = {"definite": n, "semidefinite": int(rng.integers(0, n)), "linear": 0}[kind]
    if verdict == "unbounded":
        rank = min(rank, n - 1)
    density = rng.choice([1.0, 0.4])
    root = rng.standard_normal((n, rank)) * (rng.random((n, rank)) < density)
    P = root @ root.T + (0.1 * np.eye(n) if rank == n else 0.0)
    x = rng.standard_normal(n) * (rng.random(n) < 0.8)
    m, k = (
        int(rng.integers(0, 2 * n + 1)) * (rng.random() < 0.8),
        int(rng.integers(0, n // 2 + 1)) * (rng.random() < 0.6),
    )
    G, A = (rng.standard_normal((rows, n)) * (rng.random((rows, n)) < density) for rows in (m, k))
    if m > 1 and rng.random() < 0.3:  # a duplicate, and a sum of two
        G[-1] = G[0] if rng.random() < 0.5 else G[0] + G[m // 2]
    if k > 1 and rng.random() < 0.4:
        A[-1] = A[0] if rng.random() < 0.5 else A[0] - A[k // 2]
    # Active rows: their slack is 0, and most of their multipliers are not.
    tight, sides = (
        rng.random(m) < 0.3,
        rng.choice([-1, 0, 1], n, p=[0.2, 0.6, 0.2]) * (rng.random() < 0.7),
    )
    z = np.where(tight, rng.uniform(0.3, 2.0, m) * (rng.random(m) < 0.9), 0.0)
    z_box = sides * rng.uniform(0.3, 2.0, n) * (rng.random(n) < 0.9)
    h = G @ x + np.where(tight, 0.0, rng.uniform(0.1, 2.0, m))
    lower, upper = x - rng.uniform(0.1, 2.0, n), x + rng.uniform(0.1, 2.0, n)
    lower, upper = np.where(sides < 0, x, lower), np.where(sides > 0, x, upper)
    lower[(rng.random(n) < 0.4) & (sides >= 0)], upper[(rng.random(n) < 0.4) & (sides <= 0)] = (
        -np.inf,
        np.inf,
    )
    h[(rng.random(m) < 0.15) & ~tight] = np.inf
    b, y = A @ x, rng.standard_normal(k)
    q = -(P @ x + G.T @ z + A.T @ y + z_box)
    if verdict == "infeasible":
        G, h, A, b, lower, upper = _contradicted(rng, x, G, h, A, b, lower, upper)
    if verdict == "unbounded":
        P, q, G, A, lower, upper = _opened(rng, P, q, G, A, lower, upper)
        h, b = np.where(np.isinf(h), h, G @ x + (h > G @ x)), A @ x
    active = (
        np.vstack([P, A, G[: len(z)][z > 0], np.eye(n)[z_box != 0]])
        if verdict == "solvable"
        else np.zeros((1, n))
    )
    values = np.linalg.svd(active, compute_uv=False)
    unique = bool(len(active) >= n and values[n - 1] > DISTINCT * max(values[0], 1.0))
    plain = {"P": P, "q": q, "G": G, "h": h, "A": A, "b": b, "lb": lower, "ub": upper}
    units = 10.0 ** rng.uniform(-columns, columns, n)
    cost = 10.0 ** rng.uniform(-widest, widest)
    return RandomProgram(
        plain,
        _scaled(rng, plain, cost, units, widest, density < 1),
        verdict,
        x,
        unique,
        cost,
        units,
    )


def _contradicted(rng, x, G, h, A, b, lower, upper):
    """Add contradictory rows: a pair, a row and the box, or two equations."""
    n, row = len(x), rng.standard_normal(len(x))
    way = rng.choice(["pair", "box", "equations", "sum"])
    gap = rng.uniform(0.2, 3.0)
    if way == "pair":
        return np.vstack([G, row, -row]), np.r_[h, row @ x, -row @ x - gap], A, b, lower, upper
    if way == "box":
        j = int(rng.integers(n))
        lower = np.where(np.arange(n) == j, np.where(np.isfinite(lower), lower, x - 1.0), lower)
        return np.vstack([G, np.eye(n)[j]]), np.r_[h, lower[j] - gap], A, b, lower, upper
    if way == "equations":
        return (
            G,
            h,
            np.vstack([A, row, row * 2.0]),
            np.r_[b, row @ x, 2.0 * (row @ x + gap)],
            lower,
            upper,
        )
    other = rng.standard_normal(n)
    return (
        np.vstack([G, row, other, -row - other]),
        np.r_[h, row @ x, other @ x, -(row + other) @ x - gap],
        A,
        b,
        lower,
        upper,
    )


def _opened(rng, P, q, G, A, lower, upper):
    """Add a direction of unlimited descent.

    d has no curvature, and no rows or bounds limit it.
    """
    n = len(q)
    d = rng.standard_normal(n)
    d /= np.linalg.norm(d)
    project = np.eye(n) - np.outer(d, d)
    P, A = project @ P @ project, A @ project
    G = G @ project - np.outer(rng.random(len(G)) * (rng.random(len(G)) < 0.5), d)
    lower, upper = np.where(d < 0, -np.inf, lower), np.where(d > 0, np.inf, upper)
    return (P + P.T) / 2, project @ q - rng.uniform(0.2, 2.0) * d, G, A, lower, upper


def _scaled(rng, plain, cost, units, widest, sparse):
    """Return the program in other units."""
    p, matrix_type = plain, scipy.sparse.csc_matrix if sparse else np.asarray
    rows, equations = (10.0 ** rng.uniform(-widest, widest, len(p[name])) for name in ("h", "b"))

    def infinite(values, sign):
        return np.where(np.isinf(values), sign * rng.choice(INFINITIES, len(values)), values)

    scaled = {
        "P": matrix_type(cost * units[:, None] * p["P"] * units),
        "q": cost * units * p["q"],
        "G": matrix_type(rows[:, None] * p["G"] * units),
        "h": infinite(rows * p["h"], 1.0),
        "A": matrix_type(equations[:, None] * p["A"] * units),
        "b": equations * p["b"],
        "lb": infinite(p["lb"] / units, -1.0),
        "ub": infinite(p["ub"] / units, 1.0),
    }
    for matrix, right in (("G", "h"), ("A", "b")):
        if not len(scaled[right]) and rng.random() < 0.7:  # otherwise a matrix without rows
            scaled[matrix] = scaled[right] = None
    for side in ("lb", "ub"):
        if not (np.abs(scaled[side]) < INFINITIES[0]).any() and rng.random() < 0.5:
            scaled[side] = None
    return scaled
