"""Small and narrow problems by seed, and a plain active set in NumPy.

They are in the forms of NumPy and SciPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse


@dataclass(frozen=True)
class SmallProblem:
    """Problem A x + b = y with bounds, and an initial guess.

    Args:
        name: description of the problem.
        A: numpy array or scipy.sparse matrix, shape (n, n).
        b: shape (n,), units of y.
        lower: l, shape (n,).
        upper: u, shape (n,).
        start: initial guess, shape (n,); None for a cold start.
    """

    name: str
    A: Any
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    start: np.ndarray | None = None

    @property
    def first(self) -> np.ndarray:
        """Initial iterate of a method."""
        return np.clip(0.0 if self.start is None else self.start, self.lower, self.upper)


def option(seed: int, *, n: int | None = None, kind: str | None = None) -> SmallProblem:
    """Return a time step of an American put or call from its payoff; tridiagonal.

    The method is Crank and Nicolson's or Euler's implicit one.
    """
    rng = np.random.default_rng(seed)
    n = n or int(rng.integers(3, 400))
    kind = kind or ("put", "call")[int(rng.integers(2))]
    rate, volatility, dividend, share = (
        rng.uniform(0.0, 0.1),
        rng.uniform(0.05, 0.6),
        rng.uniform(0.0, 0.08),
        rng.choice([0.5, 1.0]),
    )
    price = np.linspace(0.0, rng.uniform(2.0, 4.0), n + 2)[1:-1]
    h, dt = price[0], 1.0 / int(rng.integers(20, 200))
    second, first = 0.5 * (volatility * price / h) ** 2, (rate - dividend) * price / (2 * h)
    L = scipy.sparse.diags_array(
        [(second - first)[1:], -2 * second - rate, (second + first)[:-1]], offsets=[-1, 0, 1]
    )
    payoff = np.maximum(1.0 - price if kind == "put" else price - 1.0, 0.0)
    edge = np.zeros(n)
    at = 0 if kind == "put" else -1
    edge[at] = -dt * (
        (second - first)[0] if kind == "put" else (second + first)[-1] * (payoff[-1] + h)
    )
    b = edge - payoff - (1 - share) * dt * (L @ payoff)
    A = (scipy.sparse.eye_array(n) - share * dt * L).tocsr()
    return SmallProblem(f"{kind} {n}", A, b, payoff, np.full(n, np.inf), payoff)


def string(seed: int, *, n: int | None = None, between: bool = True) -> SmallProblem:
    """Return an elastic string over an obstacle or between two; tridiagonal.

    Its ends are fixed.
    """
    rng = np.random.default_rng(seed)
    n = n or int(rng.integers(1, 400))
    s = np.linspace(0.0, 1.0, n + 2)[1:-1]
    A = (
        scipy.sparse.diags_array(
            [-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)], offsets=[-1, 0, 1]
        ).tocsr()
        * (n + 1) ** 2
    )
    load = rng.uniform(1.0, 40.0) * np.sin(
        rng.integers(1, 7) * np.pi * s + rng.uniform(0, 2 * np.pi)
    )
    bump = rng.uniform(-0.1, 0.3) - rng.uniform(1.0, 12.0) * (s - rng.uniform(0.2, 0.8)) ** 2
    upper = bump + rng.uniform(0.0, 0.3, n) if between else np.full(n, np.inf)
    return SmallProblem(f"{'strings' if between else 'obstacle'} {n}", A, load, bump, upper)


def banded(seed: int, *, kind: str = "m-matrix") -> SmallProblem:
    """Return a random banded problem, bandwidth 1 to 3.

    It is an M-matrix, another diagonally dominant P-matrix, or definite and unsymmetric.
    """
    rng = np.random.default_rng(seed)
    width, n = int(rng.integers(1, 4)), int(rng.integers(5, 300))
    offsets = [k for d in range(1, width + 1) for k in (-d, d)]
    entries = [rng.uniform(-1.0, 0.0 if kind == "m-matrix" else 1.0, n - abs(k)) for k in offsets]
    A = scipy.sparse.diags_array(entries, offsets=offsets, shape=(n, n)).tocsr()
    if kind == "definite":
        A = A - 0.9 * A.T  # nearly skew: far from dominant
    reach = (
        abs(A).sum(axis=1)
        if kind != "definite"
        else np.full(n, -np.linalg.eigvalsh((A + A.T).toarray() / 2)[0])
    )
    A = (A + scipy.sparse.diags_array(reach + rng.uniform(0.01, 1.0, n))).tocsr()
    return _random_rows(f"{kind}, {width} bands, {n}", A, rng)


def dense(seed: int, *, symmetric: bool = True) -> SmallProblem:
    """Return a random dense positive definite problem of 1 to 200 unknowns."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 201))
    B, C = rng.standard_normal((2, n, n))
    A = B @ B.T / n + 10.0 ** rng.uniform(-3, 0) * np.eye(n)
    return _random_rows(f"dense {n}", A if symmetric else A + (C - C.T) / np.sqrt(n), rng)


def _random_rows(name: str, A: Any, rng: np.random.Generator) -> SmallProblem:
    """Return a problem with one-sided, boxed, equation or held rows.

    All alike or mixed; half of the problems have an initial guess.
    """
    n = A.shape[0]
    kind = rng.integers(0, 5, n) if rng.random() < 0.5 else np.full(n, rng.integers(0, 3))
    lower = np.where(np.isin(kind, (0, 2)), -rng.random(n), np.where(kind == 4, 0.2, -np.inf))
    upper = np.where(np.isin(kind, (1, 2)), rng.random(n), np.where(kind == 4, 0.2, np.inf))
    start = rng.standard_normal(n) if rng.random() < 0.5 else None
    return SmallProblem(name, A, 2 * rng.standard_normal(n), lower, upper, start)


FAMILIES: dict[str, Callable[[int], SmallProblem]] = {
    "option": option,
    "obstacle": lambda seed: string(seed, between=False),
    "strings": string,
    "m-matrix": banded,
    "p-matrix": lambda seed: banded(seed, kind="p-matrix"),
    "definite": lambda seed: banded(seed, kind="definite"),
    "dense": dense,
    "unsymmetric": lambda seed: dense(seed, symmetric=False),
}


def stepped(problem: SmallProblem, x: np.ndarray) -> SmallProblem:
    """Return the next time step of an implicit option, from the last x."""
    return replace(problem, b=problem.b + problem.first - x, start=x)


def plain_active_set(
    problem: SmallProblem, bands: np.ndarray | None = None, limit: int = 1000
) -> tuple[np.ndarray, int]:
    """Return x and steps of a plain active-set method in NumPy.

    Solve on the free set until the set stays.

    Args:
        problem: the problem; its matrix is dense if `bands` is None.
        bands: bands of a tridiagonal A in the form of `scipy.linalg.solve_banded`.
        limit: largest number of steps.
    """
    A, b, lower, upper, x = problem.A, problem.b, problem.lower, problem.upper, problem.first
    d, y = A.diagonal(), A @ x + b
    last = None
    for step in range(limit):
        low, high = x - y / d < lower, x - y / d > upper
        held = low | high
        if last is not None and (low == last[0]).all() and (high == last[1]).all():
            return x, step
        last = low, high
        x = np.where(low, lower, np.where(high, upper, 0.0))
        if bands is None:
            free = np.flatnonzero(~held)
            x[free] = np.linalg.solve(A[np.ix_(free, free)], -(A @ x + b)[free])
        else:
            m = bands.copy()
            m[0, 1:][held[:-1]] = 0.0
            m[2, :-1][held[1:]] = 0.0
            m[1, held] = 1.0
            x = scipy.linalg.solve_banded((1, 1), m, np.where(held, x, -b))
        y = A @ x + b
        y[~held] = 0.0
    return x, limit
