"""Random problems that a recommendation is learned from and tried on: a family, a seed, and everything else follows.

Sizes are spread evenly in their logarithm; shares, conditions, bounds and the accuracy asked for are chosen by the seed as well.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp import gallery
from warp_lcp.gallery import Plant, Problem, planted
from warp_lcp.gallery.contact_models import StewartTrinkleModel
from warp_lcp.gallery.contact_scenes import SCENES, contact_scene

ACCURACIES = (1e-2, 1e-4, 1e-6, 1e-8)
DEVICE = "cpu"


def choices(seed: int) -> np.random.Generator:
    """Return random numbers that choose a problem, independent of those that fill it."""
    return np.random.default_rng([seed, 331])


def accuracy_of(seed: int) -> float:
    """Return the relative residual that a problem is solved to."""
    return float(np.random.default_rng([seed, 332]).choice(ACCURACIES))


def between(rng: np.random.Generator, low: float, high: float) -> int:
    """Return an integer in [low, high], evenly spread in its logarithm."""
    return round(float(np.exp(rng.uniform(np.log(low), np.log(high)))))


def plant(rng: np.random.Generator) -> Plant:
    """Return a way to plant: a share of active unknowns, sometimes boxes, weak unknowns, equations."""
    boxed = bool(rng.random() < 0.3)
    weak, mixed = (float(rng.random() < 0.2) * float(rng.uniform(0, 0.5)) for _ in range(2))
    return Plant(active=float(rng.uniform(0.1, 0.7)), boxed=boxed, weak=weak, mixed=mixed)


def grid(rng: np.random.Generator, seed: int, shape: tuple[int, ...]) -> Problem:
    """Return a planted Poisson problem, sometimes with holes, solids and random coefficients."""
    holes = float(rng.random() < 0.5)
    coefficients = "random" if rng.random() < 0.4 else "uniform"
    return gallery.poisson(
        shape, plant=plant(rng), air=0.1 * holes, solid=0.15 * holes, coefficients=coefficients, seed=seed, device=DEVICE, dtype=wp.float64
    )


def liquid(rng: np.random.Generator, most: int) -> Problem:
    """Return the pressure problem of a splash."""
    scene = gallery.splash(between(rng, 8, most), phase=float(rng.random()))
    return scene.named(str(rng.choice(["walls", "everywhere"])), device=DEVICE, dtype=wp.float64)


def convection(m: int, wind: float, *, upwind: bool) -> scipy.sparse.csr_array:
    """Return diffusion and convection along both axes on m^2 cells: upwind differences make it an M-matrix, centered ones need not."""
    L = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(m, m))
    C = scipy.sparse.diags_array([-2.0, 2.0, 0.0] if upwind else [-1.0, 0.0, 1.0], offsets=[-1, 0, 1], shape=(m, m))
    eye = scipy.sparse.eye_array(m)
    one = L + wind * C
    return scipy.sparse.csr_array(scipy.sparse.kron(eye, one) + scipy.sparse.kron(one, eye))


def flow(rng: np.random.Generator, seed: int) -> Problem:
    """Return an unsymmetric sparse problem: planted, or an obstacle under a load."""
    m, upwind = between(rng, 8, 100), bool(rng.random() < 0.7)
    A = convection(m, float(rng.uniform(0.05, 0.9) * (3 if upwind else 1)), upwind=upwind)
    facts = frozenset({"p-matrix", "positive-definite", "positive-diagonal"})
    if rng.random() < 0.5:
        return planted(A, np.random.default_rng(seed), plant(rng), name=f"convection {m}^2", facts=facts)
    load = np.full(m * m, -8.0 / m**2) * (1 + 3 * rng.random(m * m))
    upper = np.full(m * m, float(rng.uniform(0.02, 0.3)))
    return Problem(f"convection {m}^2 under an obstacle", A, load, np.zeros(m * m), upper, None, facts)


def sparse_squares(rng: np.random.Generator, seed: int) -> Problem:
    """Return J J' with sparse J of fewer columns than rows, or as many, plus a small multiple of I: semi-definite or badly conditioned."""
    n, filler = between(rng, 30, 2000), np.random.default_rng(seed)
    J = scipy.sparse.random_array((n, max(2, int(n * rng.uniform(0.5, 1.2)))), density=min(1.0, 4 / n), rng=filler)
    shift = 10.0 ** float(rng.uniform(-4, -1)) * float(rng.random() < 0.7)
    A = scipy.sparse.csr_array(J @ J.T + (shift + 1e-3) * scipy.sparse.eye_array(n))
    return planted(A, filler, plant(rng), name=f"sparse J J' {n}", facts=frozenset({"symmetric", "positive-diagonal"}))


def sparse_unsymmetric(rng: np.random.Generator, seed: int) -> Problem:
    """Return a random sparse matrix with signs and a dominant diagonal: a P-matrix, no M-matrix."""
    n, filler = between(rng, 30, 10000), np.random.default_rng(seed)
    R = scipy.sparse.random_array((n, n), density=min(0.5, 5 / n), rng=filler)
    R.data -= 0.5
    rows = np.abs(R).sum(axis=1)
    A = scipy.sparse.csr_array(R + scipy.sparse.diags_array(rows * float(rng.uniform(1.02, 1.5)) + 0.05))
    return planted(A, filler, plant(rng), name=f"sparse unsymmetric {n}", facts=frozenset({"p-matrix", "positive-diagonal"}))


def scene(rng: np.random.Generator, seed: int, model: object) -> Problem:
    """Return a contact problem of a scene with bodies that rest or begin to move."""
    name = str(rng.choice([n for n in SCENES if n not in ("driven-gears",)]))
    size = None if rng.random() < 0.4 else between(rng, 1, 3) * 2 + 1  # odd: an arch has a link on top
    return contact_scene(name, size, model=model, seed=seed)  # type: ignore[arg-type]


def frozen(rng: np.random.Generator, seed: int) -> Problem:
    """Return a scene's contacts with constant boxes for friction: symmetric, semi-definite, sparse."""
    p = scene(rng, seed, None)
    normal = np.abs(rng.standard_normal(len(p.b)))
    low, high = p.lower.at(normal), p.upper.at(normal)
    return Problem(f"{p.name}, frozen", p.A, p.b, np.minimum(low, high), high, None, p.facts - {"affine"})


def bodies_in_liquid(rng: np.random.Generator) -> wl.LCP:
    """Return a splash with rigid columns of low rank added: products only."""
    splash = gallery.splash(between(rng, 8, 20), phase=float(rng.random()))
    A = wl.GridPoisson(splash.cells, device=DEVICE, dtype=wp.float64)
    columns = np.zeros((*splash.cells.shape, 3))
    rows = np.argwhere(splash.wall)
    picked = rows[rng.choice(len(rows), min(40, len(rows)), replace=False)]
    columns[tuple(picked.T)] = rng.standard_normal((len(picked), 3))
    both = wl.SumOperator(A, wl.LowRankOperator(columns, np.full(3, float(rng.uniform(0.1, 5))), device=DEVICE))
    return wl.LCP(both, splash.b, splash.lower("walls"))


def equations(rng: np.random.Generator, seed: int) -> Problem:
    """Return a problem without bounds on a grid, or on a sparse or dense matrix."""
    kind, all_free = rng.integers(3), Plant(mixed=1.0)
    if kind == 0:
        return gallery.poisson((between(rng, 8, 100),) * 2, plant=all_free, seed=seed, device=DEVICE, dtype=wp.float64)
    if kind == 1:
        return gallery.banded(between(rng, 100, 10000), plant=all_free, seed=seed)
    return gallery.definite(between(rng, 10, 300), condition=10.0 ** float(rng.uniform(0, 3)), plant=all_free, seed=seed)


Make = Callable[[np.random.Generator, int], Problem | wl.LCP]
FAMILIES: dict[str, Make] = {
    "tiny": lambda r, s: gallery.definite(int(r.integers(1, 5)), condition=10.0, plant=plant(r), seed=s),
    "definite": lambda r, s: gallery.definite(between(r, 10, 500), condition=10.0 ** float(r.uniform(0, 4)), plant=plant(r), seed=s),
    "semidefinite": lambda r, s: gallery.semidefinite(between(r, 10, 300), zeros=float(r.uniform(0.1, 0.8)), plant=plant(r), seed=s),
    "skewed": lambda r, s: gallery.skewed(between(r, 10, 400), skew=float(r.uniform(0.2, 2)), plant=plant(r), seed=s),
    "period-three": lambda r, s: gallery.period_three(between(r, 1, 20), plant=plant(r), seed=s),
    "contact": lambda r, s: gallery.contact(between(r, 1, 30), directions=int(r.choice([4, 8])), seed=s),
    "banded": lambda r, s: gallery.banded(between(r, 100, 30000), bands=int(r.integers(1, 7)), plant=plant(r), seed=s),
    "banded-dense": lambda r, s: gallery.banded(between(r, 20, 400), bands=int(r.integers(1, 7)), plant=plant(r), seed=s).dense(),
    "poisson-2d": lambda r, s: grid(r, s, (between(r, 8, 160), between(r, 8, 160))),
    "poisson-3d": lambda r, s: grid(r, s, (between(r, 4, 32), between(r, 4, 32), between(r, 4, 32))),
    "poisson-sparse": lambda r, s: grid(r, s, (between(r, 8, 100), between(r, 8, 100))).sparse(),
    "obstacle": lambda r, s: gallery.ball_obstacle(between(r, 9, 161), device=DEVICE, dtype=wp.float64),
    "obstacle-sparse": lambda r, s: gallery.ball_obstacle(between(r, 9, 97), device=DEVICE, dtype=wp.float64).sparse(),
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
    """Return a problem's name, the problem and the accuracy asked for."""
    number = 1000 * list(FAMILIES).index(family) + seed
    made = FAMILIES[family](choices(number), number)
    if isinstance(made, wl.LCP):
        return f"{family} {made.A.shape}", made, accuracy_of(number)
    return made.name, made.lcp(device=DEVICE), accuracy_of(number)
