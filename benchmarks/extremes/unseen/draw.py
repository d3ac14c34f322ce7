"""Random choices for problems, and random problems that have a solution."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import scipy.ndimage

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.problem import GridProblem, Problem, solvable

AIR, FLUID, SOLID = wl.AIR, wl.FLUID, wl.SOLID
SIDES = {2: (30, 300), 3: (12, 48)}  # cells along a side, by dimensions
SMALL_SIDES = {2: (3, 14), 3: (2, 6)}  # sizes that every method can solve
# Share of grids with longer sides, and the largest factor of a side.
LARGER, LONGER = 0.03, {2: 2.0, 3: 1.4}


@dataclass(frozen=True)
class SeededProblem:
    """Problem of a kind and a seed, with an optional changed problem."""

    problem: Problem  # the problem to solve
    # Slightly changed problem, to be solved from the solution of `problem`; None if there is none.
    then: GridProblem | None = None
    allowance: float = 1.0  # factor of the allowed iterations


ChoiceT = TypeVar("ChoiceT")


class SeededGenerator:
    """Random generator of a kind and a seed, with common choices.

    Args:
        kind: kind of the problem.
        seed: seed of the problem.
        small: draw sizes small enough for every method.
    """

    def __init__(self, kind: str, seed: int, *, small: bool = False) -> None:
        self.rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])
        self.seed, self.small = seed, small

    def chance(self, p: float) -> bool:
        """Return True with probability p."""
        return bool(self.rng.random() < p)

    def between(self, low: float, high: float) -> float:
        """Return a uniform number."""
        return float(self.rng.uniform(low, high))

    def decades(self, low: float, high: float) -> float:
        """Return a log-uniform number."""
        return math.exp(self.between(math.log(low), math.log(high)))

    def whole(self, low: int, high: int) -> int:
        """Return a log-uniform integer of low to high; small problems stay below 16."""
        top = min(high, max(low, 15)) if self.small else high
        return min(top, int(self.decades(low, top + 1)))

    def of(self, *choices: ChoiceT) -> ChoiceT:
        """Return one of the choices."""
        return choices[int(self.rng.integers(len(choices)))]

    def side(self, dimensions: int = 2) -> int:
        """Return a log-uniform number of cells along a side."""
        low, high = (SMALL_SIDES if self.small else SIDES)[dimensions]
        longer = LONGER[dimensions] if self.chance(LARGER) and not self.small else 1.0
        return int(self.decades(low, high * longer + 1))

    def shape(self, dimensions: int = 2, *, square: float = 0.3) -> tuple[int, ...]:
        """Return the shape of a grid whose sides differ at most 4-fold.

        With probability `square` all sides are equal.
        """
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
        field = scipy.ndimage.gaussian_filter(
            self.noise(shape), [min(width, n / 3) for n in shape], mode="nearest"
        )
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


def framed(inside: np.ndarray) -> np.ndarray:
    """Return FLUID where `inside`, and AIR elsewhere and around.

    So x = 0 on the border of the domain.
    """
    return np.pad(np.where(inside, FLUID, AIR), 1)


def changed(problem: GridProblem, seed: int, share: float = 0.01) -> GridProblem:
    """Return the problem with b changed smoothly by a share of its norm."""
    draw = SeededGenerator("changed", seed)
    b = np.broadcast_to(problem.b, problem.cells.shape).astype(np.float64)
    field = draw.smooth(b.shape, 5) * (problem.cells == FLUID)
    exact, largest = problem.exact(), np.linalg.norm(field)
    size = np.linalg.norm(exact.b) or exact.residual(exact.start)
    return solvable(
        replace(problem, b=b + share * size / (largest if largest > 0 else 1.0) * field)
    )
