"""Interior-point steps in place of an active-set method's own: what unsymmetric problems go on with before the proximal-point iteration."""

from __future__ import annotations

import math
from typing import Any

import warp as wp

from warp_lcp.problem import LCP
from warp_lcp.residual import NaturalResidual
from warp_lcp.result import SolveStatus
from warp_lcp.solve import Step
from warp_lcp.solvers.phases import ProximalPoint

FALL = 0.9  # a residual above this part of the smallest so far is no progress
IDLE = 10  # steps without progress before the proximal-point iteration: a path is joined far from the start


class InteriorSteps:
    """Follow the central path from its own start; where that leads nowhere, iterate by ProximalPoint from where the method was.

    Linear programs and other saddle points, A skew but for a block or a small shift, have free blocks that are singular or nearly so
    on the way to the solution's own. The central path exists for every positive semi-definite A, and asks for none.

    Args:
        problem: with a dense or sparse operator.
        residual: the problem's own.
        tolerance: the norm of it that is asked for.
    """

    def __init__(self, problem: LCP, residual: NaturalResidual, tolerance: float) -> None:
        from warp_lcp.solvers.interior_point import InteriorPoint  # which knows the active-set methods

        self._problem, self._residual, self._tolerance = problem, residual, tolerance
        self._method = InteriorPoint(precision="double")
        self._work = work = self._method.init(problem)
        work.residual.start(work.x, keep=False)
        work.residual.evaluate(work.x)
        work.start(warm=False, tolerance=tolerance)
        self._smallest, self._idle = math.inf, 0
        self._begun: wp.array[Any] | None = None
        self._next: ProximalPoint | None = None

    def step(self, x: wp.array[Any]) -> Step:
        """Take one step."""
        if self._next is not None:
            return self._next.step(x)
        if self._begun is None:
            self._begun = wp.clone(x)
        step = self._method.step(self._problem, self._work, self._work.x)
        if step.failure is SolveStatus.INFEASIBLE:
            return step
        norm = self._work.residual.norm
        self._idle = 0 if norm <= FALL * self._smallest else self._idle + 1
        self._smallest = min(norm, self._smallest)
        over = step.failure is not None or self._idle >= IDLE
        wp.copy(x, self._begun if over else self._work.x)
        if over:
            self._residual.evaluate(x)
            self._next = ProximalPoint(self._problem, self._residual, self._tolerance)
        self._residual.current = False
        return Step("interior point", step.linear_iterations, interim=True)
