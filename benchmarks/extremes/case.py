"""A hostile case, what it must come to, what it came to, and whether that is as it must be."""

from __future__ import annotations

import dataclasses
import math
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from enum import Enum
from types import FrameType
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.problem import Problem

PRECISIONS = ("single", "mixed", "double")
RTOL = {"single": 1e-3, "mixed": 1e-8, "double": 1e-8}
BUDGET = 10.0  # seconds of a case; usual ones take milliseconds
LAST_CALL = 6.0  # multiples of the budget after which a case is interrupted
MAX_ITERATIONS = 200
EPS = float(np.finfo(np.float32).eps)
# of a residual: how far what a result says may be from what is found, besides rounding
AGREES = 1e-3
REFUSED, OUT_OF_TIME = "refused", "out of time"
# what no method may end with
BROKEN = (ArithmeticError, TypeError, LookupError, AttributeError, np.linalg.LinAlgError)
# the precision does not go further, or not in this time
HONEST = frozenset({"FLOOR", "STAGNATED", "MAX_ITERATIONS", "NON_DESCENT"})


class Expected(Enum):
    """What a case must come to."""

    SOLVED = "solved to tolerance"
    REFUSED = "refused before the start"
    STOPPED = "stopped with an honest status"
    EITHER = "solved, or stopped with an honest status"  # where the precision decides
    DONE = "all steps taken"
    CAUGHT = "caught by the checks"  # of a solver that is wrong on purpose


@dataclass(frozen=True)
class Promise:
    """What a case must come to: a kind, and what belongs to it."""

    expected: Expected
    statuses: frozenset[str] = frozenset()  # the statuses it may stop with
    names: str = ""  # what the message of a refusal must contain

    def __str__(self) -> str:
        detail = "" if self.statuses == HONEST else "/".join(sorted(self.statuses)) or self.names
        return f"{self.expected.value} ({detail})" if detail else self.expected.value


SOLVED = Promise(Expected.SOLVED)
EITHER = Promise(Expected.EITHER, HONEST)


def stopped(status: str, names: str = "") -> Promise:
    """Return the promise of an end with a status."""
    return Promise(Expected.STOPPED, frozenset({status}), names)


INFEASIBLE, BELOW_ROUNDING = stopped("INFEASIBLE"), stopped("FLOOR")


def refusal(names: str) -> Promise:
    """Return the promise of a ValueError whose message contains `names`."""
    return Promise(Expected.REFUSED, names=names)


@dataclass
class Attempt:
    """What a case came to."""

    status: str  # of the result, or `refused`, or what a simulation says
    residual: float | None = None  # independent and relative; None where there is none
    seconds: float = 0.0  # wall time [s]
    message: str = ""  # of a refusal or a failed step
    faults: list[str] = field(default_factory=list)  # what is wrong whatever was expected
    met: bool = False  # whether the independent residual meets the tolerance
    facts: dict[str, Any] = field(default_factory=dict)  # what else a record keeps
    # processor time [s] with what is judged; unknown where a GPU does the work
    processor: float = math.inf

    @property
    def spent(self) -> float:
        """Seconds that count against a budget: other programs on the machine lengthen the wall time alone."""
        return min(self.seconds, self.processor)

    @property
    def at(self) -> str:
        """The residual in words."""
        return "" if self.residual is None else f" at {self.residual:.1e}"


@dataclass(frozen=True)
class Case(ABC):
    """What can be attempted; subclasses try."""

    family: str  # the cases that share an expectation
    name: str  # unique in its family
    _: KW_ONLY
    expected: Promise = SOLVED  # what it must come to,
    # in these precisions something else
    promises: Mapping[str, Promise] = field(default_factory=dict)
    budget: float = BUDGET  # seconds that a precision may take
    precisions: tuple[str, ...] = PRECISIONS  # those in which it is tried

    def promise(self, precision: str) -> Promise:
        """Return what it must come to."""
        return self.promises.get(precision, self.expected)

    def attempt(self, precision: str, device: str) -> Attempt:
        """Try; a ValueError is a refusal, other errors are the status by their names."""
        begun = time.perf_counter()
        try:
            attempt = self.tried(precision, device)
            attempt.seconds = attempt.seconds or time.perf_counter() - begun
            return attempt
        except (ValueError, *BROKEN) as error:
            broken = isinstance(error, BROKEN)
            return Attempt(
                type(error).__name__ if broken else REFUSED,
                seconds=time.perf_counter() - begun,
                message=str(error),
            )

    @abstractmethod
    def tried(self, precision: str, device: str) -> Attempt:
        """Return what comes of it."""


class OverBudgetError(Exception):
    """A case takes longer than it may."""


@contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Interrupt what takes longer, at the next instruction of Python."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise OverBudgetError

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@dataclass(frozen=True)
class SolveCase(Case):
    """A problem given to a method and those that take over, in the precisions it has; "double" if it has no choice."""

    problem: Callable[[], Problem]  # makes the problem
    method: str = "projected-multigrid"  # of `wl.METHODS`
    _: KW_ONLY
    precisions: tuple[str, ...] = ()
    # criteria besides rtol and max_iterations, or instead of them
    stopping: Mapping[str, Any] = field(default_factory=dict)
    x0: np.ndarray | None = None  # a guess
    # stands in for `wl.solve`, where something wrong is to be caught
    solve: Callable[..., wl.SolveResult] = wl.solve
    alone: bool = False  # whether the method's default chain is left out

    def __post_init__(self) -> None:
        """Fill in the precisions."""
        fields = {field.name for field in dataclasses.fields(wl.METHODS[self.method])}
        object.__setattr__(self, "precisions", PRECISIONS if "precision" in fields else ("double",))

    def tried(self, precision: str, device: str) -> Attempt:
        """Solve, and compare what the result says with the independent residual."""
        criteria: dict[str, Any] = {
            "rtol": RTOL[precision],
            "max_iterations": MAX_ITERATIONS,
            **self.stopping,
        }
        problem, method = self.problem(), wl.METHODS[self.method]
        begun = time.perf_counter()
        solver = method(precision=precision) if self.precisions == PRECISIONS else method()
        lcp = problem.lcp(device, wp.float32 if precision == "single" else wp.float64)
        solver = solver if self.alone else wl.default_chain(solver, lcp)
        result = self.solve(lcp, solver, stopping=wl.StoppingCriteria(**criteria), x0=self.x0)
        wp.synchronize_device(device)
        return checked(problem, result, criteria, time.perf_counter() - begun, precision)


def checked(
    problem: Problem,
    result: wl.SolveResult,
    criteria: Mapping[str, Any],
    seconds: float,
    precision: str,
) -> Attempt:
    """Return the attempt that a result is, with all that NumPy finds wrong about it."""
    exact, x = problem.exact(), problem.unknowns(result.x.numpy())
    if not np.isfinite(x).all():
        return Attempt(result.status.name, None, seconds, faults=["x is not finite"])
    own, reference, sizes, single = (
        exact.residual(x),
        exact.residual(exact.start),
        exact.sizes(x),
        precision == "single",
    )
    rounding = 32 * np.finfo(np.float64).eps * sizes
    if problem.rounded(wp.float32 if single else wp.float64):
        rounding += 4 * EPS * sizes
    wanted = max(criteria["rtol"] * reference, criteria.get("atol", 0.0))
    met = own <= wanted * (1 + 1e-6) + rounding
    faults = []
    if result and not met:
        faults.append(f"CONVERGED at a residual of {own:.1e}, asked for {wanted:.1e}")
    # a result in single precision is rounded once more where it sits at a bound that is no float32
    # number
    returned = 0.5 * EPS * sizes if single else 0.0
    # its norm may overflow where the scaled one does not
    known = np.isfinite(own) and result.status is not wl.SolveStatus.NON_FINITE
    # projected multigrid scales by the diagonal without the bodies' term: any d > 0 has the same
    # zeros
    says = [
        abs(result.residual - of) <= AGREES * of + rounding + returned
        for of in (own, exact.residual(x, bodies=False))
    ]
    if known and not any(says):
        faults.append(f"says the residual is {result.residual:.3e}, it is {own:.3e}")
    # bounds are rounded as x is
    beyond = np.maximum(exact.lower - x, x - exact.upper) - (EPS * np.abs(x) if single else 0.0)
    if result and (beyond > 0).any():
        faults.append(f"x is {beyond.max():.1e} outside its bounds")
    if not result and own < 0.99 * wanted - rounding:
        faults.append(f"{result.status.name} at a solution")
    return Attempt(
        result.status.name,
        own / reference if reference > 0 else own,
        seconds,
        faults=faults,
        met=met,
    )


@dataclass(frozen=True)
class RefusalCase(Case):
    """A call that must raise ValueError before anything is solved."""

    call: Callable[[str, str], object]  # takes device and precision
    names: str  # what the message must contain: the argument

    def promise(self, precision: str) -> Promise:
        """Return the refusal."""
        return refusal(self.names)

    def tried(self, precision: str, device: str) -> Attempt:
        """Call."""
        made = self.call(device, precision)
        return Attempt(made.status.name if isinstance(made, wl.SolveResult) else "accepted")


@dataclass(frozen=True)
class Verdict:
    """A case in one precision: what was expected, what came, and what is wrong with that."""

    case: Case
    precision: str
    promise: Promise
    attempt: Attempt
    wrong: Sequence[str]

    @property
    def name(self) -> str:
        """Unique among the verdicts."""
        return f"{self.case.family}: {self.case.name}, {self.precision}"

    @property
    def outcome(self) -> str:
        """What it came to, in words."""
        return "as expected" if not self.wrong else "; ".join(self.wrong)


def judge(case: Case, precision: str, device: str) -> Verdict:
    """Attempt a case and say what is wrong with what it comes to; one over its budget is tried again, kernels compile in the first."""
    promise, attempt = case.promise(precision), in_time(case, precision, device)
    if attempt.spent > case.budget and attempt.status != OUT_OF_TIME:
        attempt = in_time(case, precision, device)
    wrong = violations(promise, attempt)
    if attempt.spent > case.budget:
        wrong.append(f"{attempt.spent:.1f} s, its budget is {case.budget:g} s")
    return Verdict(case, precision, promise, attempt, wrong)


def in_time(case: Case, precision: str, device: str) -> Attempt:
    """Attempt a case; what takes far longer than its budget is interrupted."""
    begun, processor = time.perf_counter(), time.process_time()
    try:
        with interrupted_after(LAST_CALL * case.budget + 60.0):  # a minute for compilers
            attempt = case.attempt(precision, device)
        if not wp.get_device(device).is_cuda:
            attempt.processor = time.process_time() - processor
        return attempt
    except OverBudgetError:
        return Attempt(OUT_OF_TIME, seconds=time.perf_counter() - begun)


def violations(promise: Promise, attempt: Attempt) -> list[str]:
    """Return what is wrong with an attempt for a promise."""
    wrong, status, expected = list(attempt.faults), attempt.status, promise.expected
    if expected is Expected.CAUGHT:
        return [] if wrong or status != "CONVERGED" else ["a wrong solver passes"]
    if expected is Expected.REFUSED:
        if status != REFUSED:
            wrong.append(f"{status}, not refused")
        elif promise.names not in attempt.message:
            wrong.append(f"the message does not name {promise.names}: {attempt.message}")
    elif status == REFUSED:
        wrong.append(f"refused: {attempt.message}")
    elif expected is Expected.SOLVED and not (status == "CONVERGED" and attempt.met):
        wrong.append(f"{status}{attempt.at}, not solved")
    elif expected is Expected.STOPPED and status not in promise.statuses:
        wrong.append(f"{status}{attempt.at}, not {'/'.join(sorted(promise.statuses))}")
    elif expected in (Expected.EITHER, Expected.DONE) and status not in promise.statuses | {
        "CONVERGED",
        "done",
    }:
        wrong.append(f"{status}{attempt.at} {attempt.message}".rstrip())
    return wrong
