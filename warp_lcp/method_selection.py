"""`wl.solve`: solve by a given method or the recommended one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Never, cast

from warp_lcp.default_chain import default_chain
from warp_lcp.kernels.fields import Array
from warp_lcp.method_rules import Attempt, method_for, steps_allowed
from warp_lcp.operators.matrix_conversion import RestatedProblem, renumbered
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Solver, Workspace
from warp_lcp.problem.operator_protocol import declared
from warp_lcp.problem.residual import EPS
from warp_lcp.problem.result import Record, SolveResult, SolveStatus
from warp_lcp.problem.solve_loop import VariationalInequality
from warp_lcp.problem.solve_loop import solve as solve_by
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria, check_criteria
from warp_lcp.recommend import Recommendation, criteria, recommend
from warp_lcp.solvers.registry import method_of

LEAST = 1e-9  # seconds for a solve whose set-up has used up its time
# Of a limit of at least FEW steps, a method for matrices leaves 1/RESERVED to its alternatives.
RESERVED, FEW = 4, 40
ENDED = (
    SolveStatus.CONVERGED,
    SolveStatus.INFEASIBLE,
    SolveStatus.STOPPED,
    SolveStatus.TIME_LIMIT,
    SolveStatus.FLOOR,
    SolveStatus.NEGATIVE_CURVATURE,
)

Criteria = StoppingCriteria | MeanCriteria
RecordCallback = Callable[[Record], None]
Run = Callable[
    [RestatedProblem, Solver, Criteria | None, Array | None, RecordCallback | None], SolveResult
]


def default_method(problem: LCP) -> Solver:
    """Return the method that `wl.solve` tries first, as named by `wl.recommend`."""
    return recommend(problem).method


# What other libraries call stopping criteria.
OTHER_NAMES = {
    "tol": "rtol",
    "tolerance": "rtol",
    "maxiter": "max_iterations",
    "max_iter": "max_iterations",
}


def solve(
    problem: LCP | VariationalInequality,
    solver: Solver | str | None = None,
    *,
    stopping: StoppingCriteria | MeanCriteria | None = None,
    x0: Array | None = None,
    workspace: Workspace | None = None,
    callback: Callable[[Record], None] | None = None,
    fallback: bool = True,
    **misplaced: Never,
) -> SolveResult:
    """Solve a problem with a given or the recommended method.

    Args:
        problem: the LCP, or a problem over another convex set than a box.
        solver: the method, such as `wl.MinimumMapNewton()`, or its name in `wl.METHODS` for its
            default settings, such as "psor": it alone is used. None: the method of `wl.recommend`;
            where it stalls, the methods of its chain (`wl.default_chain`) continue from its
            iterate, and if these fail, its alternatives begin from the same start. `stopping`
            limits the sum of their steps; the history has all of them, each record names its
            method, and the result's `method` names the one that found x. Sparse matrices that are a
            compact stencil on a box of cells in its natural order, x first, are then solved as a
            grid problem; the result's `grid` has its shape.
        stopping: the criteria, with relative and absolute tolerance `rtol` and `atol`;
            `StoppingCriteria()` if None, with the limit of steps that `wl.recommend` gives if there
            is no solver.
        x0: a guess, field of the problem's shape, projected onto the bounds; clip(0, l, u) if None
            (over other sets: the current x).
        workspace: result of `solver.init(problem)`, to reuse its memory. Without it, one of a grid
            may be kept for later solves, see `wl.release_workspace`.
        callback: called with each Record, such as `wl.print_progress`; if it raises StopIteration,
            the solve ends with STOPPED.
        fallback: False: without a method, the solve ends with the recommended one, however it ends.
        misplaced: other options are refused, with a hint where they belong.

    Returns:
        The best iterate, its status and recomputed residual, the history. The result's x is the
        caller's to keep, unless the problem works in place or is over another set: then it is the
        workspace's own iterate, overwritten by the next solve with that workspace.

    Raises:
        ValueError: an argument is of another kind, x0 has a wrong shape or is not finite, a
            workspace comes without its solver, or the method cannot take this A.
        TypeError: an option of another name; the message says where it belongs.
    """
    for name in misplaced:
        criterion = OTHER_NAMES.get(name, name)
        if criterion in StoppingCriteria.__dataclass_fields__:
            raise TypeError(
                f"solve takes no {name}: it is a stopping criterion, pass "
                f"stopping=wl.StoppingCriteria({criterion}=...)"
            )
        raise TypeError(
            f"solve takes no {name}: it is a setting of a method, pass for example "
            "wl.ProjectedSOR(omega=1.5)"
        )
    if solver is None and workspace is not None:
        raise ValueError("workspace: pass the solver that made it, too")
    if solver is None and isinstance(problem, VariationalInequality):
        raise ValueError(
            f"solver: a {type(problem).__name__} needs one of its own methods, pass one"
        )
    check_criteria(stopping)
    method = None if solver is None else method_of(solver, "solver")
    if method is None and isinstance(problem, LCP):
        return solve_by_attempts(problem, stopping, x0, callback, fallback=fallback)
    if (
        workspace is None
        and isinstance(problem, LCP)
        and method is not None
        and declared(method).any_numbering
    ):
        begun = time.perf_counter()
        restated = renumbered(problem)
        if restated is not None:
            return solve_restated(
                restated, method, left(stopping or StoppingCriteria(), begun), x0, callback
            )
    # None only where `solve_by` refuses the problem.
    return solve_by(
        problem,
        cast(Solver, method),
        stopping=stopping,
        x0=x0,
        workspace=workspace,
        callback=callback,
    )


def solve_restated(
    restated: RestatedProblem,
    method: Solver,
    stopping: Criteria | None,
    x0: Array | None,
    callback: RecordCallback | None,
) -> SolveResult:
    """Solve a problem in another form; return the result in the original form."""
    found = solve_by(
        restated.problem, method, stopping=stopping, x0=restated.start(x0), callback=callback
    )
    return restated.result(found)


def solve_by_attempts(
    problem: LCP,
    stopping: Criteria | None,
    x0: Array | None,
    callback: RecordCallback | None,
    *,
    fallback: bool = True,
    run: Run = solve_restated,
    reserve: bool = True,
) -> SolveResult:
    """Solve by the attempts of `recommend` in order; return the best result.

    Args:
        problem: the problem.
        stopping: the criteria, whose limits are for the sum of all attempts; None: each attempt has
            its own limit of steps.
        x0: a guess, with which each attempt begins; None: clip(0, l, u).
        callback: called with each record.
        fallback: False: only the first method, without those that take over.
        run: solves a problem by a method.
        reserve: keep a quarter of the steps that are given for the alternatives of a method for
            matrices.
    """
    start_time, accuracy = (
        time.perf_counter(),
        min(max((stopping or StoppingCriteria()).rtol, EPS), 0.5),
    )
    advice, results = recommend(problem, accuracy=accuracy), list[SolveResult]()
    reserve = (
        reserve and fallback and stopping is not None and advice.traits.kind in ("dense", "sparse")
    )
    for attempt in advice.attempts:
        planned = _planned(attempt, problem, advice, accuracy, has_criteria=stopping is not None)
        if planned is None or (planned.alternative and isinstance(stopping, MeanCriteria)):
            continue
        reserves = (
            reserve
            and not planned.alternative
            and (attempt.method is None or bool(advice.alternatives))
        )
        criteria = left(
            stopping or planned.stopping,
            start_time,
            results if stopping is not None else [],
            reserve=reserves,
        )
        if results and criteria.max_iterations == 0:
            break
        method = default_chain(planned.method, planned.chained) if fallback else planned.method
        try:
            result = _recorded(
                partial(run, planned.restated, method, criteria, x0),
                planned.name,
                results,
                callback,
                start_time,
            )
        except ValueError:
            if not results:
                raise
            continue  # a method that refuses this A
        results.append(result)
        if not fallback or result.status in ENDED:
            break
    return _best(results)


@dataclass(frozen=True)
class _PlannedSolve:
    """A planned solve: a method and the form of the problem that it works on.

    Args:
        name: of the method.
        method: with its settings.
        restated: the problem that it works on.
        chained: the same before its unknowns are renumbered; it determines the default chain.
        stopping: criteria where none are given.
        alternative: whether the method is not the recommended one, or is tried again.
    """

    name: str
    method: Solver
    restated: RestatedProblem
    chained: LCP
    stopping: Criteria
    alternative: bool


def _planned(
    attempt: Attempt, problem: LCP, advice: Recommendation, accuracy: float, *, has_criteria: bool
) -> _PlannedSolve | None:
    """Return the solve of an attempt, None if the attempt does not suit the problem.

    Args:
        attempt: of the recommendation.
        problem: as given.
        advice: the recommendation.
        accuracy: relative residual.
        has_criteria: whether the caller has given criteria.
    """
    t = advice.traits
    if not attempt.suits(t):
        return None
    restated = attempt.form(problem) if attempt.form is not None else None
    if attempt.method is None:
        if restated is None:
            return None
        there = recommend(restated.problem, accuracy=accuracy)
        return _PlannedSolve(
            there.name, there.method, restated, restated.problem, there.stopping, alternative=False
        )
    if attempt.again and has_criteria and restated is None:
        return None
    name, first = attempt.method, attempt.method == advice.name and not attempt.again
    method = advice.method if attempt.method == advice.name else method_for(name, t)
    chained = problem if restated is None else restated.problem
    if restated is None and method is not None and declared(method).any_numbering:
        restated = renumbered(problem)
    steps = attempt.steps or steps_allowed(name, t.unknowns)
    stopping = advice.stopping if first else criteria(accuracy, steps)
    return _PlannedSolve(
        name,
        method,
        restated or RestatedProblem(problem, problem),
        chained,
        stopping,
        alternative=not first,
    )


def _recorded(
    solve: Callable[[RecordCallback | None], SolveResult],
    name: str,
    results: list[SolveResult],
    callback: RecordCallback | None,
    start_time: float,
) -> SolveResult:
    """Solve, with the steps and seconds of earlier results added to the records."""
    shifted = partial(
        _after, results[-1].history[-1] if results else None, name, time.perf_counter() - start_time
    )
    result = solve(None if callback is None else lambda record: callback(shifted(record)))
    return replace(
        result, method=result.method or name, history=[shifted(record) for record in result.history]
    )


def _best(results: list[SolveResult]) -> SolveResult:
    """Return the best result, or a proof of infeasibility, with all steps and records."""
    last = results[-1]
    if len(results) == 1:
        return last
    best = (
        last
        if last.status is SolveStatus.INFEASIBLE
        else min(results, key=lambda result: result.residual)
    )
    status = last.status if last.status in ENDED else best.status
    end, history = last.history[-1], [record for result in results for record in result.history]
    return replace(
        best,
        status=status,
        iterations=end.iteration,
        linear_iterations=end.linear_iterations,
        history=history,
    )


def left(
    stopping: Criteria,
    start_time: float,
    results: Sequence[SolveResult] = (),
    *,
    reserve: bool = False,
) -> Criteria:
    """Return criteria with the remaining steps and time.

    Args:
        stopping: criteria for all.
        start_time: start of the solve by `time.perf_counter` [s].
        results: of earlier attempts.
        reserve: keep a quarter of the steps for later attempts.
    """
    most = stopping.max_iterations - (results[-1].history[-1].iteration if results else 0)
    most -= most // RESERVED if reserve and most >= FEW else 0
    changed = (
        stopping
        if most == stopping.max_iterations
        else replace(stopping, max_iterations=max(most, 0))
    )
    if isinstance(changed, StoppingCriteria) and changed.max_seconds < math.inf:
        changed = replace(
            changed,
            max_seconds=max(LEAST, changed.max_seconds - (time.perf_counter() - start_time)),
        )
    return changed


def _after(last: Record | None, name: str, seconds: float, record: Record) -> Record:
    """Return a record with the steps and seconds of earlier attempts added."""
    if last is None:
        return record
    return replace(
        record,
        iteration=last.iteration + record.iteration,
        linear_iterations=last.linear_iterations + record.linear_iterations,
        step=f"start of {name}" if record.iteration == 0 else record.step,
        seconds=seconds + record.seconds,
    )
