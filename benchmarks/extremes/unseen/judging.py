"""What the default method makes of unseen problems, cold, warm and against their equations; and every method of small ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes import unseen
from warp_lcp.benchmarks.extremes.case import (
    HONEST,
    REFUSED,
    SOLVED,
    Attempt,
    Expected,
    OverBudgetError,
    Promise,
    Verdict,
    checked,
    interrupted_after,
)
from warp_lcp.benchmarks.extremes.problem import GridProblem, MatrixProblem
from warp_lcp.benchmarks.extremes.unseen.draw import Unseen, equality
from warp_lcp.benchmarks.harness.record import Table
from warp_lcp.problem.protocol import families

FAMILY = "unseen"
METHODS_FAMILY = "unseen, every method"
FAMILIES = (FAMILY, METHODS_FAMILY)
CRITERIA: dict[str, Any] = {"rtol": 1e-6, "max_iterations": 400}  # more than the default, so that the count is known
OFTEN = (2.0, 6)  # iterations are at most 2 e + 6, e those of the equations,
OFTEN_SHARE = 0.95  # on this share of the grids,
ALWAYS = (3.0, 6)  # and never more than 3 e + 6
WITHOUT_EQUATIONS = 100  # iterations where they have no solution: what a user gets by default
WARM_MORE = 1  # iterations that a warm start may take beyond a cold one
METHOD_SECONDS = 120.0  # after which a method hangs on a small problem, compilers included
GAVE_UP = Promise(Expected.EITHER, HONEST | {"LOCAL_MINIMUM", "DIVERGED"})
BROKEN = (ArithmeticError, TypeError, LookupError, AttributeError, np.linalg.LinAlgError)  # what no method may end with
GRIDS_A_KIND, MATRICES_A_KIND = 18, 10

Solve = Callable[..., wl.SolveResult]


def unknowns(problem: GridProblem | MatrixProblem) -> int:
    """Return how many there are."""
    return int((problem.cells == wl.FLUID).sum()) if isinstance(problem, GridProblem) else len(problem.b)


def solved(problem: GridProblem | MatrixProblem, solve: Solve, device: str, **more: Any) -> tuple[wl.SolveResult, Attempt]:
    """Solve by the default method; return the result and what an independent residual says of it."""
    begun = time.perf_counter()
    lcp = problem.lcp(device, wp.float64)
    result = solve(lcp, None, stopping=wl.StoppingCriteria(**CRITERIA), **more)
    wp.synchronize_device(device)
    return result, checked(problem, result, CRITERIA, time.perf_counter() - begun, "mixed")


@dataclass(frozen=True)
class UnseenCase:
    """A random problem given to the default method."""

    kind: str  # of problem
    seed: int  # of it
    solve: Solve = wl.solve  # stands in for `wl.solve`, where something wrong is to be caught
    family: str = FAMILY
    budget: float = 30.0
    precisions: tuple[str, ...] = ("mixed",)

    @property
    def name(self) -> str:
        """Kind and seed, by which it can be made again."""
        return f"{self.kind} {self.seed}"

    def promise(self, precision: str) -> Promise:
        """Return what it must come to."""
        return GAVE_UP if self.kind in unseen.HARD_MATRICES else SOLVED

    def attempt(self, precision: str, device: str) -> Attempt:
        """Solve, cold and warm, and the equations."""
        begun = time.perf_counter()
        drawn = unseen.problem(self.kind, self.seed)
        facts = {"kind": self.kind, "seed": self.seed, "unknowns": unknowns(drawn.problem)}
        try:
            return self._solved(drawn, facts, device)
        except (ValueError, *BROKEN) as error:
            status = REFUSED if isinstance(error, ValueError) else type(error).__name__
            return Attempt(status, None, time.perf_counter() - begun, str(error), facts=facts)

    def _solved(self, drawn: Unseen, facts: dict[str, Any], device: str) -> Attempt:
        result, attempt = solved(drawn.problem, self.solve, device)
        attempt.facts = facts | {"iterations": result.iterations}
        if isinstance(drawn.problem, GridProblem):
            self._against_equations(drawn, result, attempt, device)
        if drawn.then is not None and result:
            self._warm(drawn.then, result, attempt, device)
        return attempt

    def _against_equations(self, drawn: Unseen, result: wl.SolveResult, attempt: Attempt, device: str) -> None:
        free = equality(drawn.problem)  # type: ignore[arg-type]
        count = None
        if free is not None:
            of_equations, _ = solved(free, self.solve, device)
            count = of_equations.iterations if of_equations else None
            if count is None:
                attempt.faults.append(f"the equations end with {of_equations.status.name}")
        most = limit(count, ALWAYS, drawn.allowance)
        attempt.facts |= {"equality": count, "limit": most, "often": limit(count, OFTEN, drawn.allowance)}
        if result and result.iterations > most:
            attempt.faults.append(f"{result.iterations} iterations, at most {most:g} are allowed (equality {count})")

    def _warm(self, then: GridProblem, before: wl.SolveResult, attempt: Attempt, device: str) -> None:
        cold, of_cold = solved(then, self.solve, device)
        warm, of_warm = solved(then, self.solve, device, x0=before.x)
        attempt.facts |= {"warm": warm.iterations, "cold": cold.iterations}
        attempt.faults += [f"changed, {how}: {fault}" for how, one in (("cold", of_cold), ("warm", of_warm)) for fault in one.faults]
        attempt.faults += [f"changed, {how}: {r.status.name}" for how, r in (("cold", cold), ("warm", warm)) if not r]
        if warm.iterations > cold.iterations + WARM_MORE:
            attempt.faults.append(f"{warm.iterations} iterations warm, {cold.iterations} cold")


def limit(equations: int | None, of: tuple[float, int], allowance: float) -> float:
    """Return how many iterations are allowed for those of the equations; None where these have no solution."""
    return float(WITHOUT_EQUATIONS) if equations is None else allowance * (of[0] * equations + of[1])


@dataclass(frozen=True)
class EveryMethodCase:
    """A small random problem given to every method that takes it: none may call something a solution that is none, or fail otherwise."""

    kind: str  # of problem
    seed: int  # of it
    family: str = METHODS_FAMILY
    budget: float = 180.0
    precisions: tuple[str, ...] = ("mixed",)

    @property
    def name(self) -> str:
        """Kind and seed, by which it can be made again."""
        return f"{self.kind} {self.seed} small"

    def promise(self, precision: str) -> Promise:
        """Return that whatever ends, ends as it says."""
        return Promise(Expected.DONE)

    def attempt(self, precision: str, device: str) -> Attempt:
        """Try all methods."""
        problem = unseen.problem(self.kind, self.seed, small=True).problem
        begun, faults = time.perf_counter(), list[str]()
        ends: dict[str, str] = {}
        for name in wl.METHODS:
            ends[name], found = by_method(name, problem, device)
            faults += [f"{name}: {fault}" for fault in found]
        facts = {"kind": self.kind, "seed": self.seed, "ends": ends, "converged": sum(end == "CONVERGED" for end in ends.values())}
        return Attempt("done", None, time.perf_counter() - begun, faults=faults, facts=facts)


def by_method(name: str, problem: GridProblem | MatrixProblem, device: str, solve: Solve = wl.solve) -> tuple[str, list[str]]:
    """Return how a method ends on a small problem that has a solution, and what is wrong with that."""
    method: Any = wl.METHODS[name]
    lcp = problem.lcp(device, wp.float64)
    operator = "grid" if isinstance(problem, GridProblem) else "sparse" if scipy.sparse.issparse(problem.matrix) else "dense"
    if operator not in families(method) or unknowns(problem) > getattr(method, "most_unknowns", np.inf):
        return "not for it", []
    try:
        with interrupted_after(METHOD_SECONDS):
            result = solve(lcp, method(), stopping=wl.StoppingCriteria(**CRITERIA))
    except ValueError as refusal:
        return "refused", [] if str(refusal) else ["refused without a message"]
    except OverBudgetError:
        return "out of time", [f"more than {METHOD_SECONDS:g} s for {unknowns(problem)} unknowns"]
    except BROKEN as error:
        return type(error).__name__, [f"{type(error).__name__}: {error}"]
    attempt = checked(problem, result, CRITERIA, 0.0, "mixed")
    wrong = [f"{result.status.name} of a problem that has a solution"] if result.status.name in ("INFEASIBLE", "NON_FINITE") else []
    return result.status.name, attempt.faults + wrong


def cases(first: int, grids: int = GRIDS_A_KIND, matrices: int = MATRICES_A_KIND) -> Iterator[UnseenCase | EveryMethodCase]:
    """Yield problems of all kinds, seeds from `first` on; of each kind the first is given to every method too, small."""
    for kind in unseen.KINDS:
        for seed in range(first, first + (grids if kind in unseen.GRIDS else matrices)):
            yield UnseenCase(kind, seed)
    for kind in unseen.KINDS:
        yield EveryMethodCase(kind, first)


def summary(verdicts: Sequence[Verdict], first: int) -> tuple[Table, list[str]]:
    """Return a row a kind, and what is wrong with all together."""
    own = [v for v in verdicts if v.case.family == FAMILY]
    rows = [_row(kind, [v for v in own if v.attempt.facts.get("kind") == kind]) for kind in unseen.KINDS]
    counted = [v.attempt for v in own if v.attempt.facts.get("equality") is not None]
    often = [a for a in counted if a.status == "CONVERGED" and a.facts["iterations"] <= a.facts["often"]]
    share = len(often) / max(len(counted), 1)
    factor, more = OFTEN
    within = f"{share:.1%} of {len(counted)} grids take at most {factor:g} times the equality's iterations and {more}"
    remark = f"Seeds from {first} on, {len(own)} problems; {within}, the limit is {OFTEN_SHARE:.0%}. `--seed {first}` runs them again."
    columns = ["kind", "number", "failures", "iterations, mean", "most", "equality, mean", "worst ratio", "warm beyond cold, most"]
    columns.append("slowest [s]")
    wrong = [f"{FAMILY}: only {within}"] if counted and share < OFTEN_SHARE else []
    return Table("Unseen problems", columns, [row for row in rows if row], remark), wrong


def _row(kind: str, own: Sequence[Verdict]) -> list[str]:
    if not own:
        return []
    facts = [v.attempt.facts for v in own]
    counts = [f["iterations"] for f in facts if "iterations" in f] or [0]
    pairs = [(f["iterations"], f["equality"]) for f in facts if f.get("equality") is not None]
    warm = [f["warm"] - f["cold"] for f in facts if "warm" in f]
    return [
        kind,
        str(len(own)),
        str(sum(bool(v.wrong) for v in own)),
        f"{np.mean(counts):.1f}",
        str(max(counts)),
        f"{np.mean([e for _, e in pairs]):.1f}" if pairs else "-",
        f"{max(i / max(e, 1) for i, e in pairs):.1f}" if pairs else "-",
        f"{max(warm):+d}" if warm else "-",
        f"{max(v.attempt.seconds for v in own):.1f}",
    ]
