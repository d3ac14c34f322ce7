"""What a problem's matrix and bounds look like, found at the price of some ten products: what `warp_lcp.recommend` decides by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import warp as wp

from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasRows, HasStencil, has, layout_of, takes
from warp_lcp.problem.solve import Solver, solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.minimum_map_newton_direct import suits
from warp_lcp.solvers.psor import ProjectedSOR
from warp_lcp.solvers.registry import METHODS

MOST_FACTORED = 1500  # unknowns of a matrix whose Cholesky factorization is tried: it takes 0.1 s there, a Newton step's time
TRIAL, TRIAL_RATE = 8, 4  # sweeps on trial, and how many of the last tell the rate: the first ones remove what is rough in the error
PIVOT = 1e-11  # of the largest diagonal entry: semi-definite matrices in float64 leave squared pivots of that size


@dataclass(frozen=True)
class Traits:
    """What is known of a problem.

    Args:
        kind: "grid", "sparse", "dense" or "operator", one that shows products only.
        unknowns: n.
        entries: of A that a product reads.
        symmetric: whether A is.
        diagonal: sign of its smallest entry: "positive", "zero" or "negative".
        m_matrix: no positive entries off the diagonal and weakly dominant rows or columns: an M-matrix, if it is not singular.
        definiteness: of A's symmetric part: "definite", "semidefinite", "indefinite", or "unknown" where finding out is too dear.
        bounds: "none", "one-sided", "box" or "affine".
        sweeps: how many sweeps of `ProjectedSOR` the accuracy would take, extrapolated from the rate of the first ones; inf where they
            do not converge or are not possible.
        block_sweeps: the same of `BlockedGaussSeidel`; 1 or 2 where unknowns are coupled in small blocks alone.
        quiet: share of the unknowns with b_i = 0: of contacts at rest, most.
        direct: whether the matrix is so small or narrow that its systems are solved directly on the host.
        able: names of the methods that take such an operator, so many unknowns and such bounds.
    """

    kind: str
    unknowns: int
    entries: int
    symmetric: bool
    diagonal: str
    m_matrix: bool
    definiteness: str
    bounds: str
    sweeps: float
    block_sweeps: float
    quiet: float = 0.0
    direct: bool = False
    able: tuple[str, ...] = ()


def traits_of(problem: LCP, accuracy: float) -> Traits:
    """Return what is known of a problem, without changing it.

    Args:
        problem: the LCP.
        accuracy: relative residual that the number of sweeps is for, in (0, 1).
    """
    A = problem.A
    matrix: Any = A.rows().matrix() if has(A, HasRows) else None
    shown = "operator" if matrix is None else "sparse" if scipy.sparse.issparse(matrix) else "dense"
    kind = "grid" if has(A, HasStencil) else shown
    unknowns = int(np.count_nonzero(problem.unknown.numpy() == 1))
    d = layout_of(A).load(A.diagonal(), wp.float64).numpy()[problem.unknown.numpy() == 1]
    least = float(d.min())
    sign = "positive" if least > 0 else "zero" if least == 0 else "negative"
    if kind == "grid":
        m_matrix, definiteness = True, "definite"  # closed components apart, which are settled before the first step
    elif kind == "operator":
        m_matrix, definiteness = False, "indefinite" if least < 0 else "unknown"
    else:
        m_matrix, definiteness = _of_matrix(matrix, A.symmetric, d)
    entries = matrix.nnz if kind == "sparse" else unknowns**2 if kind == "dense" else 7 * unknowns
    b = np.abs(problem.b.numpy().ravel()[problem.unknown.numpy().ravel() == 1])
    quiet = float((b <= 1e-9 * b.max()).mean())
    trials = [sweeps_to(problem, accuracy, method) for method in (ProjectedSOR(), BlockedGaussSeidel())]
    known, bounds = (kind, unknowns, entries, A.symmetric, sign, m_matrix, definiteness), bounds_of(problem)
    able = tuple(name for name, method in METHODS.items() if takes(method, A) and _suits(method, unknowns, bounds))
    return Traits(*known, bounds, trials[0], trials[1], quiet, suits(A), able)


def bounds_of(problem: LCP) -> str:
    """Return "affine", "none", "one-sided" or "box": which bounds are finite anywhere."""
    if problem.bounds.affine is not None:
        return "affine"
    known = problem.unknown.numpy() == 1
    sides = [bool(np.isfinite(side.numpy()[known]).any()) for side in (problem.lower, problem.upper)]
    return {0: "none", 1: "one-sided", 2: "box"}[sum(sides)]


def _suits(method: Any, unknowns: int, bounds: str) -> bool:
    """Return whether a method takes so many unknowns and such bounds."""
    return unknowns <= getattr(method, "most_unknowns", unknowns) and (bounds != "affine" or getattr(method, "affine_bounds", False))


def sweeps_to(problem: LCP, accuracy: float, method: Solver) -> float:
    """Return how many sweeps would reach a relative residual, by the rate of the last of TRIAL sweeps; inf if they get nowhere."""
    try:
        trial = solve(problem, method, stopping=StoppingCriteria(rtol=accuracy, max_iterations=TRIAL))
    except ValueError:
        return float("inf")
    residuals = [record.residual for record in trial.history]
    if trial:
        return float(trial.iterations)
    if len(residuals) <= TRIAL or not residuals[-1] < residuals[-1 - TRIAL_RATE]:
        return float("inf")
    rate = (residuals[-1] / residuals[-1 - TRIAL_RATE]) ** (1 / TRIAL_RATE)
    goal = accuracy * residuals[-1] / trial.relative_residual if trial.relative_residual > 0 else residuals[-1]
    return TRIAL + float(np.log(goal / residuals[-1]) / np.log(rate))


def _of_matrix(A: Any, symmetric: bool, d: np.ndarray) -> tuple[bool, str]:
    """Return whether a matrix is dominant with the signs of an M-matrix, and its definiteness."""
    sizes = abs(A)
    rows, columns = (np.asarray(sizes.sum(axis=axis)).ravel() - np.abs(d) for axis in (1, 0))
    signs = bool((np.asarray(A.sum(axis=1)).ravel() <= d - rows + 1e-9 * np.abs(d)).all()) and bool((d > 0).all())
    slack = 1e-9 * np.abs(d)
    m_matrix = signs and bool((d >= rows - slack).all() or (d >= columns - slack).all())
    if (d < 0).any():
        return m_matrix, "indefinite"
    if (d >= (rows + columns) / 2 - slack).all():  # Gershgorin's circles of the symmetric part
        return m_matrix, "definite" if (d > (rows + columns) / 2 + slack).any() else "semidefinite"
    if len(d) > MOST_FACTORED:
        return m_matrix, "unknown"
    dense = A.toarray() if scipy.sparse.issparse(A) else np.asarray(A, dtype=np.float64)
    part = dense if symmetric else 0.5 * (dense + dense.T)
    return m_matrix, _definiteness(part, float(d.max(initial=0.0)))


def _definiteness(A: np.ndarray, largest: float) -> str:
    """Return what Cholesky factorizations say: of A less, and of A plus, PIVOT of the largest diagonal entry."""
    for sign, verdict in ((-1, "definite"), (1, "semidefinite")):
        shifted = A + sign * PIVOT * largest * np.eye(len(A))
        if scipy.linalg.lapack.dpotrf(shifted, lower=True, overwrite_a=True)[1] == 0:
            return verdict
    return "indefinite"
