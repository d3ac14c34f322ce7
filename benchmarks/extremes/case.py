"""Hostile cases: expected outcome, attempt and verdict."""

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

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.problem import Problem
from warp_lcp.files import Tables, TableView

PRECISIONS = ("single", "mixed", "double")
RTOL = {"single": 1e-3, "mixed": 1e-8, "double": 1e-8}
BUDGET = 10.0  # CPU seconds of a case; usual cases take milliseconds
LAST_CALL = 6.0  # multiples of the budget after which a case is interrupted
MAX_ITERATIONS = 200
EPS = float(np.finfo(np.float32).eps)
# Largest relative difference of the reported and the recomputed residual, besides rounding.
AGREES = 1e-3
REFUSED, OUT_OF_TIME = "refused", "out of time"
# Errors that no method may raise.
BROKEN = (ArithmeticError, TypeError, LookupError, AttributeError, np.linalg.LinAlgError)
# The precision is exhausted, or the limits are reached.
HONEST = frozenset({"FLOOR", "STAGNATED", "MAX_ITERATIONS", "NON_DESCENT"})


class OutcomeKind(Enum):
    """Kinds of expected outcome."""

    SOLVED = "solved to tolerance"
    REFUSED = "refused before the start"
    STOPPED = "stopped with an honest status"
    EITHER = "solved, or stopped with an honest status"  # if the precision decides
    DONE = "all steps taken"
    CAUGHT = "caught by the checks"  # for solvers that are wrong on purpose


@dataclass(frozen=True)
class ExpectedOutcome:
    """Expected outcome of a case: its kind, statuses and message."""

    expected: OutcomeKind
    statuses: frozenset[str] = frozenset()  # statuses that the case may stop with
    names: str = ""  # text that the message of a refusal must contain

    def __str__(self) -> str:
        detail = "" if self.statuses == HONEST else "/".join(sorted(self.statuses)) or self.names
        return f"{self.expected.value} ({detail})" if detail else self.expected.value


SOLVED = ExpectedOutcome(OutcomeKind.SOLVED)
EITHER = ExpectedOutcome(OutcomeKind.EITHER, HONEST)


def stopped(status: str, names: str = "") -> ExpectedOutcome:
    """Return the promise of a stop with a status."""
    return ExpectedOutcome(OutcomeKind.STOPPED, frozenset({status}), names)


INFEASIBLE, BELOW_ROUNDING = stopped("INFEASIBLE"), stopped("FLOOR")


def refusal(names: str) -> ExpectedOutcome:
    """Return the promise of a ValueError whose message contains `names`."""
    return ExpectedOutcome(OutcomeKind.REFUSED, names=names)


@dataclass
class ExtremeAttempt:
    """Actual outcome of a case."""

    status: str  # status of the result, `refused`, or the message of a simulation
    residual: float | None = None  # independent and relative; None if there is none
    seconds: float = 0.0  # wall time [s]
    message: str = ""  # message of a refusal or a failed step
    # Faults that do not depend on the expected outcome.
    faults: list[str] = field(default_factory=list)
    met: bool = False  # whether the independent residual meets the tolerance
    facts: Tables = field(default_factory=dict)  # further entries of the record
    # CPU time [s] including the judgement; infinite on a GPU.
    processor: float = math.inf

    @property
    def spent(self) -> float:
        """Seconds that count against a budget.

        The CPU time counts where it is known, since other programs on the machine lengthen the wall
        time alone.
        """
        return min(self.seconds, self.processor)

    @property
    def at(self) -> str:
        """Residual as text."""
        return "" if self.residual is None else f" at {self.residual:.1e}"


@dataclass(frozen=True)
class ExtremeCase(ABC):
    """Base class of cases; subclasses implement `tried`."""

    family: str  # the cases that share an expectation
    name: str  # unique in its family
    _: KW_ONLY
    expected: ExpectedOutcome = SOLVED  # expected outcome
    # Other expected outcomes, by precision.
    promises: Mapping[str, ExpectedOutcome] = field(default_factory=dict)
    budget: float = BUDGET  # CPU seconds that a precision may take
    precisions: tuple[str, ...] = PRECISIONS  # precisions in which the case runs

    def promise(self, precision: str) -> ExpectedOutcome:
        """Return the expected outcome in a precision."""
        return self.promises.get(precision, self.expected)

    def attempt(self, precision: str, device: str) -> ExtremeAttempt:
        """Run the case and turn exceptions into outcomes.

        A ValueError is a refusal. Other errors give a status with their names.
        """
        start_time = time.perf_counter()
        try:
            attempt = self.tried(precision, device)
            attempt.seconds = attempt.seconds or time.perf_counter() - start_time
            return attempt
        except (ValueError, *BROKEN) as error:
            broken = isinstance(error, BROKEN)
            return ExtremeAttempt(
                type(error).__name__ if broken else REFUSED,
                seconds=time.perf_counter() - start_time,
                message=str(error),
            )

    @abstractmethod
    def tried(self, precision: str, device: str) -> ExtremeAttempt:
        """Run the case and return its outcome."""


class OverBudgetError(Exception):
    """Error of a case that exceeds its budget."""


@contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Raise OverBudgetError in the enclosed code after some seconds.

    The error is raised at the next instruction of Python.
    """

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
class SolveCase(ExtremeCase):
    """Problem solved by a method and its fallbacks.

    It runs in all precisions of the method, or in "double" if the method has no such setting.
    """

    problem: Callable[[], Problem]  # makes the problem
    method: str = "projected-multigrid"  # a name of `wl.METHODS`
    _: KW_ONLY
    precisions: tuple[str, ...] = ()
    # Criteria in addition to rtol and max_iterations, or in their place.
    stopping: TableView = field(default_factory=dict)
    x0: np.ndarray | None = None  # initial guess
    # Replaces `wl.solve` in tests of the checks.
    solve: Callable[..., wl.SolveResult] = wl.solve
    alone: bool = False  # whether the method runs without its fallbacks

    def __post_init__(self) -> None:
        """Set the precisions."""
        fields = {field.name for field in dataclasses.fields(wl.METHODS[self.method])}
        object.__setattr__(self, "precisions", PRECISIONS if "precision" in fields else ("double",))

    def tried(self, precision: str, device: str) -> ExtremeAttempt:
        """Solve and compare the reported with the independent residual."""
        criteria: Tables = {
            "rtol": RTOL[precision],
            "max_iterations": MAX_ITERATIONS,
            **self.stopping,
        }
        problem, method = self.problem(), wl.METHODS[self.method]
        start_time = time.perf_counter()
        solver = method(precision=precision) if self.precisions == PRECISIONS else method()
        lcp = problem.lcp(device, wp.float32 if precision == "single" else wp.float64)
        solver = solver if self.alone else wl.default_chain(solver, lcp)
        result = self.solve(lcp, solver, stopping=wl.StoppingCriteria(**criteria), x0=self.x0)
        wp.synchronize_device(device)
        return checked(problem, result, criteria, time.perf_counter() - start_time, precision)


def checked(
    problem: Problem, result: wl.SolveResult, criteria: TableView, seconds: float, precision: str
) -> ExtremeAttempt:
    """Return the attempt of a result, with all faults that NumPy finds."""
    exact, x = problem.exact(), problem.unknowns(result.x.numpy())
    if not np.isfinite(x).all():
        return ExtremeAttempt(result.status.name, None, seconds, faults=["x is not finite"])
    own_residual, reference, sizes, single = (
        exact.residual(x),
        exact.residual(exact.start),
        exact.sizes(x),
        precision == "single",
    )
    rounding = 32 * np.finfo(np.float64).eps * sizes
    if problem.rounded(wp.float32 if single else wp.float64):
        rounding += 4 * EPS * sizes
    required = max(criteria["rtol"] * reference, criteria.get("atol", 0.0))
    meets = own_residual <= required * (1 + 1e-6) + rounding
    faults = []
    if result and not meets:
        faults.append(f"CONVERGED at a residual of {own_residual:.1e}, asked for {required:.1e}")
    # A result in single precision is rounded once more where it sits at a bound that is no float32
    # number.
    returned = 0.5 * EPS * sizes if single else 0.0
    # The norm of the residual may overflow where the scaled one does not.
    known = np.isfinite(own_residual) and result.status is not wl.SolveStatus.NON_FINITE
    # Projected multigrid scales by the diagonal without the term of the bodies. The natural
    # residual has the same zeros for any d > 0.
    says = [
        abs(result.residual - of) <= AGREES * of + rounding + returned
        for of in (own_residual, exact.residual(x, bodies=False))
    ]
    if known and not any(says):
        faults.append(f"says the residual is {result.residual:.3e}, it is {own_residual:.3e}")
    # Bounds are rounded as x is.
    beyond = np.maximum(exact.lower - x, x - exact.upper) - (EPS * np.abs(x) if single else 0.0)
    if result and (beyond > 0).any():
        faults.append(f"x is {beyond.max():.1e} outside its bounds")
    if not result and own_residual < 0.99 * required - rounding:
        faults.append(f"{result.status.name} at a solution")
    return ExtremeAttempt(
        result.status.name,
        own_residual / reference if reference > 0 else own_residual,
        seconds,
        faults=faults,
        met=meets,
    )


@dataclass(frozen=True)
class RefusalCase(ExtremeCase):
    """Call that must raise ValueError before any solve."""

    call: Callable[[str, str], object]  # takes device and precision
    names: str  # name of the argument, which the message must contain

    def promise(self, precision: str) -> ExpectedOutcome:
        """Return the promise of a refusal."""
        return refusal(self.names)

    def tried(self, precision: str, device: str) -> ExtremeAttempt:
        """Make the call."""
        made = self.call(device, precision)
        return ExtremeAttempt(made.status.name if isinstance(made, wl.SolveResult) else "accepted")


@dataclass(frozen=True)
class ExtremeVerdict:
    """One case in one precision: expected and actual outcome, and faults."""

    case: ExtremeCase
    precision: str
    promise: ExpectedOutcome
    attempt: ExtremeAttempt
    wrong: Sequence[str]

    @property
    def name(self) -> str:
        """Name, unique among the verdicts."""
        return f"{self.case.family}: {self.case.name}, {self.precision}"

    @property
    def outcome(self) -> str:
        """Actual outcome as text."""
        return "as expected" if not self.wrong else "; ".join(self.wrong)


def judge(case: ExtremeCase, precision: str, device: str) -> ExtremeVerdict:
    """Run a case and return its verdict.

    A case over its budget runs again, since the first run may compile kernels.
    """
    promise, attempt = case.promise(precision), in_time(case, precision, device)
    if attempt.spent > case.budget and attempt.status != OUT_OF_TIME:
        attempt = in_time(case, precision, device)
    wrong = violations(promise, attempt)
    if attempt.spent > case.budget:
        wrong.append(f"{attempt.spent:.1f} s, its budget is {case.budget:g} s")
    return ExtremeVerdict(case, precision, promise, attempt, wrong)


def in_time(case: ExtremeCase, precision: str, device: str) -> ExtremeAttempt:
    """Run a case; interrupt it far beyond its budget."""
    start_time, processor = time.perf_counter(), time.process_time()
    try:
        with interrupted_after(LAST_CALL * case.budget + 60.0):  # one minute more for compilers
            attempt = case.attempt(precision, device)
        if not wp.get_device(device).is_cuda:
            attempt.processor = time.process_time() - processor
        return attempt
    except OverBudgetError:
        return ExtremeAttempt(OUT_OF_TIME, seconds=time.perf_counter() - start_time)


def violations(promise: ExpectedOutcome, attempt: ExtremeAttempt) -> list[str]:
    """Return the faults of an attempt for a promise."""
    wrong, status, expected = list(attempt.faults), attempt.status, promise.expected
    if expected is OutcomeKind.CAUGHT:
        return [] if wrong or status != "CONVERGED" else ["a wrong solver passes"]
    if expected is OutcomeKind.REFUSED:
        if status != REFUSED:
            wrong.append(f"{status}, not refused")
        elif promise.names not in attempt.message:
            wrong.append(f"the message does not name {promise.names}: {attempt.message}")
    elif status == REFUSED:
        wrong.append(f"refused: {attempt.message}")
    elif expected is OutcomeKind.SOLVED and not (status == "CONVERGED" and attempt.met):
        wrong.append(f"{status}{attempt.at}, not solved")
    elif expected is OutcomeKind.STOPPED and status not in promise.statuses:
        wrong.append(f"{status}{attempt.at}, not {'/'.join(sorted(promise.statuses))}")
    elif expected in (OutcomeKind.EITHER, OutcomeKind.DONE) and status not in promise.statuses | {
        "CONVERGED",
        "done",
    }:
        wrong.append(f"{status}{attempt.at} {attempt.message}".rstrip())
    return wrong
