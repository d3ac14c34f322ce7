"""Convex quadratic programs for qpsolvers: `register()` adds the solver "warp_lcp" to those of that package (extra `qpsolvers`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse

from warp_lcp.linear_complementarity import linear_complementarity
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.reformulate import QuadraticProgramData, quadratic_program_to_boxed
from warp_lcp.problem.result import SolveStatus
from warp_lcp.rows.fields import real_array
from warp_lcp.solvers.dense_problem import DenseProblem
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.quadratic_program import is_convex

if TYPE_CHECKING:
    from qpsolvers import Problem, Solution

NAME = "warp_lcp"


def register() -> None:
    """Make `qpsolvers.solve_qp(..., solver="warp_lcp")` call `solve_problem`, for dense and for sparse matrices.

    Raises:
        ImportError: qpsolvers is not installed.
    """
    try:
        import qpsolvers.solvers as there
    except ImportError as missing:
        raise ImportError("warp_lcp.qp needs qpsolvers: pip install 'warp-lcp[qpsolvers]' (or pip install qpsolvers)") from missing
    there.solve_function[NAME] = solve_problem
    for names in (there.available_solvers, there.dense_solvers, there.sparse_solvers):
        if NAME not in names:
            names.append(NAME)


def solve_problem(
    problem: Problem, initvals: Any = None, verbose: bool = False, *, method: Any = None, tol: float = 1e-9, maxiter: int = 500
) -> Solution:
    """Minimize x'Px / 2 + q'x subject to G x <= h, A x = b, lb <= x <= ub, P symmetric positive semi-definite.

    A program with nothing but a box is the boxed LCP of P and q ([Book] eq. 1.58); others are solved by the boxed LCP of their first-order
    conditions, in x and the multipliers (`quadratic_program_to_boxed`). Matrices stay sparse where they are all sparse.

    Args:
        problem: of qpsolvers; P's symmetric part is what counts.
        initvals: a guess of x, shape (n,).
        verbose: print how the solve ended.
        method: of `linear_complementarity`. None: what that takes for a box; with other constraints InteriorPoint, then Lemke.
        tol: relative tolerance of the natural residual, in [0, 1).
        maxiter: the most iterations of a method.

    Returns:
        x with the multipliers y, z and z_box in qpsolvers' signs, and `found` where the residual, recomputed in float64, meets the
        tolerance; else `found` is False and they are None. `extras["result"]` is what `linear_complementarity` returned last.

    Raises:
        ValueError: the program is not convex, an argument is of another kind or shape, or a bound is NaN.
    """
    from qpsolvers import Solution

    P, q, lower, upper = _objective(problem)
    n = len(q)
    G, h = _rows(problem.G, problem.h, "G", "h", n)
    C, d = _rows(problem.A, problem.b, "A", "b", n)
    bounding = None if h is None else h < np.inf  # other rows bound nothing
    if h is not None and bounding is not None:
        G, h = G[np.flatnonzero(bounding)], h[bounding]
    _check_convex(P, q)
    given: dict[str, Any] = {"tol": tol, "maxiter": maxiter}
    if h is None and d is None:
        found = linear_complementarity(P, q, bounds=(lower, upper), x0=initvals, method=method, **given)
    else:
        data = QuadraticProgramData(P, q, lower, upper, None if G is None else -G, None if h is None else -h, C, d)
        if not all(M is None or scipy.sparse.issparse(M) for M in (P, G, C)):
            data = QuadraticProgramData(*(M.toarray() if scipy.sparse.issparse(M) else M for M in vars(data).values()))
        made = quadratic_program_to_boxed(data, device="cpu")
        x0 = None if initvals is None else np.r_[_vector(initvals, "initvals", n), np.zeros(len(made.b) - n)]
        for taken in (InteriorPoint(), Lemke()) if method is None else (method,):
            if isinstance(taken, Lemke) and method is None and len(made.b) > Lemke.most_unknowns:
                break
            found = linear_complementarity(made.A, made.b, bounds=(made.lower, made.upper), x0=x0, method=taken, **given)
            if found.success or found.result.status is SolveStatus.INFEASIBLE:
                break
    if verbose:
        print(f"{NAME}: {found.message} ({found.nit} iterations, relative residual {found.relative_residual:.1e})")
    solution = Solution(problem, extras={"result": found}, found=found.success)
    if found.success:
        _write(solution, P, q, found, bounding)
    return solution


def _write(solution: Solution, P: Any, q: np.ndarray, found: Any, bounding: np.ndarray | None) -> None:
    """Write x, its objective and the multipliers."""
    n, problem = len(q), solution.problem
    x = found.x[:n]
    solution.x, solution.obj = x, float(0.5 * x @ (P @ x) + q @ x)
    inequalities = 0 if bounding is None else int(np.count_nonzero(bounding))
    if bounding is not None:
        solution.z = np.zeros(len(bounding))
        solution.z[bounding] = np.maximum(found.x[n : n + inequalities], 0.0)
    if problem.A is not None:
        solution.y = -found.x[n + inequalities :]
    if problem.lb is not None or problem.ub is not None:
        solution.z_box = np.where(found.active_mask[:n] != 0, -found.slack[:n], 0.0)


def _objective(problem: Problem) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Return P's symmetric part, q, lb and ub."""
    q = real_array(problem.q, "q").astype(np.float64).ravel()
    n = len(q)
    P = _matrix(problem.P, "P")
    if P.shape != (n, n):
        raise ValueError(f"P has shape {P.shape}: expected {(n, n)}, after q")
    lower = np.full(n, -np.inf) if problem.lb is None else _vector(problem.lb, "lb", n)
    upper = np.full(n, np.inf) if problem.ub is None else _vector(problem.ub, "ub", n)
    return (P + P.T) * 0.5, q, lower, upper


def _rows(matrix: Any, right: Any, name: str, name_of_right: str, n: int) -> tuple[Any, np.ndarray | None]:
    """Return a constraint's matrix and right-hand side, None where there is none."""
    if matrix is None or right is None:
        if matrix is not None or right is not None:
            raise ValueError(f"{name} and {name_of_right}: one is missing")
        return None, None
    M = _matrix(matrix, name)
    if M.shape[1] != n:
        raise ValueError(f"{name} has shape {M.shape}: expected {n} columns, after q")
    return M, _vector(right, name_of_right, M.shape[0])


def _matrix(values: Any, name: str) -> Any:
    """Return a matrix, sparse or dense, of float64."""
    if scipy.sparse.issparse(values):
        return scipy.sparse.csr_array(values, dtype=np.float64)
    host = np.atleast_2d(real_array(values, name).astype(np.float64))
    if not np.isfinite(host).all():
        raise ValueError(f"{name} holds a value that is not finite")
    return host


def _vector(values: Any, name: str, n: int) -> np.ndarray:
    host = real_array(values, name).astype(np.float64).ravel()
    if host.shape != (n,) or np.isnan(host).any():
        raise ValueError(f"{name} has shape {host.shape} and {np.count_nonzero(np.isnan(host))} NaN: expected {(n,)} and none")
    return host


def _check_convex(P: Any, q: np.ndarray) -> None:
    """Refuse a program whose first-order conditions are met by more than its minimizers."""
    problem = LCP(as_operator(P, "cpu"), np.zeros_like(q), -np.inf)
    if not is_convex(DenseProblem.read(problem, keep_sparse=True).scaled()[0].A):
        raise ValueError("P is not positive semi-definite: the program is not convex")
