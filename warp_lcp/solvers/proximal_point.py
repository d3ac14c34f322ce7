"""Proximal-point method: regularized problems around moving centers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.data_types import Matrix, is_sparse
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.method_protocol import (
    Solver,
    Step,
    Workspace,
    WorkspaceBase,
    evaluate_unless_current,
    method_step,
)
from warp_lcp.problem.operator_protocol import HasRows, HasScale, check_taken, has
from warp_lcp.problem.residual import EPS
from warp_lcp.problem.residual_scaling import scale_of_matrix
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.solve_loop import FLOOR_MARGIN
from warp_lcp.settings import Settings
from warp_lcp.solvers.fallback import Fallback, fails
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.primal_dual_active_set import PrimalDualActiveSet
from warp_lcp.subproblems.dense_problem import proved_infeasible

# eps of the first center, its factor from center to center, and the smallest eps.
CENTER, FACTOR, LEAST = 1e-4, 0.1, 1e-10
# Factor of eps where a regularized problem is not solved, and the largest eps; problems with larger
# eps are easier.
RAISED, LARGEST = 100.0, 1.0
# Part of a center's residual that the regularized problem's must reach before the next center.
NEAR = 1e-3
TRIED, FEWER = 30, 15  # steps for one center, before and after eps had to be raised
# Unknowns up to which a sparse matrix is treated as dense, so that least-index pivoting can be
# used.
SMALL = 1000
FALL = 0.9  # a center whose residual is above this part of the smallest so far is no progress
IDLE = 4  # centers without progress before the end


@dataclass(frozen=True, kw_only=True)
class ProximalPoint(Settings):
    """Proximal-point method: solve regularized problems around moving centers.

    (Martinet 1970, Rockafellar 1976.) Solve A x + b + eps D (x - c) = y with the same bounds, use
    clip(x, l, u) as the next center c, lower eps, repeat. D is the natural residual's d. A + eps D
    is a P-matrix wherever A is a P0-matrix (for example a positive semi-definite or a skew one), so
    that free blocks are regular and least-index pivoting is finite. The solutions tend to one of
    the problem if A is monotone and a solution exists.

    An inner method solves each regularized problem to 1e-3 of the residual at its center. If it
    fails, eps is raised, and does not fall below that value again. The solve ends with NON_DESCENT
    if it fails at eps = 1, with STAGNATED if the centers make no progress, and with INFEASIBLE if a
    linear program (at most 40,000 entries) proves it. A step is one of the inner method;
    `linear_iterations` counts as there.

    The method is meant for problems with a few singular blocks. Linear programs (A skew) of more
    than some dozens of unknowns reach residuals of 1e-2 or end with NON_DESCENT: use InteriorPoint
    for them.

    Args:
        inner: method for regularized problems; None: PrimalDualActiveSet; on sparse matrices of
            more than 1000 unknowns MinimumMapNewton follows where a set recurs.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.array([[0.0, 1.0], [-1.0, 0.0]]), device="cpu")
        >>> result = wl.solve(wl.LCP(A, np.array([-1.0, 1.0])), wl.ProximalPoint())
        >>> print(result.status.name, result.x.numpy().round(4))
        CONVERGED [1. 1.]
    """

    supports: ClassVar = (HasRows,)
    needs: ClassVar[str] = "P0-matrix, as positive semi-definite and skew ones"
    definite: ClassVar[bool] = True

    inner: Solver | None = None

    def init(self, problem: LCP) -> ProximalWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A gives no access to rows.
        """
        check_taken(self, problem.A)
        return ProximalWorkspace(problem, self.inner)

    def step(self, problem: LCP, work: ProximalWorkspace, x: DeviceArray) -> Step:
        """Take one step of the inner method, from a new center if one is due."""
        return work.step(x)


class ProximalWorkspace(WorkspaceBase):
    """Workspace of the method for one problem; A is read when a solve begins."""

    def __init__(self, problem: LCP, inner: Solver | None) -> None:
        super().__init__(problem)
        self._user_method = inner

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the current A, b and bounds."""
        p, self._tolerance, self._eps = self.problem, tolerance, CENTER
        A = p.A
        assert has(A, HasRows)
        self._matrix, self._b = A.rows().matrix(), p.b.numpy().copy()
        known = A.scale() if has(A, HasScale) else None
        self._D: np.ndarray = scale_of_matrix(self._matrix) if known is None else known
        if is_sparse(self._matrix) and len(self._D) <= SMALL:
            self._matrix = self._matrix.toarray()
        operator = as_operator(self._regularized(), p.device)
        assert isinstance(operator, (DenseOperator, SparseOperator)), "it is a matrix"
        self._operator = operator
        self._lower, self._upper = p.lower.numpy().copy(), p.upper.numpy().copy()
        self._inner = LCP(self._operator, self._b, self._lower, self._upper)
        self._method = self._user_method or _inner_method(is_sparse(self._matrix))
        self._work: Workspace = self._method.init(self._inner)
        self._smallest, self._idle, self._steps, self._near, self._least = (
            self.residual.norm,
            0,
            0,
            0.0,
            LEAST,
        )

    def step(self, x: DeviceArray) -> Step:
        """Take one step for the regularized problem."""
        work, failure = self._work, None
        if self._steps == 0:
            self._take_center(x)
        self._steps += 1
        done = method_step(self._method, self._inner, work)
        evaluate_unless_current(work)
        wp.copy(x, work.x)
        near = work.residual.norm <= self._near
        if (
            near
            or done.failure is not None
            or self._steps >= (TRIED if self._least == LEAST else FEWER)
        ):
            failure = self._assess(x, solved=near)
        self.residual.invalidate()
        return Step(
            "proximal point", done.linear_iterations, done.active, failure, interim=failure is None
        )

    def _take_center(self, x: DeviceArray) -> None:
        """Write the regularized problem around c = clip(x, l, u), and begin there.

        Its matrix is A + eps D, its vector b - eps D c.
        """
        inner, work = self._inner, self._work
        center = np.clip(x.numpy(), self._lower, self._upper)
        x.assign(center)
        self._operator.update(self._regularized())
        inner.b.assign(self._b - self._eps * self._D * center)
        self._center = center
        self._near = max(NEAR * self.residual.evaluate(x), 0.3 * self._tolerance)
        work.x.assign(center)
        work.residual.evaluate(work.x)
        work.keep()
        work.start(warm=True, tolerance=self._near)

    def _assess(self, x: DeviceArray, *, solved: bool) -> SolveStatus | None:
        """Prepare for the next center; return the status if the solve ends.

        It ends if IDLE centers have made no progress, or eps cannot be raised further.

        The center is clip(x, l, u). If the regularized problem is not solved and the residual
        exceeds FALL times the smallest so far, x returns to the last center and eps, with its least
        value, becomes min(LARGEST, RAISED eps). Otherwise eps <- max(least, FACTOR eps).
        """
        self._steps = 0
        x.assign(np.clip(x.numpy(), self._lower, self._upper))
        norm = self.residual.evaluate(x)
        if norm <= FALL * self._smallest:
            self._smallest, self._idle, self._eps = norm, 0, max(self._least, FACTOR * self._eps)
            return None
        if not solved and self._eps < LARGEST:
            if self._least == LEAST and proved_infeasible(self.problem):
                return SolveStatus.INFEASIBLE
            self._eps = self._least = min(LARGEST, RAISED * self._eps)
            x.assign(self._center)
            return None
        self._eps, self._idle = max(self._least, FACTOR * self._eps), self._idle + 1
        if solved and self._idle < IDLE:
            return None
        floor = FLOOR_MARGIN * self.residual.rounding_floor(x, EPS)
        if norm > floor and proved_infeasible(self.problem):
            return SolveStatus.INFEASIBLE
        return SolveStatus.STAGNATED if solved else SolveStatus.NON_DESCENT

    def _regularized(self) -> Matrix:
        """Return A + eps D."""
        if not is_sparse(self._matrix):
            return self._matrix + np.diag(self._eps * self._D)
        entries, i = self._matrix.tocoo(), np.arange(len(self._D))
        places = np.r_[entries.row, i], np.r_[entries.col, i]
        # Duplicates are summed and sums of 0 stay entries, so that the pattern is the same for all
        # eps.
        return scipy.sparse.csr_array(
            (np.r_[entries.data, self._eps * self._D], places), shape=self._matrix.shape
        )


@cache
def _inner_method(sparse: bool) -> Solver:
    """Return the default method for regularized problems.

    Their matrices are P-matrices wherever A is a P0-matrix.
    """
    pivoting = PrimalDualActiveSet(precision="double", stop_if_singular=False)
    return Fallback(pivoting, (MinimumMapNewton(precision="double"), fails)) if sparse else pivoting
