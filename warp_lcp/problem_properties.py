"""Properties of a problem's matrix and bounds, on which `recommend` decides."""

from __future__ import annotations

import math
from functools import cache, cached_property
from importlib.util import find_spec

import numpy as np
import scipy.linalg
import scipy.sparse
import warp as wp

from warp_lcp.multigrid.black_box_multigrid import takes_points
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.curvature import has_negative_curvature
from warp_lcp.problem.data_types import Matrix, is_sparse
from warp_lcp.problem.data_types import dense as as_dense
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import HasRows, HasStencil, declared, has, layout_of, takes
from warp_lcp.problem.solve_loop import solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import renamed_names
from warp_lcp.solvers.psor import ProjectedSOR, grid_omega, has_advised_omega
from warp_lcp.solvers.registry import METHODS
from warp_lcp.subproblems.host_system import suits

MOST_FACTORED = 500  # largest number of unknowns for a Cholesky factorization: 4 ms
# Of a larger dense matrix every second row and column is factored, up to MOST_SAMPLED: 0.2 s.
SHARE_FACTORED, MOST_SAMPLED = 2, 2048
# Number of trial sweeps, and the last ones that define the rate: the first sweeps remove the rough
# part of the error.
TRIAL, TRIAL_RATE = 8, 4
# Relative to the largest diagonal entry: squared pivots that semi-definite matrices leave in
# float64.
PIVOT = 1e-11
# Relative to a diagonal entry: where most pivots are smaller, Newton's method cycles or PIQP is
# faster (measured on 17 kernels and 39 dense matrices). The second value is for systems that are
# not solved on the host.
LOW_RANK, LOW_RANK_ITERATIVE = 0.1, 0.3


class ProblemProperties:
    """Properties of a problem, each computed when first read.

    Each costs a product with A or less unless stated otherwise.

    Args:
        problem: the LCP; it is not changed.
        accuracy: relative residual that `sweeps` is for, in (0, 1).
        trial: whether sweeps may be tried on any matrix; else on unsymmetric sparse ones only.
    """

    def __init__(self, problem: LCP, accuracy: float, *, trial: bool = True) -> None:
        self._problem, self._accuracy, self._trial = problem, accuracy, trial

    @property
    def problem(self) -> LCP:
        """The problem."""
        return self._problem

    @cached_property
    def kind(self) -> str:
        """Return "grid", "sparse", "dense", or "operator" of products only or on ranks."""
        A = self._problem.A
        if has(A, HasStencil):
            return "grid"
        if self.ranks or not has(A, HasRows):
            return "operator"
        if isinstance(A, (SparseOperator, DenseOperator)):
            return "sparse" if isinstance(A, SparseOperator) else "dense"
        return "sparse" if scipy.sparse.issparse(self._matrix) else "dense"

    @cached_property
    def ranks(self) -> bool:
        """Return whether the unknowns are spread over several processes."""
        return layout_of(self._problem.A).comm is not None

    @cached_property
    def unknowns(self) -> int:
        """Return the number of unknowns n."""
        return int(np.count_nonzero(self._known))

    @cached_property
    def entries(self) -> int:
        """Return the number of entries of A that a product reads."""
        if self.kind == "sparse":
            A = self._problem.A
            return A.nnz if isinstance(A, SparseOperator) else _entries(self._matrix)
        return self.unknowns**2 if self.kind == "dense" else 7 * self.unknowns

    @cached_property
    def symmetric(self) -> bool:
        """Return whether A is symmetric."""
        return bool(self._problem.A.symmetric)

    @cached_property
    def diagonal(self) -> str:
        """Return the sign of the least diagonal entry: "positive", "zero" or "negative"."""
        least = self._entries_on_diagonal.min()
        return "positive" if least > 0 else "zero" if least == 0 else "negative"

    @cached_property
    def curved(self) -> bool:
        """Return whether a matrix with infinite bounds has negative diagonal entries.

        Negative entries where a bound is infinite, and no positive entries there.
        """
        return (
            self.kind in ("dense", "sparse")
            and self.diagonal == "negative"
            and has_negative_curvature(self._problem)
        )

    @cached_property
    def unbounded(self) -> bool:
        """Return whether a bound is infinite where a diagonal entry is negative."""
        below = self._entries_on_diagonal < 0
        return any(
            np.isinf(side.numpy()[self._known][below]).any()
            for side in (self._problem.lower, self._problem.upper)
        )

    @cached_property
    def definiteness(self) -> str:
        """Return the definiteness of the symmetric part of A.

        "definite", "semidefinite", "indefinite" or "unknown". It follows from diagonal dominance,
        or for at most MOST_FACTORED unknowns from one or two Cholesky factorizations.
        """
        if self.kind == "grid":
            return "definite"  # except closed components, which are settled before the first step
        if self.diagonal == "negative":
            return "indefinite"
        return (
            "unknown"
            if self.kind == "operator"
            else _definiteness(self._matrix, self.symmetric, self._entries_on_diagonal)
        )

    @cached_property
    def low_rank(self) -> bool:
        """Return whether A is dense, symmetric and close to low rank.

        It is if most pivots of a Cholesky factorization are small beside the diagonal entries.
        Beyond MOST_FACTORED unknowns every second row and column is factored.
        """
        n = self.unknowns
        if self.kind != "dense" or not self.symmetric or self.diagonal != "positive":
            return False
        if n > SHARE_FACTORED * MOST_SAMPLED:
            return False
        A, d = self._matrix, self._entries_on_diagonal
        if n > MOST_FACTORED:
            A, d = A[::SHARE_FACTORED, ::SHARE_FACTORED], d[::SHARE_FACTORED]
        pivots = _pivots(_dense(A) + PIVOT * d.max() * np.eye(len(d)))
        share = LOW_RANK if self.direct else LOW_RANK_ITERATIVE
        return pivots is not None and bool(2 * np.count_nonzero(pivots < share * d) > len(d))

    @property
    def affine(self) -> bool:
        """Return whether a bound is affine in x."""
        return self._problem.bounds.affine is not None

    @cached_property
    def bounds(self) -> str:
        """Return the kind of bounds: "affine", "none", "one-sided" or "box"."""
        problem = self._problem
        if self.affine:
            return "affine"
        sides = [
            bool(np.isfinite(side.numpy()[self._known]).any())
            for side in (problem.lower, problem.upper)
        ]
        return {0: "none", 1: "one-sided", 2: "box"}[sum(sides)]

    @cached_property
    def sweeps(self) -> float:
        """Return the expected number of `ProjectedSOR` sweeps for the accuracy.

        On grids it follows from the rate omega - 1 of the advised omega, elsewhere from the rate of
        TRIAL sweeps, which are made. Returns inf where sweeps do not converge, are not possible or
        are not tried.
        """
        tried = self._trial or (self.kind == "sparse" and not self.symmetric)
        return sweeps_to(self._problem, self._accuracy) if tried else float("inf")

    @cached_property
    def direct(self) -> bool:
        """Return whether systems are solved directly on the host: A is small or narrow."""
        return self._problem.preconditioner is None and suits(self._problem.A)

    @cached_property
    def points(self) -> bool:
        """Return whether a grid's stencil is symmetric and needs no line smoothing."""
        return takes_points(self._problem.A)

    @cached_property
    def able(self) -> tuple[str, ...]:
        """Return the names of the methods that can solve the problem."""
        return tuple(name for name in METHODS if self.takes(name))

    def takes(self, name: str) -> bool:
        """Return whether a method accepts the problem: its operator, size and bounds.

        It must accept the operator, its size and the bounds.
        """
        method, problem = METHODS[name], self._problem
        own = declared(method)
        if name == "quadratic-program" and not (self.symmetric and has_piqp()):
            return False
        if not takes(method, problem.A) or self.unknowns > (own.most_unknowns or self.unknowns):
            return False
        return (
            (own.preconditioned or problem.preconditioner is None)
            and (own.affine_bounds or not self.affine)
            and (own.distributed or not self.ranks)
        )

    @property
    def pivotable(self) -> bool:
        """Return whether pivoting is suitable: A is not a convex Hessian.

        A has an entry <= 0 on its diagonal, and is unsymmetric, as with friction cones, or
        symmetric indefinite with a zero on its diagonal, as in games.
        """
        if not self.symmetric:
            return self.diagonal != "positive"
        return self.diagonal == "zero" and self.definiteness == "indefinite"

    @cached_property
    def _known(self) -> np.ndarray:
        return self._problem.unknown.numpy() == 1

    @cached_property
    def _entries_on_diagonal(self) -> np.ndarray:
        A = self._problem.A
        if self.kind == "dense":
            return self._matrix.diagonal()
        return layout_of(A).load(A.diagonal(), wp.float64).numpy()[self._known]

    @cached_property
    def _matrix(self) -> Matrix:
        A = self._problem.A
        if isinstance(A, DenseOperator):
            return A.matrix.numpy()
        if isinstance(A, SparseOperator):
            return A.matrix()
        return A.rows().matrix()  # type: ignore[attr-defined]


@cache
def has_piqp() -> bool:
    """Return whether PIQP, an extra, is installed."""
    return find_spec("piqp") is not None


def traits_of(problem: LCP, accuracy: float) -> ProblemProperties:
    """Return the traits of a problem, without changing it.

    Args:
        problem: the LCP.
        accuracy: relative residual that the number of sweeps is for, in (0, 1).
    """
    return ProblemProperties(problem, accuracy)


def sweeps_to(problem: LCP, accuracy: float) -> float:
    """Estimate the sweeps to a relative residual; inf if they do not converge.

    With the rate r of the last TRIAL_RATE trial sweeps and the relative residual rho after them, it
    is TRIAL + log(accuracy / rho) / log(r). On grids the rate is that of the advised omega: omega -
    1.
    """
    if has_advised_omega(problem):
        return math.log(accuracy) / math.log(grid_omega(problem, singular=False) - 1)
    try:
        trial = solve(
            problem, ProjectedSOR(), stopping=StoppingCriteria(rtol=accuracy, max_iterations=TRIAL)
        )
    except ValueError:
        return float("inf")
    residuals = [record.residual for record in trial.history]
    if trial:
        return float(trial.iterations)
    if len(residuals) <= TRIAL or not residuals[-1] < residuals[-1 - TRIAL_RATE]:
        return float("inf")
    rate = (residuals[-1] / residuals[-1 - TRIAL_RATE]) ** (1 / TRIAL_RATE)
    return TRIAL + float(np.log(accuracy / trial.relative_residual) / np.log(rate))


def _entries(A: Matrix) -> int:
    """Return the number of stored entries of a sparse matrix, all of a dense one."""
    return int(A.nnz if is_sparse(A) else A.size)


def _dense(A: Matrix) -> np.ndarray:
    return np.asarray(as_dense(A), dtype=np.float64)


def _pivots(A: np.ndarray) -> np.ndarray | None:
    """Return the squared diagonal of a Cholesky factor, None if it does not exist."""
    factor, info = scipy.linalg.lapack.dpotrf(A, lower=True)
    return factor.diagonal() ** 2 if info == 0 else None


def _definiteness(A: Matrix, symmetric: bool, d: np.ndarray) -> str:
    """Return the definiteness of a matrix with a nonnegative diagonal.

    It is that of the symmetric part: Gershgorin's circles decide first, then Cholesky
    factorizations of the part shifted by -PIVOT and +PIVOT times the largest diagonal entry.
    """
    rows, columns = (np.asarray(abs(A).sum(axis=axis)).ravel() - d for axis in (1, 0))
    beyond, slack = d - (rows + columns) / 2, 1e-9 * d
    if (beyond >= -slack).all():  # Gershgorin's circles
        return "definite" if (beyond > slack).any() else "semidefinite"
    if len(d) > MOST_FACTORED:
        return "unknown"
    dense = _dense(A)
    part, shift = (
        dense if symmetric else 0.5 * (dense + dense.T),
        PIVOT * float(d.max(initial=0.0)) * np.eye(len(d)),
    )
    for shifted, verdict in ((part - shift, "definite"), (part + shift, "semidefinite")):
        if _pivots(shifted) is not None:
            return verdict
    return "indefinite"


__getattr__ = renamed_names(__name__, Traits="ProblemProperties")
