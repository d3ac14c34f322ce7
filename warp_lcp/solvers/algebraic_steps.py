"""Newton's steps on a grid's matrix, whose aggregates follow its coefficients, for domains on which aggregates of whole blocks fail.

Channels and walls a cell wide, spirals and mazes, share blocks that are not joined inside; so do cells whose coefficients are random
over many decades. Cycles of a geometric hierarchy are slow there, without bounds too.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem import LCP
from warp_lcp.solve import EPS, Step

if TYPE_CHECKING:
    from warp_lcp.operators.grid_poisson import GridPoisson

WINDOW = 10  # steps over which the residual's fall is measured
FIRST = 20  # steps before which nothing is concluded: residuals of conjugate gradients rise and fall
MOST = 30  # steps that a solve may still need at that pace: assembly and set-up cost about as much


class Pace:
    """How fast the least residual of a solve falls.

    Args:
        tolerance: the residual norm that is asked for.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance, self._least = tolerance, list[float]()

    def record(self, norm: float) -> None:
        """Take note of the residual before a step."""
        self._least.append(min(self._least[-1], norm) if self._least else norm)

    @property
    def crawls(self) -> bool:
        """Whether the tolerance, or what float64 can tell from 0, is more than MOST steps away at the pace of the last ones."""
        if len(self._least) <= FIRST:
            return False
        least, target = self._least[-1], max(self._tolerance, EPS * self._least[0])
        return least > target and math.log(least / target) > MOST / WINDOW * math.log(self._least[-1 - WINDOW] / least)


class AlgebraicSteps:
    """Steps of MinimumMapNewton on the matrix of a grid, in double precision.

    Args:
        problem: a grid's, in one process.
        A: its operator.
        x: the iterate, stored, to begin with.
        tolerance: the residual norm that is asked for.
    """

    def __init__(self, problem: LCP, A: GridPoisson, x: wp.array[Any], tolerance: float) -> None:
        from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton  # which needs the module that needs this one

        self._rows = np.flatnonzero(problem.unknown.numpy() == 1)
        b, lower, upper, start = (field.numpy()[self._rows] for field in (problem.b, problem.lower, problem.upper, x))
        matrix = SparseOperator(grid_matrix(A), device=problem.device, dtype=wp.float64)
        self._problem, self._method = LCP(matrix, b, lower, upper), MinimumMapNewton(precision="double")
        work = self._work = self._method.init(self._problem)
        work.x.assign(start)
        work.residual.evaluate(work.x)
        work.start(warm=False, tolerance=tolerance)

    def step(self, x: wp.array[Any]) -> Step:
        """Take a step, and write the iterate to x."""
        work = self._work
        work.residual.current = False
        done = self._method.step(self._problem, work, work.x)
        if not work.residual.current:
            work.residual.evaluate(work.x)
        stored = x.numpy()
        stored[self._rows] = work.x.numpy()
        x.assign(stored)
        return done
