"""Random problems by kind and seed, to measure and test rules of `wl.recommend`.

Sizes are log-uniform. The seed also chooses shares, condition numbers, bounds and the accuracy.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import warp as wp

import warp_lcp as wl
from warp_lcp import gallery
from warp_lcp.gallery import PlantedSolution, Problem, planted
from warp_lcp.gallery.contact_scenes import SCENES, contact_scene
from warp_lcp.rigid.contact_models import StewartTrinkleModel

ACCURACIES = (1e-2, 1e-4, 1e-6, 1e-8)
DEVICE = "cpu"


def choices(seed: int) -> np.random.Generator:
    """Return a generator for the choices, independent of the problem's data."""
    return np.random.default_rng([seed, 331])


def accuracy_of(seed: int) -> float:
    """Return the relative residual of a problem's solves."""
    return float(np.random.default_rng([seed, 332]).choice(ACCURACIES))


def between(rng: np.random.Generator, low: float, high: float) -> int:
    """Return a log-uniform integer in [low, high]."""
    return round(float(np.exp(rng.uniform(np.log(low), np.log(high)))))


def plant(rng: np.random.Generator) -> PlantedSolution:
    """Return options for a planted solution.

    They choose a share of active unknowns and, sometimes, boxes, weakly active unknowns and
    equations.
    """
    boxed = bool(rng.random() < 0.3)
    weak, mixed = (float(rng.random() < 0.2) * float(rng.uniform(0, 0.5)) for _ in range(2))
    return PlantedSolution(active=float(rng.uniform(0.1, 0.7)), boxed=boxed, weak=weak, mixed=mixed)


def grid(rng: np.random.Generator, seed: int, shape: tuple[int, ...]) -> Problem:
    """Return a planted Poisson problem, sometimes with holes, solids and coefficients."""
    holes = float(rng.random() < 0.5)
    coefficients = "random" if rng.random() < 0.4 else "uniform"
    return gallery.poisson(
        shape,
        plant=plant(rng),
        air=0.1 * holes,
        solid=0.15 * holes,
        coefficients=coefficients,
        seed=seed,
        device=DEVICE,
        dtype=wp.float64,
    )


def liquid(rng: np.random.Generator, most: int) -> Problem:
    """Return the pressure problem of a splash."""
    scene = gallery.splash(between(rng, 8, most), phase=float(rng.random()))
    return scene.named(str(rng.choice(["walls", "everywhere"])), device=DEVICE, dtype=wp.float64)


def convection(m: int, wind: float, *, upwind: bool) -> scipy.sparse.csr_array:
    """Return convection-diffusion on m^2 cells.

    Upwind differences make the matrix an M-matrix; centered ones need not.
    """
    L = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(m, m))
    C = scipy.sparse.diags_array(
        [-2.0, 2.0, 0.0] if upwind else [-1.0, 0.0, 1.0], offsets=[-1, 0, 1], shape=(m, m)
    )
    eye = scipy.sparse.eye_array(m)
    one = L + wind * C
    return scipy.sparse.csr_array(scipy.sparse.kron(eye, one) + scipy.sparse.kron(one, eye))


def flow(rng: np.random.Generator, seed: int) -> Problem:
    """Return an unsymmetric sparse problem: planted, or an obstacle under a load."""
    m, upwind = between(rng, 8, 100), bool(rng.random() < 0.7)
    A = convection(m, float(rng.uniform(0.05, 0.9) * (3 if upwind else 1)), upwind=upwind)
    facts = frozenset({"p-matrix", "positive-definite", "positive-diagonal"})
    if rng.random() < 0.5:
        return planted(
            A, np.random.default_rng(seed), plant(rng), name=f"convection {m}^2", facts=facts
        )
    load = np.full(m * m, -8.0 / m**2) * (1 + 3 * rng.random(m * m))
    upper = np.full(m * m, float(rng.uniform(0.02, 0.3)))
    return Problem(
        f"convection {m}^2 under an obstacle", A, load, np.zeros(m * m), upper, None, facts
    )


def sparse_squares(rng: np.random.Generator, seed: int) -> Problem:
    """Return J J' plus a small multiple of I, J sparse with at most n columns.

    The matrix is semi-definite or ill-conditioned.
    """
    n, filler = between(rng, 30, 2000), np.random.default_rng(seed)
    J = scipy.sparse.random_array(
        (n, max(2, int(n * rng.uniform(0.5, 1.2)))), density=min(1.0, 4 / n), rng=filler
    )
    shift = 10.0 ** float(rng.uniform(-4, -1)) * float(rng.random() < 0.7)
    A = scipy.sparse.csr_array(J @ J.T + (shift + 1e-3) * scipy.sparse.eye_array(n))
    return planted(
        A,
        filler,
        plant(rng),
        name=f"sparse J J' {n}",
        facts=frozenset({"symmetric", "positive-diagonal"}),
    )


def sparse_unsymmetric(rng: np.random.Generator, seed: int) -> Problem:
    """Return a random sparse P-matrix that is no M-matrix.

    Its entries have random signs and its diagonal is dominant.
    """
    n, filler = between(rng, 30, 10000), np.random.default_rng(seed)
    R = scipy.sparse.random_array((n, n), density=min(0.5, 5 / n), rng=filler)
    R.data -= 0.5
    rows = np.abs(R).sum(axis=1)
    A = scipy.sparse.csr_array(
        R + scipy.sparse.diags_array(rows * float(rng.uniform(1.02, 1.5)) + 0.05)
    )
    return planted(
        A,
        filler,
        plant(rng),
        name=f"sparse unsymmetric {n}",
        facts=frozenset({"p-matrix", "positive-diagonal"}),
    )


def scene(rng: np.random.Generator, seed: int, model: object) -> Problem:
    """Return a contact problem of a scene with bodies that rest or begin to move."""
    name = str(rng.choice([n for n in SCENES if n not in ("driven-gears",)]))
    # Odd: an arch needs a keystone.
    size = None if rng.random() < 0.4 else between(rng, 1, 3) * 2 + 1
    return contact_scene(name, size, model=model, seed=seed)  # type: ignore[arg-type]


def frozen(rng: np.random.Generator, seed: int) -> Problem:
    """Return contacts with constant friction boxes: symmetric, semi-definite, sparse."""
    p = scene(rng, seed, None)
    normal = np.abs(rng.standard_normal(len(p.b)))
    assert isinstance(p.lower, wl.AffineBounds) and isinstance(p.upper, wl.AffineBounds)
    low, high = p.lower.at(normal), p.upper.at(normal)
    return Problem(
        f"{p.name}, frozen", p.A, p.b, np.minimum(low, high), high, None, p.facts - {"affine"}
    )


def bodies_in_liquid(rng: np.random.Generator) -> wl.LCP:
    """Return a splash with a low-rank term of rigid bodies: matrix products only."""
    splash = gallery.splash(between(rng, 8, 20), phase=float(rng.random()))
    A = wl.GridPoisson(splash.cells, device=DEVICE, dtype=wp.float64)
    columns = np.zeros((*splash.cells.shape, 3))
    rows = np.argwhere(splash.wall)
    picked = rows[rng.choice(len(rows), min(40, len(rows)), replace=False)]
    columns[tuple(picked.T)] = rng.standard_normal((len(picked), 3))
    both = wl.SumOperator(
        A, wl.LowRankOperator(columns, np.full(3, float(rng.uniform(0.1, 5))), device=DEVICE)
    )
    return wl.LCP(both, splash.b, splash.lower("walls"))


def equations(rng: np.random.Generator, seed: int) -> Problem:
    """Return a problem without bounds on a grid, or on a sparse or dense matrix."""
    kind, all_free = rng.integers(3), PlantedSolution(mixed=1.0)
    if kind == 0:
        return gallery.poisson(
            (between(rng, 8, 100),) * 2, plant=all_free, seed=seed, device=DEVICE, dtype=wp.float64
        )
    if kind == 1:
        return gallery.banded(between(rng, 100, 10000), plant=all_free, seed=seed)
    return gallery.definite(
        between(rng, 10, 300), condition=10.0 ** float(rng.uniform(0, 3)), plant=all_free, seed=seed
    )


ProblemFamily = Callable[[np.random.Generator, int], Problem | wl.LCP]
FAMILIES: dict[str, ProblemFamily] = {
    "tiny": lambda r, s: gallery.definite(
        int(r.integers(1, 5)), condition=10.0, plant=plant(r), seed=s
    ),
    "definite": lambda r, s: gallery.definite(
        between(r, 10, 500), condition=10.0 ** float(r.uniform(0, 4)), plant=plant(r), seed=s
    ),
    "semidefinite": lambda r, s: gallery.semidefinite(
        between(r, 10, 300), zeros=float(r.uniform(0.1, 0.8)), plant=plant(r), seed=s
    ),
    "skewed": lambda r, s: gallery.skewed(
        between(r, 10, 400), skew=float(r.uniform(0.2, 2)), plant=plant(r), seed=s
    ),
    "period-three": lambda r, s: gallery.period_three(between(r, 1, 20), plant=plant(r), seed=s),
    "contact": lambda r, s: gallery.contact(
        between(r, 1, 30), directions=int(r.choice([4, 8])), seed=s
    ),
    "banded": lambda r, s: gallery.banded(
        between(r, 100, 30000), bands=int(r.integers(1, 7)), plant=plant(r), seed=s
    ),
    "banded-dense": lambda r, s: gallery.banded(
        between(r, 20, 400), bands=int(r.integers(1, 7)), plant=plant(r), seed=s
    ).dense(),
    "poisson-2d": lambda r, s: grid(r, s, (between(r, 8, 160), between(r, 8, 160))),
    "poisson-3d": lambda r, s: grid(
        r, s, (between(r, 4, 32), between(r, 4, 32), between(r, 4, 32))
    ),
    "poisson-sparse": lambda r, s: grid(r, s, (between(r, 8, 100), between(r, 8, 100))).sparse(),
    "obstacle": lambda r, s: gallery.ball_obstacle(
        between(r, 9, 161), device=DEVICE, dtype=wp.float64
    ),
    "obstacle-sparse": lambda r, s: gallery.ball_obstacle(
        between(r, 9, 97), device=DEVICE, dtype=wp.float64
    ).sparse(),
    "splash": lambda r, s: liquid(r, 40),
    "splash-sparse": lambda r, s: liquid(r, 20).sparse(),
    "convection": flow,
    "sparse-squares": sparse_squares,
    "sparse-unsymmetric": sparse_unsymmetric,
    "scene-boxed": lambda r, s: scene(r, s, None),
    "scene-frozen": frozen,
    "scene-cone": lambda r, s: scene(r, s, StewartTrinkleModel(int(r.choice([4, 8])))),
    "scene-cone-dense": lambda r, s: scene(r, s, StewartTrinkleModel()).dense(),
    "bodies-in-liquid": lambda r, s: bodies_in_liquid(r),
    "equations": equations,
}


def make(family: str, seed: int) -> tuple[str, wl.LCP, float]:
    """Return a problem's name, the problem and its required accuracy."""
    number = 1000 * list(FAMILIES).index(family) + seed
    made = FAMILIES[family](choices(number), number)
    if isinstance(made, wl.LCP):
        return f"{family} {made.A.shape}", made, accuracy_of(number)
    return made.name, made.lcp(device=DEVICE), accuracy_of(number)


def low_rank(rng: np.random.Generator, ridge: float) -> wl.LCP:
    """Return a convex box problem F F' + ridge I, n x n of rank d < n, dense."""
    n, d = between(rng, 20, 300), between(rng, 2, 20)
    F, low = rng.standard_normal((n, d)), -float(rng.integers(2))
    b = -rng.random(n) if rng.random() < 0.5 else rng.standard_normal(n)
    return wl.LCP(F @ F.T + ridge * np.eye(n), b, low, 10.0 ** float(rng.uniform(-1, 1)))


def support_vectors(rng: np.random.Generator) -> wl.LCP:
    """Return the dual of a support vector machine without a bias: 0 <= x <= C."""
    n, d = between(rng, 30, 400), between(rng, 2, 30)
    points = rng.standard_normal((n, d))
    labels = np.where(points[:, 0] + 0.7 * rng.standard_normal(n) > 0, 1.0, -1.0)
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    kernel = points @ points.T if rng.random() < 0.6 else np.exp(-squares / (2 * d))
    return wl.LCP(
        labels[:, None] * kernel * labels, -np.ones(n), 0.0, 10.0 ** float(rng.uniform(-1, 2))
    )


def portfolio(rng: np.random.Generator) -> wl.LCP:
    """Return Markowitz's problem; the last unknown is the multiplier of sum x = 1."""
    n, d = between(rng, 20, 200), between(rng, 2, 10)
    F = rng.standard_normal((n, d))
    A = np.zeros((n + 1, n + 1))
    A[:n, :n] = F @ F.T / d + np.diag(rng.uniform(0.01, 0.5, n))
    A[:n, n], A[n, :n] = -1.0, 1.0
    most = np.append(np.full(n, max(0.2, 4 / n)), np.inf)
    return wl.LCP(
        A, np.append(-0.3 * rng.standard_normal(n), -1.0), np.append(np.zeros(n), -np.inf), most
    )


def game(rng: np.random.Generator) -> wl.LCP:
    """Return a bimatrix game of costs >= 1: x, y >= 0, E y >= 1, F'x >= 1."""
    p, q = between(rng, 2, 60), between(rng, 2, 60)
    A = np.zeros((p + q, p + q))
    A[:p, p:], A[p:, :p] = rng.uniform(1, 2, (p, q)), rng.uniform(1, 2, (q, p))
    return wl.LCP(A, -np.ones(p + q))


def linear_program(rng: np.random.Generator) -> wl.LCP:
    """Return min c'z, G z >= h, z >= 0 with its dual, a skew LCP; both feasible."""
    n, m = between(rng, 5, 80), between(rng, 3, 60)
    G = rng.standard_normal((m, n))
    z, multipliers = (np.maximum(rng.standard_normal(size), 0.0) for size in (n, m))
    h = G @ z - np.where(multipliers > 0, 0.0, rng.random(m))
    c = G.T @ multipliers + np.where(z > 0, 0.0, rng.random(n))
    A = np.block([[np.zeros((n, n)), -G.T], [G, np.zeros((m, m))]])
    return wl.LCP(scipy.sparse.csr_array(A) if rng.random() < 0.5 else A, np.concatenate([c, -h]))


def p_matrix(rng: np.random.Generator, seed: int) -> wl.LCP:
    """Return a dense P-matrix: definite plus large skew, rows and columns scaled."""
    n = between(rng, 10, 300)
    B, C = rng.standard_normal((2, n, n)) / n**0.5
    A = (
        (B @ B.T + 0.1 * np.eye(n) + 2 * (C - C.T))
        * 10 ** rng.uniform(-1, 1, n)
        * 10 ** rng.uniform(-1, 1, (n, 1))
    )
    return planted(
        A, np.random.default_rng(seed), plant(rng), name="P", facts=frozenset({"p-matrix"})
    ).lcp(device=DEVICE)


def laplacian(rng: np.random.Generator) -> wl.LCP:
    """Return the singular Laplacian of a random graph; bounds carry the loads."""
    n = between(rng, 50, 3000)
    ends = rng.integers(0, n, (2, 2 * n))
    ends = ends[:, ends[0] != ends[1]]
    W = scipy.sparse.coo_array(
        (rng.uniform(0.1, 1, ends.shape[1]), tuple(ends)), shape=(n, n)
    ).tocsr()
    L = scipy.sparse.csgraph.laplacian(W + W.T)
    boxed = rng.random() < 0.5
    b = rng.standard_normal(n) if boxed else 0.3 * rng.random(n)
    return wl.LCP(scipy.sparse.csr_array(L), b, -rng.random(n), 1.0 if boxed else np.inf)


def stack(rng: np.random.Generator, seed: int) -> wl.LCP:
    """Return contacts without friction: J M^-1 J' with dependent rows."""
    made = frozen(rng, seed)
    normals = np.flatnonzero(np.isinf(np.asarray(made.upper)) & (np.asarray(made.lower) == 0))
    if not len(normals):  # joints only
        return stack(rng, seed)
    A = scipy.sparse.csr_array(made.A)[normals][:, normals]
    return wl.LCP(A if rng.random() < 0.5 else A.toarray(), np.asarray(made.b)[normals])


def products(rng: np.random.Generator, seed: int) -> wl.LCP:
    """Return a problem whose operator offers matrix products only."""
    n = between(rng, 20, 400)
    problem = gallery.definite(
        n, condition=10.0 ** float(rng.uniform(0, 3)), plant=plant(rng), seed=seed
    )
    A = np.asarray(problem.A)
    return wl.LCP(
        wl.LinearOperator(lambda x: A @ x, shape=(n,), symmetric=True),
        problem.b,
        problem.lower,
        problem.upper,
    )


def membrane(rng: np.random.Generator) -> wl.LCP:
    """Return a membrane under a load: a sparse Laplacian with an uneven shift."""
    m = between(rng, 8, 90)
    T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(m, m))
    weights = scipy.sparse.diags_array(rng.uniform(0.5, 2, m * m))
    L = scipy.sparse.kron(scipy.sparse.eye_array(m), T) + scipy.sparse.kron(
        T, scipy.sparse.eye_array(m)
    )
    A = scipy.sparse.csr_array(L + float(rng.uniform(0, 0.1)) * weights)
    b = rng.uniform(-10, 2, m * m) / m**2
    return wl.LCP(A, b, 0.0, float(rng.uniform(0.05, 0.3)) if rng.random() < 0.5 else np.inf)


KINDS: dict[str, ProblemFamily] = {  # problems of many fields; all have solutions
    "pressure": lambda r, s: liquid(r, 32),
    "membrane": lambda r, s: membrane(r),
    "low rank": lambda r, s: low_rank(r, 0.0),
    "ridge": lambda r, s: low_rank(r, 10.0 ** float(r.uniform(-4, -1))),
    "support vectors": lambda r, s: support_vectors(r),
    "portfolio": lambda r, s: portfolio(r),
    "game": lambda r, s: game(r),
    "linear program": lambda r, s: linear_program(r),
    "pyramid": lambda r, s: scene(r, s, StewartTrinkleModel(int(r.choice([4, 8])))),
    "boxed friction": lambda r, s: scene(r, s, None),
    "flow": flow,
    "P-matrix": p_matrix,
    "graph": lambda r, s: laplacian(r),
    "stack": stack,
    "products": products,
}


def sign_error(rng: np.random.Generator, low: int, high: int) -> wl.LCP:
    """Return -A of a definite A without upper bounds, unsolvable by descent methods."""
    n = between(rng, low, high)
    A = scipy.sparse.diags_array([1.0, -4.0, 1.0], offsets=[-1, 0, 1], shape=(n, n))
    return wl.LCP(scipy.sparse.csr_array(A), rng.standard_normal(n))


def negative_diagonal(rng: np.random.Generator, seed: int, *, boxed: bool) -> Problem:
    """Return a dense random matrix with negative diagonal entries, planted solution."""
    n = between(rng, 5, 40)
    A = rng.standard_normal((n, n)) + np.diag(np.where(rng.random(n) < 0.2, -1.0, 3.0) * n**0.5)
    A[0, 0] = -1.0
    return planted(
        A,
        np.random.default_rng(seed),
        PlantedSolution(active=0.4, boxed=boxed),
        name="negative diagonal",
        facts=frozenset(),
    )


def sparse_negative_diagonal(rng: np.random.Generator) -> wl.LCP:
    """Return a boxed random symmetric sparse matrix with negative diagonal entries.

    One row of twenty has a negative diagonal entry.
    """
    n = between(rng, 300, 4000)
    R = scipy.sparse.random_array((n, n), density=4 / n, rng=rng, data_sampler=rng.standard_normal)
    d = rng.uniform(0.5, 3.0, n)
    d[rng.choice(n, n // 20, replace=False)] -= 4.0
    return wl.LCP(
        scipy.sparse.csr_array((R + R.T) / 2 + scipy.sparse.diags_array(d)),
        rng.standard_normal(n),
        0.0,
        10.0 ** float(rng.uniform(-1, 1)),
    )


def wind(rng: np.random.Generator) -> wl.LCP:
    """Return upwind convection-diffusion above an obstacle: an unsymmetric stencil."""
    m, peclet = between(rng, 16, 128), 10.0 ** float(rng.uniform(-1, 2))
    stencil = np.array(
        [[0.0, -1.0, 0.0], [-1.0 - peclet, 4.0 + 2 * peclet, -1.0], [0.0, -1.0 - peclet, 0.0]]
    )
    A = wl.Stencil(
        np.full((m, m), wl.FLUID), stencil, outside=wl.AIR, device=DEVICE, dtype=wp.float64
    )
    return wl.LCP(A, (1.0 + peclet) / m * rng.uniform(-2, 1, (m, m)))


def dominant(rng: np.random.Generator, seed: int) -> Problem:
    """Return a random sparse matrix with a dominant diagonal.

    The diagonal is two to four times the rest of its row, so that sweeps converge fast.
    """
    n, filler = between(rng, 300, 20000), np.random.default_rng(seed)
    R = scipy.sparse.random_array((n, n), density=5 / n, rng=filler)
    R.data -= 0.5
    A = scipy.sparse.csr_array(
        R + scipy.sparse.diags_array(np.abs(R).sum(axis=1) * float(rng.uniform(2, 4)) + 0.05)
    )
    return planted(
        A,
        filler,
        plant(rng),
        name=f"dominant {n}",
        facts=frozenset({"p-matrix", "positive-diagonal"}),
    )


def large_game(rng: np.random.Generator) -> wl.LCP:
    """Return a matrix game and its dual: a dense skew LCP of 410 to 500 unknowns."""
    n = int(rng.integers(205, 250))
    payoff = rng.uniform(1, 2, (n, n))
    A = np.block([[np.zeros((n, n)), payoff], [-payoff.T, np.zeros((n, n))]])
    return wl.LCP(A, np.concatenate([-np.ones(n), np.ones(n)]))


# For rules that no kind above meets; problems of sign errors may have no solution.
RARE: dict[str, ProblemFamily] = {
    "sign error": lambda r, s: sign_error(r, 10, 500),
    "large sign error": lambda r, s: sign_error(r, 1001, 3000),
    "negative diagonal": lambda r, s: negative_diagonal(r, s, boxed=False),
    "negative diagonal, boxed": lambda r, s: negative_diagonal(r, s, boxed=True),
    "wind": lambda r, s: wind(r),
    "large game": lambda r, s: large_game(r),
    "dominant": dominant,
    "sparse negative diagonal, boxed": lambda r, s: sparse_negative_diagonal(r),
}


def draw(kind: str, seed: int) -> wl.LCP:
    """Return a problem of a kind of KINDS or RARE."""
    made_by = {**KINDS, **RARE}
    number = 1000 * list(made_by).index(kind) + seed
    made = made_by[kind](np.random.default_rng([number, 333]), number)
    return made if isinstance(made, wl.LCP) else made.lcp(device=DEVICE)
