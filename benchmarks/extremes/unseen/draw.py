"""What random problems are drawn from, and what makes sure that each has a solution."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.sparse.csgraph

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.exact import Exact
from warp_lcp.benchmarks.extremes.problem import GridProblem, MatrixProblem

AIR, FLUID, SOLID = wl.AIR, wl.FLUID, wl.SOLID
SIDES = {2: (30, 300), 3: (12, 48)}  # cells, by dimensions
SMALL_SIDES = {2: (3, 14), 3: (2, 6)}  # where every method takes part
LARGER, LONGER = 0.03, {2: 2.0, 3: 1.4}  # share of grids with more cells along a side, and how many times as many at most
BALANCED = 1e-10  # of sum |b|: sums of b that are 0 but for rounding
GENTLY = 0.01  # of the mean |b|: what a pool's b is raised by where its sum has the sign that no bound takes up


@dataclass(frozen=True)
class Unseen:
    """A problem by kind and seed."""

    kind: str  # of `KINDS`
    seed: int  # with the kind, all that it depends on
    problem: GridProblem | MatrixProblem  # what is to be solved
    then: GridProblem | None = None  # one that differs a little, to be solved from the solution of `problem`; None for none
    allowance: float = 1.0  # factor of the iterations that it may take


class Draw:
    """Random numbers of a kind and a seed, and what is often drawn.

    Args:
        kind: of problem.
        seed: of it.
        small: draw sizes that every method can take.
    """

    def __init__(self, kind: str, seed: int, *, small: bool = False) -> None:
        self.rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])
        self.seed, self.small = seed, small

    def chance(self, p: float) -> bool:
        """Return True with probability p."""
        return bool(self.rng.random() < p)

    def between(self, low: float, high: float) -> float:
        """Return a number, uniform."""
        return float(self.rng.uniform(low, high))

    def decades(self, low: float, high: float) -> float:
        """Return a number, log-uniform."""
        return math.exp(self.between(math.log(low), math.log(high)))

    def whole(self, low: int, high: int) -> int:
        """Return an integer of low to high, log-uniform; small problems stay below 16."""
        top = min(high, max(low, 15)) if self.small else high
        return min(top, int(self.decades(low, top + 1)))

    def of(self, *choices: Any) -> Any:
        """Return one of the choices."""
        return choices[int(self.rng.integers(len(choices)))]

    def side(self, dimensions: int = 2) -> int:
        """Return cells along a side, log-uniform."""
        low, high = (SMALL_SIDES if self.small else SIDES)[dimensions]
        longer = LONGER[dimensions] if self.chance(LARGER) and not self.small else 1.0
        return int(self.decades(low, high * longer + 1))

    def shape(self, dimensions: int = 2, *, square: float = 0.3) -> tuple[int, ...]:
        """Return the shape of a grid whose sides differ at most 4-fold; with probability `square` not at all."""
        side = self.side(dimensions)
        if self.chance(square):
            return (side,) * dimensions
        least = SMALL_SIDES[dimensions][0]
        return (side, *(max(least, int(side / self.decades(1, 4))) for _ in range(dimensions - 1)))

    def noise(self, shape: Sequence[int]) -> np.ndarray:
        """Return normal noise."""
        return self.rng.standard_normal(tuple(shape))

    def smooth(self, shape: Sequence[int], width: float) -> np.ndarray:
        """Return noise smoothed over `width` cells, at most 1 in magnitude."""
        field = scipy.ndimage.gaussian_filter(self.noise(shape), [min(width, n / 3) for n in shape], mode="nearest")
        largest = np.abs(field).max()
        return field / largest if largest > 0 else np.ones(shape)

    def load(self, shape: Sequence[int]) -> np.ndarray:
        """Return a right-hand side: constant, noise or smooth, mostly one that lifts."""
        kind = self.of("constant", "noise", "smooth", "spots")
        if kind == "constant":
            return np.full(shape, -1.0)
        if kind == "noise":
            return self.noise(shape) - self.between(0, 0.5)
        if kind == "smooth":
            return self.smooth(shape, self.decades(1, 20)) - self.between(-0.1, 0.3)
        b = np.full(shape, self.decades(1e-3, 1.0))
        b.flat[self.rng.integers(b.size, size=1 + b.size // 200)] = -self.decades(1.0, 1e3)
        return b

    def faces(self, shape: Sequence[int], value: Any) -> dict[str, np.ndarray]:
        """Return arrays of coefficients; `value` takes an array's shape and its axis, 0 for x."""
        made = {}
        for axis, name in enumerate(("face_x", "face_y", "face_z")[: len(shape)]):
            counts = tuple(n + (q == len(shape) - 1 - axis) for q, n in enumerate(shape))
            made[name] = value(counts, axis)
        return made


def framed(inside: np.ndarray) -> np.ndarray:
    """Return cells FLUID where `inside`, AIR elsewhere and all around: x = 0 on the border of a domain."""
    return np.pad(np.where(inside, FLUID, AIR), 1)


@dataclass(frozen=True)
class Pools:
    """Connected unknowns, and which of them no AIR, shift or bound holds."""

    label: np.ndarray  # pool of each unknown
    loose: np.ndarray  # whether a pool's constants are in the null space, by pool
    net: np.ndarray  # sum of b, by pool; 0 where that is rounding
    size: np.ndarray  # sum of |b|, by pool
    cells: np.ndarray  # unknowns, by pool
    below: np.ndarray  # whether one of a pool's lower bounds is finite
    above: np.ndarray  # whether one of its upper bounds is

    @staticmethod
    def of(exact: Exact) -> Pools:
        """Return the pools of a symmetric problem whose off-diagonal entries are <= 0."""
        count, label = scipy.sparse.csgraph.connected_components(exact.matrix != 0, directed=False)
        excess = np.asarray(exact.matrix.sum(axis=1)).ravel()
        tied = excess > 1e-12 * exact.matrix.diagonal()
        net, size = (np.bincount(label, v, count) for v in (exact.b, np.abs(exact.b)))
        return Pools(
            label=label,
            loose=~(np.bincount(label, tied, count) > 0),
            net=np.where(np.abs(net) <= BALANCED * size, 0.0, net),
            size=size,
            cells=np.bincount(label, minlength=count),
            below=np.bincount(label, np.isfinite(exact.lower), count) > 0,
            above=np.bincount(label, np.isfinite(exact.upper), count) > 0,
        )

    @property
    def lost(self) -> np.ndarray:
        """Pools without a solution: constants lower the energy for ever."""
        return self.loose & (((self.net > 0) & ~self.below) | ((self.net < 0) & ~self.above))


def solvable(problem: GridProblem) -> GridProblem:
    """Return the problem with b moved, on the pools that have no solution, by the least that gives them one and a little more."""
    exact = problem.exact()
    pools = Pools.of(exact)
    # a sum of 0 is on the verge of having none: where one bound can take up a sign, b gets some of that sign
    verge = pools.loose & (pools.net == 0) & (pools.below ^ pools.above)
    moved = pools.lost | verge
    taken_up = np.where(pools.below & ~pools.above, 1.0, np.where(pools.above & ~pools.below, -1.0, 0.0))
    shift = np.where(moved, (taken_up * GENTLY * (pools.size + (pools.size == 0)) - pools.net) / pools.cells, 0.0)
    b = np.where(problem.cells == FLUID, problem.b, 0.0)
    b[problem.cells == FLUID] += shift[pools.label]
    return replace(problem, b=b)


def equality(problem: GridProblem) -> GridProblem | None:
    """Return the problem without bounds, None if it has no solution; where b = 0 solves it at once, that of a constant b."""
    b = problem.b if np.any(problem.b[problem.cells == FLUID]) else -np.ones(problem.cells.shape)
    free = replace(problem, b=b, lower=-np.inf, upper=np.inf)
    pools = Pools.of(free.exact())
    return None if pools.lost.any() else free


def changed(problem: GridProblem, seed: int, share: float = 0.01) -> GridProblem:
    """Return the problem with b changed by a share of its norm, smoothly."""
    draw = Draw("changed", seed)
    b = np.broadcast_to(problem.b, problem.cells.shape).astype(np.float64)
    field = draw.smooth(b.shape, 5) * (problem.cells == FLUID)
    exact, largest = problem.exact(), np.linalg.norm(field)
    size = np.linalg.norm(exact.b) or exact.residual(exact.start)
    return solvable(replace(problem, b=b + share * size / (largest if largest > 0 else 1.0) * field))
