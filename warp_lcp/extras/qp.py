"""Convex quadratic programs for qpsolvers (extra `qpsolvers`).

`register()` adds the solver "warp_lcp" to those of that package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse

from warp_lcp.kernels.fields import real_array
from warp_lcp.linear_complementarity import STATUSES, linear_complementarity
from warp_lcp.problem.bounds import huge_as_infinite
from warp_lcp.problem.data_types import Matrix, Values, is_sparse
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.program_optimality import (
    PROVABLE,
    ProgramPoint,
    ProgramUnits,
    ProgramWithRows,
    equilibrated,
    has_no_solution,
    polished,
    relative_residuals,
    settled,
    with_rows,
)
from warp_lcp.problem.reformulate import QuadraticProgramData, quadratic_program_to_boxed
from warp_lcp.problem.result import SolveStatus
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.quadratic_program import is_convex_program

if TYPE_CHECKING:
    from qpsolvers import Problem, Solution
    from scipy.optimize import OptimizeResult

NAME = "warp_lcp"
LOOSER = 10.0  # times tol: limit of each row's residual; methods meet tol in the norm of all rows
LEAST = 1e-12  # least tolerance of a row: rounding errors
WORDS = {
    "infeasible": "no x meets the constraints",
    "unbounded": "the objective is unbounded below",
}


def register() -> None:
    """Register the solver "warp_lcp" with `qpsolvers.solve_qp`.

    It then calls `solve_problem`, for dense and for sparse matrices.

    Raises:
        ImportError: qpsolvers is not installed.
    """
    try:
        import qpsolvers.solvers as there
    except ImportError as missing:
        raise ImportError(
            "warp_lcp.extras.qp needs qpsolvers: pip install 'warp-lcp[qpsolvers]' (or pip install "
            "qpsolvers)"
        ) from missing
    there.solve_function[NAME] = solve_problem
    for names in (there.available_solvers, there.dense_solvers, there.sparse_solvers):
        if NAME not in names:
            names.append(NAME)


def solve_problem(
    problem: Problem,
    initvals: Values | None = None,
    verbose: bool = False,
    *,
    method: str | Solver | None = None,
    tol: float = 1e-9,
    maxiter: int = 500,
) -> Solution:
    """Minimize x'Px / 2 + q'x subject to G x <= h, A x = b, lb <= x <= ub.

    P must be symmetric positive semi-definite.

    A program with nothing but a box is the boxed LCP of P and q ([Book] eq. 1.58); others are
    equilibrated and solved by the boxed LCP of their first-order conditions, in x and the
    multipliers (`quadratic_program_to_boxed`). Magnitudes of 1e20 and more in h, lb and ub are
    infinite.

    Args:
        problem: of qpsolvers; only the symmetric part of P is used.
        initvals: a guess of x, shape (n,).
        verbose: print how the solve ended.
        method: of `linear_complementarity`. None: its default for a box; with other
            constraints, or if that fails, InteriorPoint, then Lemke.
        tol: relative tolerance, in [0, 1), of the natural residual; the solution has primal and
            dual residuals below 10 tol in every row, relative to the terms of that row, and such a
            duality gap, relative to its terms.
        maxiter: maximum number of iterations of a method.

    Returns:
        x with the multipliers y, z and z_box in qpsolvers' signs, and `found` where residuals and
        gap, recomputed in float64 in all rows, meet the tolerance; else `found` is False and they
        are None. `extras["result"]` is the last result of `linear_complementarity`, with success,
        status and message of the program; "primal_residual", "dual_residual" and "duality_gap" are
        those relative figures.

    Raises:
        ValueError: the program is not convex, an argument is of another kind or shape, or a bound
            is NaN, crossed or on the wrong side of all numbers.
    """
    from qpsolvers import Solution

    program, bounding = _read(problem)
    _check_convex(program.Q, program.c)
    x0 = None if initvals is None else _vector(initvals, "initvals", len(program.c))
    solve = _Solve(program, method, tol, maxiter, x0)
    if program.h is not None and np.isposinf(program.h).any():
        rows = np.flatnonzero(bounding)[np.isposinf(program.h)]
        solve.end(SolveStatus.INFEASIBLE, f"h[{rows[0]}] is -infinity, which no x meets")
    else:
        solve.run()
    result = solve.result
    if verbose:
        print(f"{NAME}: {result.message} ({result.nit} iterations)")
    figures = dict(
        zip(("primal_residual", "dual_residual", "duality_gap"), solve.figures, strict=True)
    )
    solution = Solution(
        problem, extras={"result": result, **figures}, found=solve.point is not None
    )
    if solve.point is not None:
        _write(solution, program, solve.point, bounding)
    return solution


class _Solve:
    """Try methods in order until the point of one is optimal.

    Attributes:
        point: the optimal point in the program's units; None before it is found.
        result: of the last method.
        figures: relative primal residual, dual residual and gap of the last point.
    """

    def __init__(
        self,
        program: QuadraticProgramData,
        method: str | Solver | None,
        tol: float,
        maxiter: int,
        x0: np.ndarray | None,
    ) -> None:
        self.program, self.method, self.tol, self.maxiter, self.x0 = (
            program,
            method,
            tol,
            maxiter,
            x0,
        )
        self.point: ProgramPoint | None = None
        self.figures = (np.inf, np.inf, np.inf)
        self.result: OptimizeResult = None

    def run(self) -> None:
        """Solve a box directly; else, or if that fails, the optimality conditions."""
        p = self.program
        if p.h is None and p.d is None:
            self._box()
            if self.point is not None or self.method is not None:
                return
        self._scaled, self._units = equilibrated(with_rows(p))
        self._conditions = quadratic_program_to_boxed(self._scaled, device="cpu")
        self._by(InteriorPoint() if self.method is None else self.method)
        if self.point is not None or self.method is not None:
            return
        if sum(map(_entries, (self._scaled.Q, self._scaled.G, self._scaled.C))) <= PROVABLE and (
            why := has_no_solution(self._scaled)
        ):
            self.end(SolveStatus.INFEASIBLE, WORDS[why])
        elif len(self._conditions.b) <= Lemke.most_unknowns:
            self._by(Lemke())
            # a ray is no certificate
            if self.point is None and self.result.status == STATUSES[SolveStatus.INFEASIBLE]:
                self.end(
                    SolveStatus.STAGNATED,
                    "no method solves the conditions, and no certificate shows that none could",
                )

    def end(self, status: SolveStatus, message: str) -> None:
        """Record the status and the message of the program."""
        message = f"{status.name}: {message}"
        if self.result is None:
            from scipy.optimize import OptimizeResult

            self.result = OptimizeResult(nit=0)
        self.result.update(
            success=status is SolveStatus.CONVERGED, status=STATUSES[status], message=message
        )

    def _box(self) -> None:
        """Solve the boxed LCP of P and q in the caller's units."""
        p = self.program
        self.result = result = linear_complementarity(
            p.Q,
            p.c,
            bounds=(p.lower, p.upper),
            x0=self.x0,
            method=self.method,
            tol=self.tol,
            maxiter=self.maxiter,
        )
        x = np.where(
            result.active_mask < 0, p.lower, np.where(result.active_mask > 0, p.upper, result.x)
        )
        self._judge(with_rows(p), ProgramPoint(x, np.zeros(0), np.zeros(0)), None)

    def _by(self, method: str | Solver) -> None:
        """Solve the equilibrated optimality conditions by a method."""
        p, units, conditions = self._scaled, self._units, self._conditions
        n, m = len(p.c), len(p.h)
        x0 = None if self.x0 is None else np.r_[self.x0 / units.x, np.zeros(len(conditions.b) - n)]
        self.result = result = linear_complementarity(
            conditions.A,
            conditions.b,
            bounds=(conditions.lower, conditions.upper),
            x0=x0,
            method=method,
            tol=self.tol,
            maxiter=self.maxiter,
        )
        point = ProgramPoint(result.x[:n], result.x[n : n + m], result.x[n + m :])
        if not np.isfinite(result.x).all():
            return
        self._judge(
            p,
            polished(p, point) if result.success or self.method is None else settled(p, point),
            units,
        )

    def _judge(self, p: ProgramWithRows, point: ProgramPoint, units: ProgramUnits | None) -> None:
        """Accept a point that is optimal, or record that it is not."""
        self.figures = relative_residuals(p, point)
        found = point if units is None else units.of_caller(point)
        if max(self.figures) <= max(LOOSER * self.tol, LEAST) and found.is_finite:
            self.point = found
            self.end(SolveStatus.CONVERGED, f"{SolveStatus.CONVERGED.value}")
        elif self.result.success:
            worst = ", ".join(
                f"{name} {value:.1e}"
                for name, value in zip(("primal", "dual", "gap"), self.figures, strict=True)
            )
            self.end(
                SolveStatus.FLOOR,
                "the conditions are solved, but a constraint is violated by more than 10 tol: "
                f"relative residuals {worst}",
            )


def _write(
    solution: Solution, program: QuadraticProgramData, point: ProgramPoint, bounding: np.ndarray
) -> None:
    """Write x, its objective and the multipliers."""
    problem, x, p = solution.problem, point.x, program
    slope = p.Q @ x + p.c
    solution.x, solution.obj = x, float(0.5 * x @ (p.Q @ x) + p.c @ x)
    if problem.G is not None:
        solution.z = np.zeros(len(bounding))
        if p.G is not None:
            solution.z[bounding] = point.z
            slope = slope - p.G.T @ point.z
    if problem.A is not None:
        solution.y = np.zeros(0) if p.C is None else -point.y
        slope = slope if p.C is None else slope - p.C.T @ point.y
    if problem.lb is not None or problem.ub is not None:
        at_lower, at_upper = (x <= p.lower) & ((slope > 0) | (x < p.upper)), x >= p.upper
        solution.z_box = np.where(
            at_lower, np.minimum(-slope, 0.0), np.where(at_upper, np.maximum(-slope, 0.0), 0.0)
        )


def _read(problem: Problem) -> tuple[QuadraticProgramData, np.ndarray]:
    """Return the program without its infinite rows, and the mask of its rows.

    The signs of G and h are changed: qpsolvers has G x <= h, the program has G x >= h.
    """
    P, q, lower, upper = _objective(problem)
    n = len(q)
    G, h = _rows(problem.G, problem.h, "G", "h", n)
    C, d = _rows(problem.A, problem.b, "A", "b", n)
    h = None if h is None else huge_as_infinite(h)
    bounding = np.zeros(0, dtype=bool) if h is None else h < np.inf
    if h is not None and G is not None:
        G, h = (-G[np.flatnonzero(bounding)], -h[bounding]) if bounding.any() else (None, None)
    if d is not None and not np.isfinite(d).all():
        raise ValueError(
            f"b holds {np.count_nonzero(~np.isfinite(d))} values that are not finite: equations "
            "need numbers"
        )
    if d is not None and not len(d):
        C, d = None, None
    return QuadraticProgramData(P, q, lower, upper, G, h, C, d), bounding


def _entries(M: Matrix) -> int:
    """Return the number of nonzero entries of a matrix."""
    return int(M.nnz if is_sparse(M) else np.count_nonzero(np.asarray(M)))


def _objective(problem: Problem) -> tuple[Matrix, np.ndarray, np.ndarray, np.ndarray]:
    """Return P's symmetric part, q, lb and ub."""
    q = real_array(problem.q, "q").astype(np.float64).ravel()
    n = len(q)
    P = _matrix(problem.P, "P")
    if P.shape != (n, n):
        raise ValueError(f"P has shape {P.shape}: expected {(n, n)}, after q")
    if not np.isfinite(q).all():
        raise ValueError(f"q holds {np.count_nonzero(~np.isfinite(q))} values that are not finite")
    lower = (
        np.full(n, -np.inf)
        if problem.lb is None
        else huge_as_infinite(_vector(problem.lb, "lb", n))
    )
    upper = (
        np.full(n, np.inf) if problem.ub is None else huge_as_infinite(_vector(problem.ub, "ub", n))
    )
    for name, side, wrong in (("lb", lower, np.inf), ("ub", upper, -np.inf)):
        if (side == wrong).any():
            raise ValueError(
                f"{name}[{np.flatnonzero(side == wrong)[0]}] is {wrong} (1e20 and more are "
                "infinite): no x could meet it"
            )
    if (lower > upper).any():
        raise ValueError(
            f"lb > ub in {np.count_nonzero(lower > upper)} unknowns, "
            f"{np.flatnonzero(lower > upper)[0]} the first"
        )
    return (P + P.T) * 0.5, q, lower, upper


def _rows(
    matrix: Matrix | None, right: Values | None, name: str, name_of_right: str, n: int
) -> tuple[Matrix | None, np.ndarray | None]:
    """Return a constraint's matrix and right-hand side, None if it does not exist."""
    if matrix is None or right is None:
        if matrix is not None or right is not None:
            raise ValueError(f"{name} and {name_of_right}: one is missing")
        return None, None
    M = _matrix(matrix, name)
    if M.shape[1] != n:
        raise ValueError(f"{name} has shape {M.shape}: expected {n} columns, after q")
    return M, _vector(right, name_of_right, M.shape[0])


def _matrix(values: Matrix, name: str) -> Matrix:
    """Return a sparse or dense matrix of float64."""
    if scipy.sparse.issparse(values):
        return scipy.sparse.csr_array(values, dtype=np.float64)
    host = np.atleast_2d(real_array(values, name).astype(np.float64))
    if not np.isfinite(host).all():
        raise ValueError(f"{name} holds a value that is not finite")
    return host


def _vector(values: Values, name: str, n: int) -> np.ndarray:
    host = real_array(values, name).astype(np.float64).ravel()
    if host.shape != (n,) or np.isnan(host).any():
        raise ValueError(
            f"{name} has shape {host.shape} and {np.count_nonzero(np.isnan(host))} NaN: expected "
            f"{(n,)} and none"
        )
    return host


def _check_convex(P: Matrix, q: np.ndarray) -> None:
    """Raise ValueError unless the program is convex.

    Only then do the first-order conditions hold at minimizers alone.
    """
    problem = LCP(as_operator(P, "cpu"), np.zeros_like(q), -np.inf)
    if not is_convex_program(problem):
        raise ValueError("P is not positive semi-definite: the program is not convex")
