"""Boxed problems with narrow matrices by seed.

They are chains, convection, wide bands and beams, with bounds everywhere or in windows.
"""

import numpy as np
import scipy.sparse

from small_problems import SmallProblem

KINDS = (
    "chain",
    "rough chain",
    "pinched chain",
    "convection",
    "wide band",
    "dominant band",
    "supported beam",
    "beam",
    "frame",
)
M_MATRICES = KINDS[:5]


def narrow_problem(kind, seed, n):
    """Return a problem of about n unknowns.

    Loads and coefficients are smooth in the index, unless the kind says otherwise.
    """
    rng = np.random.default_rng([seed, n, KINDS.index(kind)])
    A, b = _frame(rng, n) if kind == "frame" else _matrix(kind, rng, n)
    return SmallProblem(
        f"{kind} {seed} {n}", A, b, *_bounds(rng, len(b), deflections=kind == "frame")
    )


def _smooth(rng, x):
    parts = range(1, 6)
    return sum(
        rng.normal() / j * np.sin(2 * np.pi * j * x * rng.uniform(0.3, 1) + rng.uniform(0, 6))
        for j in parts
    )


def _matrix(kind, rng, n):
    x, h = np.arange(1, n + 1) / (n + 1), 1 / (n + 1)
    load = 20 * _smooth(rng, x) + 8 * rng.normal()
    if kind in ("chain", "rough chain", "pinched chain", "convection"):
        c = np.ones(n + 1)
        if kind == "rough chain":
            c = 10 ** rng.uniform(-2, 2, n + 1)
        elif kind == "pinched chain":
            c[rng.random(n + 1) < 0.01] = 1e-4
        # Upwind differences: the cell Peclet number is small.
        wind = rng.uniform(-5, 5) * h if kind == "convection" else 0.0
        lower, upper = c[1:-1] + max(wind, 0), c[1:-1] + max(-wind, 0)
        A = scipy.sparse.diags_array(
            [-lower, c[:-1] + c[1:] + abs(wind), -upper], offsets=[-1, 0, 1]
        )
        return A.tocsr(), load * h**2 * (10 if kind == "rough chain" else 1)
    if kind == "dominant band":
        parts = [
            scipy.sparse.diags_array(rng.uniform(-1, 1, n - abs(o)), offsets=o, shape=(n, n))
            for o in (-3, -2, -1, 1, 2, 3)
        ]
        A = sum(parts[1:], parts[0])
        return (
            A + scipy.sparse.diags_array(abs(A).sum(axis=1) * rng.uniform(1, 1.5, n) + 0.01)
        ).tocsr(), rng.standard_normal(n)
    if kind == "wide band":
        A, sums = scipy.sparse.csr_array((n, n)), np.zeros(n)
        for o in (1, 2, 3):
            e = rng.uniform(0, 1) * (0.5 + rng.random(n - o))
            A = A - scipy.sparse.diags_array([e, e], offsets=[-o, o], shape=(n, n))
            sums[:-o] += e
            sums[o:] += e
        sums[[0, -1]] += 1.0
        return (A + scipy.sparse.diags_array(sums)).tocsr(), 3 * load * h**2
    K = scipy.sparse.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n))
    A = K @ K + (
        scipy.sparse.diags_array(np.full(n, (30 * h) ** 4)) if kind == "supported beam" else 0 * K
    )
    return A.tocsr(), 150 * load * h**4


def _frame(rng, n):
    """Return Hermite elements: deflection and slope at each node, clamped ends."""
    nodes, h = n // 2, 1 / (n // 2 + 1)
    own, other, slopes = 12.0, 6 * h, h * h
    K = np.array(
        [
            [own, other, -own, other],
            [other, 4 * slopes, -other, 2 * slopes],
            [-own, -other, own, -other],
            [other, 2 * slopes, -other, 4 * slopes],
        ]
    )
    first = 2 * np.arange(nodes + 1)[:, None]
    rows, columns = first + np.repeat(np.arange(4), 4), first + np.tile(np.arange(4), 4)
    A = (
        scipy.sparse.coo_array((np.tile(K.ravel(), nodes + 1), (rows.ravel(), columns.ravel())))
        .tocsr()[2:-2, 2:-2]
        .tocsr()
    )
    b = np.zeros(2 * nodes)
    b[::2] = (3000 * _smooth(rng, np.arange(1, nodes + 1) * h) + 600 * rng.normal()) * h**4
    return A, b


def _bounds(rng, n, *, deflections):
    t, lower, upper, form = np.arange(n) / n, np.zeros(n), np.full(n, np.inf), rng.integers(0, 5)
    if form == 1:
        upper = np.where(abs(t - rng.random()) < 0.2 * rng.random(), 0.05, np.inf)
    elif form == 2:
        lower, upper = np.full(n, -0.1), np.full(n, 0.1 * rng.random())
    elif form == 3:
        lower = np.where(abs(t - rng.random()) < 0.3, 0.0, -np.inf)
        upper = np.where(abs(t - rng.random()) < 0.3, 0.1, np.inf)
    elif form == 4:
        lower = -0.1 - 0.1 * np.sin(9 * t) ** 2 * rng.random()
    if deflections:
        slope = np.arange(n) % 2 == 1
        lower, upper = np.where(slope, -np.inf, lower), np.where(slope, np.inf, upper)
    return lower, upper
