"""Default chains: the methods that take over where one stalls."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

from warp_lcp.multigrid.aggregates import suits_multigrid
from warp_lcp.multigrid.black_box_multigrid import takes_points
from warp_lcp.operators.banded_matrix import NARROW
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.operator_protocol import HasLowRankTerm, HasRows, HasScale, HasStencil, has
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import Count, Settings
from warp_lcp.solvers.assembled_matrix import AssembledMatrix
from warp_lcp.solvers.fallback import (
    WEAK,
    Fallback,
    FallbackEntry,
    Progress,
    crawls,
    fails,
    slow_linear_solves,
    stalls,
)
from warp_lcp.solvers.fischer_newton import FischerNewton
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.solvers.primal_dual_active_set import PrimalDualActiveSet
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.proximal_point import ProximalPoint
from warp_lcp.solvers.staggering import Staggering
from warp_lcp.subproblems.initial_cycles import LARGE

FALL = 0.9  # a residual above this part of the smallest so far is no progress of a path
# Steps without progress before the proximal-point method takes over: the central path is joined far
# from the start, where the residual need not fall.
PATH_IDLE = 10
# Ratio to the residual PATH_IDLE steps ago: above it, a path that was joined far from the start
# makes no progress.
CREEPS = 0.97
BATCH = 200  # steps of MPRGP that count as one: together they cost about as much as a linear solve


def default_chain(method: Solver, problem: LCP | None = None) -> Solver:
    """Return a chain of a method and the methods that continue where it fails.

    It is the method itself where no other continues. The others are:

    - After `ProjectedMultigrid`, `MinimumMapNewton` on the assembled matrix where cycles crawl. In
      single precision, on several ranks or with floating components there is none. Beside rigid
      bodies it is `MinimumMapNewton`, where cycles crawl or free sets recur.
    - After `MinimumMapNewton` on matrices, `MPRGP` where linear solves of a large symmetric matrix
      that is no M-matrix are slow, or its near null space is known; `InteriorPoint` where steps
      stall or fail; then `ProximalPoint`. With negative diagonal entries `FischerNewton` replaces
      the last two. On grids that need line relaxation or are not symmetric, the assembled matrix is
      used instead.
    - After `PrimalDualActiveSet`, `MinimumMapNewton` (not on dense matrices), then as above.
    - `Staggering` without methods for its blocks gets `MinimumMapNewton` for each block, with
      `InteriorPoint` and `ProximalPoint` after it as above.

    Args:
        method: the first method.
        problem: the problem; None: one of a grid.
    """
    if isinstance(method, ProjectedMultigrid):
        return _of_multigrid(method)
    if isinstance(method, MinimumMapNewton) and method.safeguard:
        return _of_newton(method, problem)
    if isinstance(method, PrimalDualActiveSet):
        return _of_active_set(method, problem)
    if isinstance(method, Staggering) and not method.solvers:
        return replace(method, solvers=(Fallback(MinimumMapNewton(), *_last()),))
    return method


@dataclass(frozen=True, kw_only=True)
class CentralPathStalls(Settings):
    """Condition: the last step has failed, or the central path makes no progress.

    Args:
        steps: number of steps without a residual below 0.9 of the smallest so far.
    """

    steps: Count = PATH_IDLE

    def __call__(self, progress: Progress) -> bool:
        """Return whether the condition holds."""
        if fails(progress):
            return True
        after = progress.norms[1:]  # the residual at the start of a path is arbitrary
        if len(after) <= PATH_IDLE or not after[-1] > CREEPS * after[-1 - PATH_IDLE]:
            return False
        smallest, idle = math.inf, 0
        for norm in after:
            idle = 0 if norm <= FALL * smallest else idle + 1
            smallest = min(smallest, norm)
        return idle >= self.steps


def cycles_fail_beside_bodies(progress: Progress) -> bool:
    """Return whether a step on a grid with bodies has failed, or its cycles crawl."""
    problem = progress.problem
    assert isinstance(problem, LCP)
    return not has(problem.A, HasStencil) and (fails(progress) or crawls(progress))


def stalls_or_crawls(progress: Progress) -> bool:
    """Return whether steps stall or cycles crawl."""
    return stalls(progress) or crawls(progress)


def weak_preconditioner(progress: Progress) -> bool:
    """Return whether MPRGP should take over from Newton's method.

    It should if steps stall, linear solves are slow, or a near null space is known.

    With a near null space cycles converge so fast that MPRGP as a whole takes about as many
    iterations as one linear solve.
    """
    return (
        stalls(progress)
        or slow_linear_solves(progress)
        or (
            isinstance(progress.problem, LCP)
            and isinstance(progress.problem.A, SparseOperator)
            and progress.problem.A.near_null_space is not None
        )
    )


@cache
def _of_multigrid(method: ProjectedMultigrid) -> Solver:
    newton = MinimumMapNewton(precision=method.precision, cycle=method.cycle)
    entries = [FallbackEntry(method)]
    if method.precision != "single":
        entries.append(FallbackEntry(_on_assembled(), crawls))
    return Fallback(*entries, FallbackEntry(newton, cycles_fail_beside_bodies))


def _of_newton(method: MinimumMapNewton, problem: LCP | None) -> Solver:
    """Return the chain of Newton's method for the problem's operator."""
    A = None if problem is None else problem.A
    if problem is None or has(A, HasLowRankTerm):
        return method
    if has(A, HasStencil):
        return method if takes_points(A) else Fallback(method, (_on_assembled(), stalls_or_crawls))
    if not (has(A, HasRows) and has(A, HasScale)):
        return method
    if _has_negative_diagonal(problem):
        return _without_path(method)
    narrow = isinstance(A, SparseOperator) and A.bandwidth <= NARROW
    return _on_matrix(
        method, _minimizes(problem), StoppingCriteria.patience if narrow else PATH_IDLE
    )


@cache
def _on_matrix(method: MinimumMapNewton, minimizes: bool, steps: int) -> Fallback:
    """Return the chain of Newton's method on a matrix; with MPRGP if possible.

    MPRGP needs an energy.
    """
    if not minimizes:
        return Fallback(method, *_last(steps))
    first = replace(method, max_linear_iterations=min(WEAK, method.max_linear_iterations))
    gradients = FallbackEntry(MPRGP(precision=method.precision), weak_preconditioner, batch=BATCH)
    return Fallback(first, gradients, (method, fails), *_last(steps))


def _of_active_set(method: PrimalDualActiveSet, problem: LCP | None) -> Solver:
    """Return the chain of the active set method for the problem's operator."""
    newton = method.as_newton()
    if problem is None or has(problem.A, HasStencil):
        return Fallback(method, (newton, fails), (_on_assembled(), stalls_or_crawls))
    if isinstance(problem.A, DenseOperator):
        return Fallback(method, *_last())
    if not (has(problem.A, HasRows) and has(problem.A, HasScale)):
        return Fallback(method, (newton, fails))
    return Fallback(method, (newton, fails), *_last())


@cache
def _last(steps: int = PATH_IDLE) -> tuple[FallbackEntry, FallbackEntry]:
    """Return the methods that follow Newton's method on matrices.

    Linear programs and other saddle points (A skew except for a block or a small shift) have free
    blocks that are singular or nearly so on the way to the solution. So have matrices of low rank,
    and Laplacians without a boundary condition, whose active set advances by one layer of unknowns
    a step. The central path exists for every positive semi-definite A, and needs no free blocks.
    """
    return FallbackEntry(InteriorPoint(precision="double"), stalls, restart=True), FallbackEntry(
        ProximalPoint(), CentralPathStalls(steps=steps)
    )


@cache
def _without_path(method: MinimumMapNewton) -> Fallback:
    """Return the chain of Newton's method for negative diagonal entries.

    A matrix with negative diagonal entries need not have a central path.
    """
    return Fallback(method, FallbackEntry(FischerNewton(), stalls, restart=True))


def _has_negative_diagonal(problem: LCP) -> bool:
    A = problem.A
    diagonal = A.host_diagonal() if isinstance(A, DenseOperator) else A.diagonal().numpy()
    return bool((diagonal < 0).any())


def _minimizes(problem: LCP) -> bool:
    """Return whether MPRGP can minimize the problem's energy on a large sparse A.

    False for matrices that suit problems on coarse points.
    """
    A = problem.A
    if (
        not isinstance(A, SparseOperator)
        or not A.symmetric
        or A.unknowns < LARGE
        or A.bandwidth <= NARROW
    ):
        return False
    if not problem.bounded or problem.preconditioner is not None:
        return False
    host = A.matrix()
    return not suits_multigrid(host) and bool((host.diagonal() >= 0).all())


@cache
def _on_assembled() -> AssembledMatrix:
    """Return Newton's method and its followers on the assembled matrix of a grid."""
    return AssembledMatrix(Fallback(MinimumMapNewton(precision="double"), *_last()))
