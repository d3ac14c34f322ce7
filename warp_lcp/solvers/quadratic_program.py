"""Solve the quadratic program of a symmetric problem by PIQP."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.data_types import Matrix
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Count, Positive, Settings
from warp_lcp.subproblems.dense_problem import (
    SEMIDEFINITE,
    DenseProblem,
    DenseWorkspace,
    check_size,
    inconsistent,
    semidefinite,
    sparse_matrix,
)


@dataclass(frozen=True, kw_only=True)
class QuadraticProgram(Settings):
    """Convex quadratic program by PIQP, a proximal interior-point solver.

    It minimizes x'Ax / 2 + b'x over l <= x <= u ([Book] 2.2.2, eq. 2.56; extra `peers`).

    The minimizers are the solutions of the problem, because A is symmetric and positive
    semi-definite and the gradient is y = A x + b. Sparse operators stay sparse; others are
    converted to dense matrices. x0 is not used. There is one step, and `linear_iterations` counts
    PIQP's iterations, a factorization each. Afterwards unknowns that PIQP's multipliers hold are
    set to their bounds, and y = 0 is solved for the others; that result is used if it is better. An
    objective that is unbounded below is INFEASIBLE: no x solves the problem.

    Args:
        tolerance: PIQP's absolute and relative tolerance, on the equilibrated problem; > 0. The
            loop's criteria are checked on the natural residual, independent of PIQP's status.
        max_iterations: maximum number of iterations of PIQP, >= 1.
    """

    needs: ClassVar[str] = (
        "symmetric, positive semi-definite, n <= 4096 unless sparse; the extra `peers`"
    )
    # a dense n x n float64 array of 134 MB, and its factor; sparse operators have no limit
    most_unknowns: ClassVar[int] = 4096

    tolerance: Positive = 1e-12
    max_iterations: Count = 250

    def init(self, problem: LCP) -> QuadraticProgramWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is not symmetric, not positive semi-definite, or dense and too large.
            ImportError: PIQP is not installed.
        """
        if importlib.util.find_spec("piqp") is None:
            raise ImportError(
                "QuadraticProgram needs PIQP: pip install 'warp-lcp[peers]' (or pip install piqp)"
            )
        if not problem.A.symmetric:
            raise ValueError(
                "A is not symmetric: QuadraticProgram needs it to be; otherwise y = A x + b is not "
                "the gradient of a quadratic function"
            )
        if sparse_matrix(problem) is None:
            check_size(problem, "QuadraticProgram", self.most_unknowns)
        work = QuadraticProgramWorkspace(problem)
        work.check_definite()
        return work

    def step(self, problem: LCP, work: QuadraticProgramWorkspace, x: DeviceArray) -> Step:
        """Solve the whole quadratic program."""
        return work.result("quadratic program", work.minimize(self.tolerance, self.max_iterations))


class QuadraticProgramWorkspace(DenseWorkspace):
    """Workspace of the method: the problem in PIQP's form."""

    def read(self) -> DenseProblem:
        """Read the problem; a sparse A stays sparse."""
        return DenseProblem.read(self.problem, keep_sparse=True)

    def check_definite(self) -> None:
        """Factorize A, slightly shifted.

        Raises:
            ValueError: A is not positive semi-definite.
        """
        if not is_convex_program(self.problem):
            raise ValueError(
                "A is not positive semi-definite: QuadraticProgram needs a convex objective; Lemke "
                "does not"
            )

    def minimize(self, tolerance: float, max_iterations: int) -> int:
        """Run PIQP; return its number of iterations.

        It solves the equilibrated problem. Where the distance to a bound is less than its
        multiplier, x is set on the bound, and y = 0 is solved for in the other rows; the better of
        both x is the iterate.
        """
        import piqp  # an extra

        data, (scaled, units) = self.data, self.data.scaled()
        sparse = scipy.sparse.issparse(data.A)
        solver = piqp.SparseSolver() if sparse else piqp.DenseSolver()
        solver.settings.eps_abs = solver.settings.eps_rel = tolerance
        # Bounds hold to the square root of the gap's tolerance.
        solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = tolerance**1.1
        solver.settings.max_iter = max_iterations
        A = scipy.sparse.csc_matrix(scaled.A) if sparse else np.asfortranarray(scaled.A)
        solver.setup(A, scaled.b, x_l=scaled.lower, x_u=scaled.upper)
        status = solver.solve()
        iterations, x = int(solver.result.info.iter), np.asarray(solver.result.x)
        solved = status == piqp.PIQP_SOLVED
        # PIQP often follows an unbounded direction to its iteration limit without reporting it: a
        # linear program decides.
        if not solved and len(data.b) <= QuadraticProgram.most_unknowns and inconsistent(data):
            self.ended = SolveStatus.INFEASIBLE
            return iterations
        if np.isfinite(x).all():
            low, high = (
                x - scaled.lower < np.asarray(solver.result.z_bl),
                scaled.upper - x < np.asarray(solver.result.z_bu),
            )
            x = np.clip(units * x, data.lower, data.upper)
            settled = data.polished(
                np.where(low, data.lower, np.where(high, data.upper, x)), ~(low | high)
            )
            self.write_iterate(min((x, settled), key=data.residual))
        self.ended = (
            SolveStatus.STAGNATED
            if solved or iterations < max_iterations
            else SolveStatus.MAX_ITERATIONS
        )
        return iterations


def is_convex_program(problem: LCP) -> bool:
    """Return whether the matrix of a symmetric problem is positive semi-definite."""
    return is_convex(DenseProblem.read(problem, keep_sparse=True).scaled()[0].A)


def is_convex(A: Matrix) -> bool:
    """Return whether a symmetric matrix is positive semi-definite.

    Its entries are near 1; it may be dense or sparse. The factors of the slightly shifted matrix
    decide.
    """
    if not scipy.sparse.issparse(A):
        return semidefinite(A)
    shifted = (A + SEMIDEFINITE * scipy.sparse.eye_array(A.shape[0])).tocsc()
    settings = {
        "permc_spec": "MMD_AT_PLUS_A",
        "diag_pivot_thresh": 0.0,
        "options": {"SymmetricMode": True},
    }
    try:  # without row exchanges the signs of U's diagonal are A's inertia
        return bool((scipy.sparse.linalg.splu(shifted, **settings).U.diagonal() > 0).all())
    except RuntimeError:
        return False
