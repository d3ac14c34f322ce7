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
from warp_lcp.problem.solve import solve
from warp_lcp.problem.stopping import StoppingCriteria
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
        definiteness: of A's symmetric part: "definite", "semidefinite", "indefinite", or "unknown" where finding out is too dear.
        bounds: "none", "one-sided", "box" or "affine".
        sweeps: how many sweeps of `ProjectedSOR` the accuracy would take, extrapolated from the rate of the first ones; inf where they
            do not converge or are not possible.
        direct: whether the matrix is so small or narrow that its systems are solved directly on the host.
        able: names of the methods that take such an operator, so many unknowns and such bounds.
    """

    kind: str
    unknowns: int
    entries: int
    symmetric: bool
    diagonal: str
    definiteness: str
    bounds: str
    sweeps: float
    direct: bool
    able: tuple[str, ...]

    @property
    def singular(self) -> bool:
        """Whether A is symmetric without being definite; a negative entry on the diagonal is no matter of its null space."""
        return self.symmetric and self.definiteness in ("semidefinite", "indefinite") and self.diagonal != "negative"

    @property
    def pivotable(self) -> bool:
        """Whether A is unsymmetric with an entry <= 0 on its diagonal, as the slip speeds of friction cones have them."""
        return not self.symmetric and self.diagonal != "positive"


def traits_of(problem: LCP, accuracy: float) -> Traits:
    """Return what is known of a problem, without changing it.

    Args:
        problem: the LCP.
        accuracy: relative residual that the number of sweeps is for, in (0, 1).
    """
    A, known = problem.A, problem.unknown.numpy() == 1
    matrix: Any = A.rows().matrix() if has(A, HasRows) else None
    shown = "operator" if matrix is None else "sparse" if scipy.sparse.issparse(matrix) else "dense"
    kind = "grid" if has(A, HasStencil) else shown
    n, bounds = int(np.count_nonzero(known)), bounds_of(problem)
    d = layout_of(A).load(A.diagonal(), wp.float64).numpy()[known]
    sign = "positive" if d.min() > 0 else "zero" if d.min() == 0 else "negative"
    if kind == "grid":
        definiteness = "definite"  # closed components apart, which are settled before the first step
    elif kind == "operator" or sign == "negative":
        definiteness = "indefinite" if sign == "negative" else "unknown"
    else:
        definiteness = _definiteness(matrix, A.symmetric, d)
    entries = matrix.nnz if kind == "sparse" else n**2 if kind == "dense" else 7 * n
    able = tuple(name for name, method in METHODS.items() if takes(method, A) and _suits(method, problem, n, bounds))
    sweeps = sweeps_to(problem, accuracy)
    return Traits(kind, n, entries, A.symmetric, sign, definiteness, bounds, sweeps, problem.preconditioner is None and suits(A), able)


def bounds_of(problem: LCP) -> str:
    """Return "affine", "none", "one-sided" or "box": which bounds are finite anywhere."""
    if problem.bounds.affine is not None:
        return "affine"
    known = problem.unknown.numpy() == 1
    sides = [bool(np.isfinite(side.numpy()[known]).any()) for side in (problem.lower, problem.upper)]
    return {0: "none", 1: "one-sided", 2: "box"}[sum(sides)]


def _suits(method: Any, problem: LCP, unknowns: int, bounds: str) -> bool:
    """Return whether a method takes so many unknowns and such bounds, and makes use of a preconditioner that there is."""
    if problem.preconditioner is not None and not getattr(method, "preconditioned", False):
        return False
    return unknowns <= getattr(method, "most_unknowns", unknowns) and (bounds != "affine" or getattr(method, "affine_bounds", False))


def sweeps_to(problem: LCP, accuracy: float) -> float:
    """Return how many sweeps would reach a relative residual, by the rate of the last of TRIAL sweeps; inf if they get nowhere."""
    try:
        trial = solve(problem, ProjectedSOR(), stopping=StoppingCriteria(rtol=accuracy, max_iterations=TRIAL))
    except ValueError:
        return float("inf")
    residuals = [record.residual for record in trial.history]
    if trial:
        return float(trial.iterations)
    if len(residuals) <= TRIAL or not residuals[-1] < residuals[-1 - TRIAL_RATE]:
        return float("inf")
    rate = (residuals[-1] / residuals[-1 - TRIAL_RATE]) ** (1 / TRIAL_RATE)
    return TRIAL + float(np.log(accuracy / trial.relative_residual) / np.log(rate))


def _definiteness(A: Any, symmetric: bool, d: np.ndarray) -> str:
    """Return what a matrix's symmetric part is, by dominance or by Cholesky factorizations; its diagonal is nowhere negative."""
    rows, columns = (np.asarray(abs(A).sum(axis=axis)).ravel() - d for axis in (1, 0))
    beyond, slack = d - (rows + columns) / 2, 1e-9 * d
    if (beyond >= -slack).all():  # Gershgorin's circles
        return "definite" if (beyond > slack).any() else "semidefinite"
    if len(d) > MOST_FACTORED:
        return "unknown"
    dense = A.toarray() if scipy.sparse.issparse(A) else np.asarray(A, dtype=np.float64)
    part, shift = dense if symmetric else 0.5 * (dense + dense.T), PIVOT * float(d.max(initial=0.0)) * np.eye(len(d))
    for shifted, verdict in ((part - shift, "definite"), (part + shift, "semidefinite")):
        if scipy.linalg.lapack.dpotrf(shifted, lower=True)[1] == 0:
            return verdict
    return "indefinite"
