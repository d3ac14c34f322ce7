"""`wl.solve`: a given method, or the recommended one and then its alternatives."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Never

import scipy.sparse
import warp as wp

from warp_lcp.default_chain import default_chain
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.matrix_stencil import stencil_of
from warp_lcp.operators.renumbering import Renumbering
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import version_of
from warp_lcp.problem.result import Record, SolveResult, SolveStatus
from warp_lcp.problem.solve import EPS, Solver, VariationalInequality, Workspace
from warp_lcp.problem.solve import solve as solve_by
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria, check_criteria
from warp_lcp.recommend import Recommendation, method_for, recommend, steps_allowed
from warp_lcp.rows.fields import Array
from warp_lcp.solvers.fallback import Fallback
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.solvers.registry import method_of

SMALL = 600  # unknowns up to which a factorization of a dense matrix takes a hundredth of a second
LARGE = 2000  # unknowns from which it pays to look whether a matrix is a grid's
ANY_NUMBERING = (MinimumMapNewton, MPRGP)  # methods whose steps do not depend on the unknowns' order, but for rounding and aggregates
LEAST = 1e-9  # seconds that are left to a solve whose renumbering has taken them all
PATIENT: dict[str, Any] = {"max_iterations": 1000, "patience": 300}  # of bodies of mass ratios to 1e7, whose residual rises and falls
RESERVED, FEW = 4, 40  # one step of four is kept for the alternatives of a method for matrices, of limits from FEW steps on
ENDED = (
    SolveStatus.CONVERGED,
    SolveStatus.INFEASIBLE,
    SolveStatus.STOPPED,
    SolveStatus.TIME_LIMIT,
    SolveStatus.FLOOR,
    SolveStatus.NEGATIVE_CURVATURE,
)

Attempt = Callable[[StoppingCriteria | MeanCriteria, Array | None, Callable[[Record], None] | None], SolveResult]
Run = Callable[[LCP, Solver, StoppingCriteria | MeanCriteria, Array | None, Callable[[Record], None] | None], SolveResult]


def default_method(problem: LCP) -> Solver:
    """Return the method that `wl.solve` tries first, as named by `wl.recommend`."""
    return recommend(problem).method


def solve(
    problem: LCP | VariationalInequality, solver: Solver | str | None = None, *, stopping: StoppingCriteria | MeanCriteria | None = None,
    x0: Array | None = None, workspace: Workspace | None = None, callback: Callable[[Record], None] | None = None, fallback: bool = True,
    **misplaced: Never,
) -> SolveResult:  # fmt: skip
    """Solve a problem by a method.

    Args:
        problem: the LCP, or a problem over another convex set than a box.
        solver: the method, such as `wl.MinimumMapNewton()`, or its name in `wl.METHODS` for its default
            settings, such as "psor": it alone is used. None: the method of `wl.recommend`; where it stops, the methods of its
            chain (`wl.default_chain`) go on from its iterate, and if these fail, its alternatives begin from the same start.
            `stopping` limits the sum of their steps; the history has all of them, each record names its method, and the result's
            `method` names the one that found x. Sparse matrices that are a compact stencil on a box of cells in its natural
            order, x first, are then solved as a grid problem; the result's `grid` has its shape.
        stopping: the criteria; `StoppingCriteria()` if None, with the limit of steps that `wl.recommend` gives if there is no solver.
        x0: a guess, field of the problem's shape, projected onto the bounds; clip(0, l, u) if None (over other sets: x as it is).
        workspace: result of `solver.init(problem)`, to reuse its memory. Without it, one of a grid may be kept for later solves, see
            `wl.release_workspace`.
        callback: called with each Record, such as `wl.print_progress`; if it raises StopIteration,
            the solve ends with STOPPED.
        fallback: False: without a method, the solve ends with the recommended one, however it ends.
        misplaced: other options are refused, with a hint where they belong.

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
            raise TypeError(f"solve takes no {name}: it is a stopping criterion, pass stopping=wl.StoppingCriteria({name}=...)")
        raise TypeError(f"solve takes no {name}: it is a setting of a method, pass for example wl.ProjectedSOR(omega=1.5)")
    if solver is None and workspace is not None:
        raise ValueError("workspace: pass the solver that made it, too")
    if solver is None and isinstance(problem, VariationalInequality):
        raise ValueError(f"solver: a {type(problem).__name__} needs one of its own methods, pass one")
    check_criteria(stopping)
    method: Any = method_of(solver, "solver")
    if method is None and isinstance(problem, LCP):
        return _solve_by_choice(problem, stopping, x0, callback) if fallback else _solve_by_first(problem, stopping, x0, callback)
    if workspace is None and isinstance(problem, LCP) and method is not None:
        return _solve_in_order(problem, method, stopping, x0, callback)
    return solve_by(problem, method, stopping=stopping, x0=x0, workspace=workspace, callback=callback)


def _solve_by_first(
    problem: LCP, stopping: StoppingCriteria | MeanCriteria | None, x0: Array | None, callback: Callable[[Record], None] | None
) -> SolveResult:
    """Solve by the recommended method alone."""
    accuracy = _accuracy(stopping)
    advice = recommend(problem, accuracy=accuracy)
    grid = None if advice.name == "psor" else _as_grid(problem)
    if grid is not None:
        by_grid = recommend(grid, accuracy=accuracy)
        return _solve_as_grid(problem, grid, by_grid.method, stopping or by_grid.stopping, x0, callback)
    return _solve_in_order(problem, advice.method, stopping or advice.stopping, x0, callback)


def _solve_by_choice(
    problem: LCP, stopping: StoppingCriteria | MeanCriteria | None, x0: Array | None, callback: Callable[[Record], None] | None
) -> SolveResult:
    """Solve by the recommended method, then by its alternatives; return the best x."""
    begun, results = time.perf_counter(), list[SolveResult]()
    accuracy = _accuracy(stopping)
    advice = recommend(problem, accuracy=accuracy)
    grid = None if advice.name == "psor" else _as_grid(problem)  # a few sweeps need no hierarchy
    if grid is not None:
        by_grid = recommend(grid, accuracy=accuracy)
        attempt = partial(_solve_as_grid, problem, grid, by_grid.chain)
        criteria = _left(stopping or by_grid.stopping, begun, results, reserve=stopping is not None)
        if _try(results, by_grid.name, attempt, criteria, x0, callback, begun):
            return _best(results)
    criteria = stopping or advice.stopping
    spent = [] if stopping is None else results  # without limits that were given each attempt has its own
    reserve = stopping is not None and bool(advice.alternatives) and advice.traits.kind in ("dense", "sparse")
    attempt = partial(_solve_in_order, problem, advice.chain)
    if not _try(results, advice.name, attempt, _left(criteria, begun, spent, reserve=reserve), x0, callback, begun):
        _try_alternatives(problem, advice, results, stopping, x0, callback, begun)
    return _best(results)


def solve_by_alternatives(
    problem: LCP, first: SolveResult, stopping: StoppingCriteria, x0: Array | None, run: Run, callback: Callable[[Record], None]
) -> SolveResult:
    """Return the result of the recommended method, or of its alternatives, by `run`, where it has failed."""
    if first.status in ENDED:
        return first
    begun, results = time.perf_counter() - first.history[-1].seconds, [first]
    _try_alternatives(problem, recommend(problem, accuracy=_accuracy(stopping)), results, stopping, x0, callback, begun, run)
    return _best(results)


def _try_alternatives(
    problem: LCP, advice: Recommendation, results: list[SolveResult], stopping: StoppingCriteria | MeanCriteria | None, x0: Array | None,
    callback: Callable[[Record], None] | None, begun: float, run: Run | None = None,
) -> None:  # fmt: skip
    """Solve by alternatives until one succeeds or a limit has come."""
    run = run or _solve_in_order
    if _tries_again(problem, advice, stopping):
        criteria = _left(stopping or StoppingCriteria(rtol=advice.stopping.rtol, **PATIENT), begun, [] if stopping is None else results)
        attempt = partial(_solve_in_form, _as_sparse, run, problem, advice.method)
        if criteria.max_iterations > 0 and _try(results, advice.name, attempt, criteria, x0, callback, begun):
            return
    for name in advice.alternatives if not isinstance(stopping, MeanCriteria) else ():
        criteria = _left(
            stopping or StoppingCriteria(max_iterations=steps_allowed(name, advice.traits.unknowns)),
            begun,
            [] if stopping is None else results,
        )
        if criteria.max_iterations == 0:
            return
        attempt = partial(run, problem, default_chain(method_for(name, advice.traits), problem))
        if name == "fischer-newton":
            attempt = partial(_solve_in_form, _as_dense, run, problem, method_for(name, advice.traits))
        try:
            if _try(results, name, attempt, criteria, x0, callback, begun):
                return
        except ValueError:  # a method that refuses this A
            continue


def _tries_again(problem: LCP, advice: Recommendation, stopping: StoppingCriteria | MeanCriteria | None) -> bool:
    """Return whether contacts with friction get inexact steps after exact ones, or more steps of those.

    Free blocks of contacts are singular, and heavy bodies on light ones leave eigenvalues of 1 over the ratio of masses: on a free set
    that is not the solution's, the exact step of a dense matrix is as much too long, where conjugate gradients stop early.
    """
    if advice.name != "subspace-minimization" or not advice.traits.affine:
        return False
    return isinstance(problem.A, DenseOperator) or (stopping is None and isinstance(problem.A, SparseOperator))


def _try(
    results: list[SolveResult], name: str, attempt: Attempt, criteria: StoppingCriteria | MeanCriteria, x0: Array | None,
    callback: Callable[[Record], None] | None, begun: float,
) -> bool:  # fmt: skip
    """Make an attempt and add its result; return whether that ends the solve."""
    shifted = partial(_after, results[-1].history[-1] if results else None, name, time.perf_counter() - begun)
    result = attempt(criteria, x0, None if callback is None else lambda record: callback(shifted(record)))
    results.append(replace(result, method=result.method or name, history=[shifted(record) for record in result.history]))
    return result.status in ENDED


def _best(results: list[SolveResult]) -> SolveResult:
    """Return the best result, or a proof of infeasibility, with all steps and records."""
    last = results[-1]
    if len(results) == 1:
        return last
    best = last if last.status is SolveStatus.INFEASIBLE else min(results, key=lambda result: result.residual)
    status = last.status if last.status in ENDED else best.status
    end, history = last.history[-1], [record for result in results for record in result.history]
    return replace(best, status=status, iterations=end.iteration, linear_iterations=end.linear_iterations, history=history)


def _accuracy(stopping: StoppingCriteria | MeanCriteria | None) -> float:
    return min(max((stopping or StoppingCriteria()).rtol, EPS), 0.5)


def _left(
    stopping: StoppingCriteria | MeanCriteria, begun: float, results: list[SolveResult], *, reserve: bool = False
) -> StoppingCriteria | MeanCriteria:
    """Return criteria with the steps and the time that earlier attempts have left."""
    most = stopping.max_iterations - (results[-1].history[-1].iteration if results else 0)
    most -= most // RESERVED if reserve and most >= FEW else 0
    changed = stopping if most == stopping.max_iterations else replace(stopping, max_iterations=max(most, 0))
    if isinstance(changed, StoppingCriteria) and changed.max_seconds < math.inf:
        changed = replace(changed, max_seconds=max(LEAST, changed.max_seconds - (time.perf_counter() - begun)))
    return changed


def _after(last: Record | None, name: str, seconds: float, record: Record) -> Record:
    """Return a record with the steps and seconds of earlier attempts added."""
    if last is None:
        return record
    return replace(
        record, iteration=last.iteration + record.iteration, linear_iterations=last.linear_iterations + record.linear_iterations,
        step=f"start of {name}" if record.iteration == 0 else record.step, seconds=seconds + record.seconds,
    )  # fmt: skip


def _as_grid(problem: LCP) -> LCP | None:
    """Return a large sparse problem on the grid whose stencil its matrix is, None if it is none."""
    A = problem.A
    if not isinstance(A, SparseOperator) or A.unknowns < LARGE or problem.in_place or problem.preconditioner is not None:
        return None
    stencil = None if problem.bounds.affine is not None else stencil_of(A)
    if stencil is None:
        return None
    return LCP(stencil, *(field.numpy().reshape(stencil.shape) for field in (problem.b, problem.lower, problem.upper)))


def _solve_as_grid(
    problem: LCP, grid: LCP, method: Solver, stopping: StoppingCriteria | MeanCriteria, x0: Array | None,
    callback: Callable[[Record], None] | None,
) -> SolveResult:  # fmt: skip
    """Solve a problem on the grid that its matrix is a stencil of; return x in the problem's shape."""
    start = None if x0 is None else problem.layout.load(x0, wp.float64, "x0").numpy().reshape(grid.A.shape)
    result = solve_by(grid, method, stopping=stopping, x0=start, callback=callback)
    return replace(result, x=result.x.flatten(), grid=grid.A.shape, problem=problem, version=version_of(problem.A))


def _solve_in_form(
    form: Callable[[LCP], DenseOperator | SparseOperator | None], run: Run, problem: LCP, method: Solver,
    stopping: StoppingCriteria | MeanCriteria, x0: Array | None, callback: Callable[[Record], None] | None,
) -> SolveResult:  # fmt: skip
    """Solve a problem with its matrix stored in another form, as it is where there is none."""
    A, p = form(problem), problem
    if A is None:
        return run(p, method, stopping, x0, callback)
    sides = (p.lower.numpy(), p.upper.numpy()) if p.bounds.affine is None else p.bounds.affine.sides
    result = run(LCP(A, p.b.numpy(), *sides), method, stopping, x0, callback)
    return replace(result, problem=p, version=version_of(p.A))


def _as_sparse(problem: LCP) -> SparseOperator | None:
    """Return a dense matrix as a sparse one."""
    A = problem.A
    return (
        SparseOperator(scipy.sparse.csr_array(A.matrix.numpy()), device=A.device, dtype=A.dtype) if isinstance(A, DenseOperator) else None
    )


def _as_dense(problem: LCP) -> DenseOperator | None:
    """Return a small sparse matrix as a dense one: its singular blocks are seen by LAPACK, which is faster than GMRES there, too."""
    A = problem.A
    small = isinstance(A, SparseOperator) and A.unknowns <= SMALL and problem.preconditioner is None
    return DenseOperator(A.matrix().toarray(), device=A.device, dtype=A.dtype) if small and isinstance(A, SparseOperator) else None


def _solve_in_order(
    problem: LCP, solver: Solver, stopping: StoppingCriteria | MeanCriteria | None, x0: Array | None,
    callback: Callable[[Record], None] | None,
) -> SolveResult:  # fmt: skip
    """Solve a problem; matrices numbered at random in the order of Cuthill and McKee."""
    first = solver.entries[0].method if isinstance(solver, Fallback) else solver
    plain = problem.bounds.affine is None and problem.preconditioner is None and isinstance(first, ANY_NUMBERING)
    begun = time.perf_counter()
    found = problem.A.renumbered() if plain and isinstance(problem.A, SparseOperator) else None
    if found is not None:
        return _solve_renumbered(problem, *found, solver, stopping or StoppingCriteria(), x0, callback, begun)
    return solve_by(problem, solver, stopping=stopping, x0=x0, callback=callback)


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
