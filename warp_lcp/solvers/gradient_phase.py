"""Steps of MPRGP inside another method: what Newton's method goes on with where its linear solves are slow."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_lcp.problem import LCP
from warp_lcp.solve import Step
from warp_lcp.solvers.mprgp import MPRGP, GradientWorkspace
from warp_lcp.solvers.principal_system_sparse import SparseSystem
from warp_lcp.stopping import StoppingCriteria

PATIENCE = StoppingCriteria().patience  # iterations that neither lower the energy nor the residual before the end


class GradientPhase:
    """Minimizes the energy by conjugate gradients that know the bounds, a batch a step.

    Newton's method solves a linear system for each set that it tries, and its safeguard is a residual that says little where A is badly
    conditioned: a plate's rises by a factor of 1000 on the way. MPRGP as a whole costs about as much as one or two such linear solves.

    Args:
        problem: with a symmetric sparse operator whose diagonal is not negative.
        system: the preconditioner's.
        precision: as MPRGP takes it.
    """

    def __init__(self, problem: LCP, system: SparseSystem, precision: str) -> None:
        self._method = MPRGP(precision=precision)
        self._work = GradientWorkspace(problem, self._method, system)

    def start(self, x: wp.array[Any], floating: Any, tolerance: float) -> None:
        """Begin at x."""
        work, self._tolerance = self._work, tolerance
        work.floating = floating
        work.residual.start(work.x, keep=False)
        wp.copy(work.x, x)
        work.residual.evaluate(work.x)
        work.start(warm=True, tolerance=tolerance)

    def step(self, x: wp.array[Any], factor: float, most: int) -> Step | None:
        """Iterate until the residual is `factor` times what it was, at most so often; move x there.

        Returns:
            None: the energy has no minimum, or neither it nor the residual falls any more.
        """
        work, residual, linear, idle, sank = self._work, self._work.residual, 0, 0, False
        least, target = residual.norm, max(self._tolerance, factor * residual.norm)
        while linear < most and idle < PATIENCE and residual.norm > target:
            step = self._method.step(work.problem, work, work.x)
            if step.failure is not None:
                return None
            linear += step.linear_iterations
            idle = 0 if step.interim or residual.norm < least else idle + 1
            least, sank = min(least, residual.norm), sank or step.interim
        wp.copy(x, work.x)
        if idle == PATIENCE:
            return None
        return Step("conjugate gradients", linear, residual.active, interim=sank)
