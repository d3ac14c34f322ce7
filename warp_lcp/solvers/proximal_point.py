"""The proximal-point iteration: what active-set methods go on with where a free block is singular and their own steps lead nowhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem import LCP
from warp_lcp.residual import NaturalResidual
from warp_lcp.result import SolveStatus
from warp_lcp.solve import EPS, FLOOR_MARGIN, Step
from warp_lcp.solvers.dense_problem import proved_infeasible

FIRST, FACTOR, LEAST = 1e-4, 0.1, 1e-10  # eps of the first center, its factor from center to center, and the smallest
RAISED, LARGEST = 100.0, 1.0  # factor of eps where a regularized problem is not solved, and the largest eps: larger ones are easier
NEAR = 1e-3  # of a center's residual: what the regularized problem's may be when the next center is taken
MOST, FEWER = 30, 15  # steps for one center, before and after eps had to be raised
SMALL = 1000  # unknowns up to which a sparse matrix is taken as a dense one, for which least-index pivoting is there
FALL = 0.9  # a center whose residual is above this part of the smallest so far is no progress
IDLE = 4  # centers without progress before the end


class ProximalPoint:
    """Solve A x + b + eps D (x - c) = y with the same bounds, take x for the center c, lower eps, repeat (Martinet 1970, Rockafellar 1976).

    D is the natural residual's d. A + eps D is a P-matrix wherever A is a
    P0-matrix (positive semi-definite ones, skew ones), so that free blocks are regular and least-index pivoting is finite. Its solutions
    tend to one of the problem's own if A is monotone and there is one. The regularized problems are solved by PrimalDualActiveSet; where
    it fails, eps is raised, and does not fall again. Failure with eps = 1 ends the iteration with NON_DESCENT.

    Made for a singular block here and there. Linear programs (A skew) of more than some dozens of unknowns come to residuals of 1e-2 or end
    with NON_DESCENT: they are InteriorPoint's.

    Args:
        problem: with a dense or sparse operator.
        residual: the problem's own.
        tolerance: the norm of it that is asked for.
    """

    def __init__(self, problem: LCP, residual: NaturalResidual, tolerance: float) -> None:
        from warp_lcp.solvers.primal_dual_active_set import PrimalDualActiveSet  # whose own last resort this is

        self._problem, self._residual, self._tolerance = problem, residual, tolerance
        A = problem.A
        self._matrix: Any = A.matrix() if isinstance(A, SparseOperator) else A.matrix.numpy().astype(np.float64)  # type: ignore[attr-defined]
        self._D = A.scale()  # type: ignore[attr-defined]
        self._b, self._eps = problem.b.numpy(), FIRST
        if scipy.sparse.issparse(self._matrix) and A.unknowns <= SMALL:  # type: ignore[attr-defined]
            self._matrix = self._matrix.toarray()
        made: Any = SparseOperator if scipy.sparse.issparse(self._matrix) else DenseOperator
        operator = made(self._regularized(), device=problem.device, dtype=wp.float64)
        self._inner = LCP(operator, self._b, problem.lower.numpy(), problem.upper.numpy())
        self._method = PrimalDualActiveSet(precision="double")
        self._work = self._method.init(self._inner)
        self._work.last_resort = False
        self._work.floating = None
        self._smallest, self._idle, self._steps, self._near, self._least = residual.norm, 0, 0, 0.0, LEAST

    @staticmethod
    def suits(problem: LCP) -> bool:
        """Return whether the iteration can be had: A + eps D must be assembled."""
        return isinstance(problem.A, (DenseOperator, SparseOperator))

    def step(self, x: wp.array[Any]) -> Step:
        """Take one step for the regularized problem, from a new center if the last one's has been solved."""
        if self._steps == 0:
            self._take_center(x)
        work, self._steps = self._work, self._steps + 1
        work.residual.evaluate(x)
        work.residual.current = False
        step = self._method.step(self._inner, work, x)
        if not work.residual.current:
            work.residual.evaluate(x)
        failure = None
        if work.residual.norm <= self._near or step.failure is not None or self._steps >= (MOST if self._least == LEAST else FEWER):
            failure = self._assess(x)
        self._residual.current = False
        return Step("proximal point", step.linear_iterations, step.active, failure, interim=failure is None)

    def _take_center(self, x: wp.array[Any]) -> None:
        """Write the regularized problem around clip(x, l, u)."""
        inner = self._inner
        center = np.clip(x.numpy(), inner.lower.numpy(), inner.upper.numpy())
        x.assign(center)
        operator: Any = inner.A
        if isinstance(operator, SparseOperator):
            operator.update(self._regularized())
        else:
            operator.matrix.assign(self._regularized())
        inner.b.assign(self._b - self._eps * self._D * center)
        self._center = center
        size = self._residual.evaluate(x)
        self._near = max(NEAR * size, 0.3 * self._tolerance)
        self._work.start(warm=True, tolerance=self._near)

    def _assess(self, x: wp.array[Any]) -> SolveStatus | None:
        """Prepare for the next center; return how the iteration ends if it has come no nearer to a solution for some."""
        solved, self._steps = self._work.residual.norm <= self._near, 0
        x.assign(np.clip(x.numpy(), self._inner.lower.numpy(), self._inner.upper.numpy()))
        norm = self._residual.evaluate(x)
        if norm <= FALL * self._smallest:
            self._smallest, self._idle, self._eps = norm, 0, max(self._least, FACTOR * self._eps)
            return None
        if not solved and self._eps < LARGEST:
            if self._least == LEAST and proved_infeasible(self._problem):
                return SolveStatus.INFEASIBLE
            self._eps = self._least = min(LARGEST, RAISED * self._eps)
            x.assign(self._center)
            return None
        self._eps, self._idle = max(self._least, FACTOR * self._eps), self._idle + 1
        if solved and self._idle < IDLE:
            return None
        floor = FLOOR_MARGIN * self._residual.rounding_floor(x, EPS)
        if norm > floor and proved_infeasible(self._problem):
            return SolveStatus.INFEASIBLE
        return SolveStatus.STAGNATED if solved else SolveStatus.NON_DESCENT

    def _regularized(self) -> Any:
        """Return A + eps D."""
        if not scipy.sparse.issparse(self._matrix):
            return self._matrix + np.diag(self._eps * self._D)
        return scipy.sparse.csr_array(self._matrix + scipy.sparse.diags_array(self._eps * self._D))
