"""The method for those who name none."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Never

import warp as wp

from warp_lcp.multigrid.line_hierarchy import takes_points
from warp_lcp.operators.matrix_stencil import stencil_of
from warp_lcp.operators.renumbering import Renumbering
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil, has, takes, version_of
from warp_lcp.problem.result import Record, SolveResult
from warp_lcp.problem.solve import ConvexSetProblem, Solver, Workspace
from warp_lcp.problem.solve import solve as solve_by
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.rows.fields import Array
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.minimum_map_newton_direct import suits
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.solvers.projected_jacobi import ProjectedJacobi
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.psor import ProjectedSOR

LARGE = 2000  # unknowns from which it pays to look whether a matrix is a grid's
ANY_NUMBERING = (MinimumMapNewton, MPRGP)  # methods whose steps do not depend on the unknowns' order, but for rounding and aggregates
LEAST = 1e-9  # seconds that are left to a solve whose renumbering has taken them all


def default_method(problem: LCP) -> Solver:
    """Return the fastest method measured for the problem's operator: ProjectedMultigrid on grids, else MinimumMapNewton.

    That is also for compact stencils that are not symmetric, or that only lines smooth.

    Its systems are solved directly on the host, on CUDA devices too, where a matrix has at most 200 unknowns or a bandwidth up to 3, unless
    the problem brings a preconditioner. Where bounds are affine in x, a method that takes them: ProjectedSOR, or ProjectedJacobi where A
    cannot be swept.
    """
    if problem.bounds.affine is not None:
        return ProjectedSOR() if takes(ProjectedSOR, problem.A) else ProjectedJacobi()
    if has(problem.A, HasStencil):
        return ProjectedMultigrid() if takes_points(problem.A) else MinimumMapNewton()
    return MinimumMapNewton(direct=problem.preconditioner is None and suits(problem.A))


def solve(
    problem: LCP | ConvexSetProblem, solver: Solver | None = None, *, stopping: StoppingCriteria | MeanCriteria | None = None,
    x0: Array | None = None, workspace: Workspace | None = None, callback: Callable[[Record], None] | None = None, **misplaced: Never,
) -> SolveResult:  # fmt: skip
    """Solve a problem by a method.

    Args:
        problem: the LCP, or a problem over another convex set than a box.
        solver: the method, say `MinimumMapNewton()`; `default_method(problem)` if None, and sparse matrices that are a compact stencil on a
            box of cells in its natural order, x first, are then solved as such, which the result's `grid` says.
        stopping: the criteria; defaults to `StoppingCriteria()`.
        x0: a guess, field of the problem's shape, projected onto the bounds; clip(0, l, u) if None (over other sets: x as it is).
        workspace: what `solver.init(problem)` returned, to use its memory again.
        callback: called with each Record as it is made; where it raises StopIteration, the solve ends with STOPPED.
        misplaced: nothing; other options are refused.

    Returns:
        The best iterate, its status and recomputed residual, the history. The result's x is the caller's to keep, unless the problem
        works in place or is over another set: then it is the workspace's own iterate, overwritten by the next solve with that workspace.

    Raises:
        ValueError: an argument is of another kind, x0 has a wrong shape or is not finite, a workspace comes without its solver, or the
            method cannot take this A.
        TypeError: an option of another name; the message says where it belongs.
    """
    for name in misplaced:
        if name in StoppingCriteria.__dataclass_fields__:
            raise TypeError(f"solve takes no {name}: it is a criterion, pass stopping=wl.StoppingCriteria({name}=...)")
        raise TypeError(f"solve takes no {name}: settings are the method's own, say wl.ProjectedSOR(omega=1.5)")
    if solver is None and workspace is not None:
        raise ValueError("workspace: name the solver that made it")
    if solver is None and isinstance(problem, ConvexSetProblem):
        raise ValueError(f"solver: a {type(problem).__name__} is solved by methods of its own, name one")
    if solver is None and isinstance(problem, LCP):
        found = _solve_as_grid(problem, stopping, x0, callback)
        if found is not None:
            return found
    solver = default_method(problem) if solver is None else solver  # type: ignore[arg-type]  # an LCP, or refused there
    if workspace is None and isinstance(solver, ANY_NUMBERING) and isinstance(problem, LCP) and isinstance(problem.A, SparseOperator):
        plain = problem.bounds.affine is None and problem.preconditioner is None
        begun, found = time.perf_counter(), problem.A.renumbered() if plain else None
        if found is not None:
            return _solve_renumbered(problem, *found, solver, stopping or StoppingCriteria(), x0, callback, begun)
    return solve_by(problem, solver, stopping=stopping, x0=x0, workspace=workspace, callback=callback)


def _solve_as_grid(
    problem: LCP, stopping: StoppingCriteria | MeanCriteria | None, x0: Array | None, callback: Callable[[Record], None] | None
) -> SolveResult | None:
    """Return the result of a large sparse matrix that is a grid's stencil, solved as one; None where it is none, or has not converged."""
    A = problem.A
    if not isinstance(A, SparseOperator) or A.unknowns < LARGE or problem.in_place or problem.preconditioner is not None:
        return None
    stencil = None if problem.bounds.affine is not None else stencil_of(A)
    if stencil is None:
        return None
    fields = (field.numpy().reshape(stencil.shape) for field in (problem.b, problem.lower, problem.upper))
    on_grid, start = LCP(stencil, *fields), None if x0 is None else problem.layout.load(x0, wp.float64, "x0").numpy().reshape(stencil.shape)
    result = solve_by(on_grid, default_method(on_grid), stopping=stopping, x0=start, callback=callback)
    return replace(result, x=result.x.flatten(), grid=stencil.shape, problem=problem, version=A.version) if result else None


def _solve_renumbered(
    problem: LCP, numbering: Renumbering, A: SparseOperator, solver: Solver, stopping: StoppingCriteria | MeanCriteria, x0: Array | None,
    callback: Callable[[Record], None] | None, begun: float,
) -> SolveResult:  # fmt: skip
    """Solve a problem in another numbering of its unknowns; return x in its own. What that takes counts as set-up, from `begun` on."""
    order = numbering.order
    sides = (problem.bounds.host(side)[order] if problem.bounds.varying[side] else problem.bounds.values[side] for side in (0, 1))
    other = LCP(A, problem.b.numpy()[order], *sides)
    guess = None if x0 is None else problem.layout.load(x0, wp.float64, "x0").numpy()[order]
    if isinstance(stopping, StoppingCriteria) and stopping.max_seconds < math.inf:
        stopping = replace(stopping, max_seconds=max(LEAST, stopping.max_seconds - (time.perf_counter() - begun)))
    result = solve_by(other, solver, stopping=stopping, x0=guess, callback=callback)
    x = wp.array(result.x.numpy()[numbering.place], dtype=result.x.dtype, device=problem.device)
    return replace(result, x=x, problem=problem, version=version_of(problem.A))
