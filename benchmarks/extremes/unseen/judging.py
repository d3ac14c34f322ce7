"""The default method on unseen problems, and every method on small ones.

The default method solves cold and warm. Its iterations are compared with those of the equations
without bounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Unpack

import numpy as np
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes import case, unseen
from warp_lcp.benchmarks.extremes.case import (
    HONEST,
    REFUSED,
    SOLVED,
    ExpectedOutcome,
    ExtremeAttempt,
    ExtremeCase,
    ExtremeVerdict,
    OutcomeKind,
    SolveCase,
    checked,
)
from warp_lcp.benchmarks.extremes.problem import GridProblem, Problem, equality
from warp_lcp.benchmarks.harness.record import RecordTable
from warp_lcp.files import Tables
from warp_lcp.gradients.names import SolveOptions
from warp_lcp.problem.operator_protocol import families

FAMILY, METHODS_FAMILY = FAMILIES = ("unseen", "unseen, every method")
# More iterations than the default, so that the count is known.
CRITERIA: Tables = {"rtol": 1e-6, "max_iterations": 400}
OFTEN = (2.0, 6)  # at most 2 e + 6 iterations, where e is the count for the equations
OFTEN_SHARE = 0.95  # share of the grids on which that must hold
ALWAYS = (3.0, 6)  # at most 3 e + 6 iterations on all grids
WITHOUT_EQUATIONS = 100  # iterations where the equations have no solution: the default limit
# Largest excess of a warm start's iterations on the finest grid over a cold start's c, on
# OFTEN_SHARE of the grids; it is never more than 2 c + 6. Steps are no measure: a cold start that
# continues with Newton's method on the grid's matrix takes fewer and longer ones.
WARM_MORE = 1
# Statuses that no method may return for a solvable small problem.
NO_END = (case.OUT_OF_TIME, "INFEASIBLE", "NON_FINITE")
GAVE_UP = ExpectedOutcome(OutcomeKind.EITHER, HONEST | {"LOCAL_MINIMUM", "DIVERGED"})
GRIDS_A_KIND, MATRICES_A_KIND = 18, 10

Solve = Callable[..., wl.SolveResult]


def solved(
    problem: Problem, solve: Solve, device: str, **more: Unpack[SolveOptions]
) -> tuple[wl.SolveResult, ExtremeAttempt]:
    """Solve by the default method; return the result and its independent check."""
    begun = time.perf_counter()
    result = solve(
        problem.lcp(device, wp.float64), None, stopping=wl.StoppingCriteria(**CRITERIA), **more
    )
    wp.synchronize_device(device)
    return result, checked(problem, result, CRITERIA, time.perf_counter() - begun, "mixed")


@dataclass(frozen=True)
class RandomProblem(ExtremeCase):
    """Random problem, reproducible from its kind and seed."""

    kind: str  # kind of the problem
    seed: int  # seed of the problem
    _: KW_ONLY
    precisions: tuple[str, ...] = ("mixed",)
    solve: Solve = wl.solve  # replaces `wl.solve` in tests of the checks


class UnseenCase(RandomProblem):
    """Random problem for the default method."""

    def __init__(self, kind: str, seed: int, solve: Solve = wl.solve) -> None:
        expected = GAVE_UP if kind in unseen.HARD_MATRICES else SOLVED
        super().__init__(
            FAMILY, f"{kind} {seed}", kind, seed, solve=solve, expected=expected, budget=30.0
        )

    def tried(self, precision: str, device: str) -> ExtremeAttempt:
        """Solve cold and warm, and solve the equations without bounds."""
        unseen_problem = unseen.problem(self.kind, self.seed)
        result, attempt = solved(unseen_problem.problem, self.solve, device)
        attempt.facts = {
            "kind": self.kind,
            "seed": self.seed,
            "unknowns": len(unseen_problem.problem.exact().b),
            "iterations": result.iterations,
        }
        if isinstance(unseen_problem.problem, GridProblem):
            self._against_equations(
                unseen_problem.problem, unseen_problem.allowance, result, attempt, device
            )
        if unseen_problem.then is not None and result:
            self._warm(unseen_problem.then, result, attempt, device)
        return attempt

    def _against_equations(
        self,
        problem: GridProblem,
        allowance: float,
        result: wl.SolveResult,
        attempt: ExtremeAttempt,
        device: str,
    ) -> None:
        free, count = equality(problem), None
        if free is not None:
            of_equations, _ = solved(free, self.solve, device)
            count = of_equations.iterations if of_equations else None
            if count is None:
                attempt.faults.append(f"the equations end with {of_equations.status.name}")
        most = limit(count, ALWAYS, allowance)
        attempt.facts |= {"equality": count, "limit": most, "often": limit(count, OFTEN, allowance)}
        if result and result.iterations > most:
            attempt.faults.append(
                f"{result.iterations} iterations, at most {most:g} are allowed (equality {count})"
            )

    def _warm(
        self, then: GridProblem, before: wl.SolveResult, attempt: ExtremeAttempt, device: str
    ) -> None:
        iterations = {}
        for how, guess in (("cold", {}), ("warm", {"x0": before.x})):
            result, found = solved(then, self.solve, device, **guess)
            iterations[how] = result.linear_iterations
            attempt.faults += [
                f"changed, {how}: {fault}"
                for fault in [*found.faults, *([] if result else [result.status.name])]
            ]
        attempt.facts |= iterations
        if iterations["warm"] > limit(iterations["cold"], OFTEN, 1.0):
            attempt.faults.append(
                f"{iterations['warm']} iterations warm, {iterations['cold']} cold"
            )


def limit(equations: int | None, of: tuple[float, int], allowance: float) -> float:
    """Return the iterations allowed, given those of the equations.

    `equations` is None where these have no solution.
    """
    return (
        float(WITHOUT_EQUATIONS) if equations is None else allowance * (of[0] * equations + of[1])
    )


class EveryMethodCase(RandomProblem):
    """Small random problem for every applicable method.

    No method may report convergence for a wrong answer, or fail otherwise.
    """

    def __init__(self, kind: str, seed: int) -> None:
        super().__init__(
            METHODS_FAMILY,
            f"{kind} {seed} small",
            kind,
            seed,
            expected=ExpectedOutcome(OutcomeKind.DONE),
            budget=180.0,
        )

    def tried(self, precision: str, device: str) -> ExtremeAttempt:
        """Try all methods."""
        problem, start_time = (
            unseen.problem(self.kind, self.seed, small=True).problem,
            time.perf_counter(),
        )
        found = {name: by_method(name, problem, device) for name in wl.METHODS}
        faults, ends = (
            [f"{name}: {fault}" for name, (_, own) in found.items() for fault in own],
            {n: end for n, (end, _) in found.items()},
        )
        facts = {
            "kind": self.kind,
            "seed": self.seed,
            "ends": ends,
            "converged": sum(end == "CONVERGED" for end in ends.values()),
        }
        return ExtremeAttempt(
            "done", None, time.perf_counter() - start_time, faults=faults, facts=facts
        )


def by_method(
    name: str, problem: Problem, device: str, solve: Solve = wl.solve
) -> tuple[str, list[str]]:
    """Return a method's end status on a solvable small problem, and its faults."""
    method, unknowns = wl.METHODS[name], len(problem.exact().b)
    operator = (
        "grid"
        if isinstance(problem, GridProblem)
        else "sparse"
        if scipy.sparse.issparse(problem.matrix)
        else "dense"
    )
    if operator not in families(method) or unknowns > getattr(method, "most_unknowns", np.inf):
        return "not for it", []
    asked = SolveCase(
        METHODS_FAMILY, name, lambda: problem, name, stopping=CRITERIA, solve=solve, alone=True
    )
    attempt = case.in_time(asked, getattr(method, "precision", "mixed"), device)
    if attempt.status == REFUSED:
        return REFUSED, [] if attempt.message else ["refused without a message"]
    wrong = [f"{attempt.status}: {attempt.message}"] if attempt.message else []
    wrong += (
        [f"{attempt.status} of a problem that has a solution"] if attempt.status in NO_END else []
    )
    return attempt.status, attempt.faults + wrong


def cases(
    first: int, grids: int = GRIDS_A_KIND, matrices: int = MATRICES_A_KIND
) -> Iterator[RandomProblem]:
    """Yield problems of all kinds, with seeds from `first` on.

    The first of each kind also goes to every method, in a small size.
    """
    for kind in unseen.KINDS:
        for seed in range(first, first + (grids if kind in unseen.GRIDS else matrices)):
            yield UnseenCase(kind, seed)
    for kind in unseen.KINDS:
        yield EveryMethodCase(kind, first)


def summary(verdicts: Sequence[ExtremeVerdict], first: int) -> tuple[RecordTable, list[str]]:
    """Return a row for each kind, and the faults of all cases together."""
    cases = [v for v in verdicts if v.case.family == FAMILY]
    rows = [
        _row(kind, [v for v in cases if isinstance(v.case, RandomProblem) and v.case.kind == kind])
        for kind in unseen.KINDS
    ]
    counted = [v.attempt for v in cases if v.attempt.facts.get("equality") is not None]
    often = [
        a for a in counted if a.status == "CONVERGED" and a.facts["iterations"] <= a.facts["often"]
    ]
    share = len(often) / max(len(counted), 1)
    factor, more = OFTEN
    within = (
        f"{share:.1%} of {len(counted)} grids take at most {factor:g} times the equality's "
        f"iterations and {more}"
    )
    beyond = [
        v.attempt.facts["warm"] - v.attempt.facts["cold"]
        for v in cases
        if "warm" in v.attempt.facts
    ]
    warm_share = sum(more <= WARM_MORE for more in beyond) / max(len(beyond), 1)
    warm = (
        f"{warm_share:.1%} of {len(beyond)} warm starts take at most {WARM_MORE} iteration more "
        "than cold ones"
    )
    remark = (
        f"Seeds from {first} on, {len(cases)} problems; {within}, {warm}; the limit of both is "
        f"{OFTEN_SHARE:.0%}. "
    )
    remark += f"`--seed {first}` runs them again."
    columns = [
        "kind",
        "number",
        "failures",
        "iterations, mean",
        "most",
        "equality, mean",
        "worst ratio",
        "warm beyond cold, most",
    ]
    wrong = [f"{FAMILY}: only {within}"] if counted and share < OFTEN_SHARE else []
    wrong += [f"{FAMILY}: only {warm}"] if beyond and warm_share < OFTEN_SHARE else []
    return RecordTable(
        "Unseen problems", [*columns, "slowest [s]"], [row for row in rows if row], remark
    ), wrong


def _row(kind: str, own_verdicts: Sequence[ExtremeVerdict]) -> list[str]:
    if not own_verdicts:
        return []
    facts = [v.attempt.facts for v in own_verdicts]
    counts = [f["iterations"] for f in facts if "iterations" in f] or [0]
    pairs = [(f["iterations"], f["equality"]) for f in facts if f.get("equality") is not None]
    warm = [f["warm"] - f["cold"] for f in facts if "warm" in f]
    of_equations = (
        [f"{np.mean([e for _, e in pairs]):.1f}", f"{max(i / max(e, 1) for i, e in pairs):.1f}"]
        if pairs
        else ["-", "-"]
    )
    row = [
        kind,
        str(len(own_verdicts)),
        str(sum(bool(v.wrong) for v in own_verdicts)),
        f"{np.mean(counts):.1f}",
        str(max(counts)),
        *of_equations,
    ]
    return [
        *row,
        f"{max(warm):+d}" if warm else "-",
        f"{max(v.attempt.seconds for v in own_verdicts):.1f}",
    ]
