"""Fallback: methods in order, each with a condition under which it takes over."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import FunctionType
from typing import Any, Protocol, TypeAlias, runtime_checkable

import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import (
    Precision,
    ReusableWorkspace,
    Solver,
    Step,
    Workspace,
    WorkspaceDefaults,
    cached_workspace_of,
    evaluate_unless_current,
    is_method,
    method_name,
    method_step,
    takes_floating,
)
from warp_lcp.problem.operator_protocol import MethodChain, declared, takes
from warp_lcp.problem.pickling import Reduced
from warp_lcp.problem.residual import EPS
from warp_lcp.problem.result import SolveResult, SolveStatus
from warp_lcp.problem.solve_loop import FLOOR_MARGIN, VariationalInequality, refusal
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria

WINDOW = 10  # steps over which the fall of the residual is measured
FIRST = 20  # steps before which `crawls` is False: residuals of conjugate gradients rise and fall
MOST = 30  # steps that a solve may still need at that pace: assembly and set-up cost about as much
STALLED = 10  # steps without a smaller residual after which a method stalls
PROGRESS = 0.999  # a residual above this part of the smallest so far is no progress
WEAK = 30  # iterations of a linear solve that show a weak preconditioner
GRACE = StoppingCriteria.patience  # steps after a hand-over in which the residual need not fall
BATCH = 0.1  # factor by which a batch of steps reduces the residual
# Attributes of a workspace that do not change, and that the outer loop reads.
PROVED = (SolveStatus.INFEASIBLE, SolveStatus.NEGATIVE_CURVATURE)


class Progress:
    """Residuals and steps of the current method, as its conditions see them.

    Attributes:
        problem: the problem.
        tolerance: required residual norm.
        least: smallest residual norm so far, at the start of each step.
        norms: residual norms there.
        step: the last step; None before the first.
        waited: number of consecutive steps, none of them interim, that have not reduced the
            smallest residual.
    """

    def __init__(self, problem: LCP | VariationalInequality, tolerance: float) -> None:
        self.problem, self.tolerance = problem, tolerance
        self.begin()

    def begin(self) -> None:
        """Reset for a new method."""
        self.least: list[float] = []
        self.norms: list[float] = []
        self.step: Step | None = None
        self.waited, self._smallest = 0, math.inf

    def record(self, norm: float) -> None:
        """Record the residual norm at the start of a step."""
        least, interim = self.least, self.step is not None and self.step.interim
        self.norms.append(norm)
        least.append(norm if not least or norm < least[-1] else least[-1])
        self.waited = 0 if interim or norm <= PROGRESS * self._smallest else self.waited + 1
        if interim or norm < self._smallest:
            self._smallest = norm

    @property
    def taken(self) -> int:
        """Number of steps that the method has taken."""
        return len(self.norms) - 1


Condition = Callable[[Progress], bool]


def fails(progress: Progress) -> bool:
    """Return whether the last step has failed, such as with NON_DESCENT or STAGNATED."""
    return progress.step is not None and progress.step.failure is not None


def stalls(progress: Progress) -> bool:
    """Return whether the last step has failed, or 10 steps brought no progress."""
    return progress.waited >= STALLED or (
        progress.step is not None and progress.step.failure is not None
    )


def crawls(progress: Progress) -> bool:
    """Return whether the tolerance is more than 30 steps away at the present pace.

    The pace is that of the last 10 steps; it is not judged before 20 steps. The tolerance counts as
    at least float64's rounding of the first residual.
    """
    if len(progress.least) <= FIRST:
        return False
    least, target = progress.least[-1], max(progress.tolerance, EPS * progress.least[0])
    return least > target and math.log(least / target) > MOST / WINDOW * math.log(
        progress.least[-1 - WINDOW] / least
    )


def slow_linear_solves(progress: Progress) -> bool:
    """Return whether the last step has taken 30 linear iterations or more.

    Its preconditioner is weak then.
    """
    return progress.step is not None and progress.step.linear_iterations >= WEAK


@runtime_checkable
class HasInitAfter(Protocol):
    """A method that can reuse the workspace of the method before it.

    For example its multigrid hierarchy.
    """

    def init_after(self, problem: Any, before: Workspace) -> Workspace:
        """Return a workspace, as `init` does.

        Args:
            problem: the problem.
            before: the workspace of the method that hands over.
        """


@dataclass(frozen=True)
class FallbackEntry:
    """A method of a chain, with the condition under which it takes over.

    Args:
        method: with its settings.
        when: condition under which it takes over; not used for the first one.
        restart: begin at clip(0, l, u) instead of where the method before has ended.
        batch: steps of the method, at most, that count as one step of the chain, which ends earlier
            where the residual has fallen to a tenth. For methods whose steps are cheap.
    """

    method: Solver
    when: Condition = fails
    restart: bool = False
    batch: int = 1


EntryLike: TypeAlias = "Solver | tuple[Solver, Condition] | FallbackEntry"


class Fallback(MethodChain):
    """Chain of methods, each of which takes over as soon as its condition holds.

    Before each step the condition of the next method that takes the problem is evaluated. Methods
    that do not take the problem, and one equal to the current method, are skipped. If the condition
    holds, the next method gets the iterate: the best one if the last step has failed; after a
    restarted method, the one that the restarted method was given. It also gets the tolerance, the
    floating components, and what its `init_after` reuses of the workspace before. There is no
    hand-over where the residual is at its rounding floor (FLOOR), except by a restarted method, or
    where the last step has proved that there is no solution. The residual of the first workspace
    judges all iterates. Each `Record` names its method.

    Args:
        entries: a method, then pairs (method, condition) or `FallbackEntry` objects. Conditions:
            `fails`, `stalls`, `crawls`, `slow_linear_solves`, or your own function of a `Progress`.

    Raises:
        ValueError: there is no method, or an entry is of another kind.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> chain = wl.Fallback(wl.ProjectedSOR(), (wl.Lemke(), wl.stalls))
        >>> A = np.array([[0.0, 1.0], [-1.0, 0.0]]) + 0.01 * np.eye(2)
        >>> problem = wl.LCP(A, np.array([-1.0, 1.0]))
        >>> print(wl.solve(problem, chain).method)
        lemke
    """

    def __init__(self, *entries: EntryLike) -> None:
        if not entries:
            raise ValueError("Fallback: give at least one method")
        object.__setattr__(
            self, "entries", tuple(_entry(given, first=k == 0) for k, given in enumerate(entries))
        )

    entries: tuple[FallbackEntry, ...]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"Fallback is frozen: make a new one to change {name}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Fallback) and self.entries == other.entries

    def __hash__(self) -> int:
        return hash(self.entries)

    def __repr__(self) -> str:
        entries = (_described(entry, first=k == 0) for k, entry in enumerate(self.entries))
        return f"Fallback({', '.join(entries)})"

    def __str__(self) -> str:
        """Return the methods in order, each with its condition."""
        first, *others = self.entries
        return ", then ".join(
            [
                _named(first.method),
                *(f"{_named(entry.method)} ({_condition(entry)})" for entry in others),
            ]
        )

    def __reduce__(self) -> Reduced:
        return Fallback, self.entries

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the first method: `supports`, `precision`, ..."""
        if name.startswith("__") or name == "entries":
            raise AttributeError(name)
        return getattr(self.entries[0].method, name)

    @property
    def first(self) -> Solver:
        """The method that begins."""
        return self.entries[0].method

    @property
    def name(self) -> str:
        """Name of the first method."""
        return method_name(self.first)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the methods, in order."""
        return tuple(method_name(entry.method) for entry in self.entries)

    def init(self, problem: LCP | VariationalInequality) -> FallbackWorkspace:
        """Return a workspace; later methods create theirs when they take over.

        Raises:
            ValueError: the first method does not take the problem.
        """
        return FallbackWorkspace(problem, self.entries, self.entries[0].method.init(problem))

    def cached_workspace(self, problem: LCP) -> CachedChain | None:
        """Return the workspace of an earlier solve, if the first method keeps one."""
        first = self.entries[0].method
        lent = cached_workspace_of(first, problem)
        return (
            None
            if lent is None
            else CachedChain(lent, FallbackWorkspace(problem, self.entries, lent.work))
        )

    def step(
        self, problem: LCP | VariationalInequality, work: FallbackWorkspace, x: DeviceArray
    ) -> Step:
        """Take a step of the current method, after a hand-over if one is due."""
        return work.step()


@dataclass(frozen=True)
class CachedChain:
    """A chain's workspace around one that the first method keeps between solves.

    Args:
        lent: of the first method.
        work: of the chain.
    """

    lent: ReusableWorkspace
    work: FallbackWorkspace

    def give_back(self, result: SolveResult) -> None:
        """Keep the first method's workspace for the next solve."""
        self.lent.give_back(result)


class FallbackWorkspace(WorkspaceDefaults):
    """Workspace of a chain for one problem.

    Attributes that are not its own are those of the first method's workspace. While that method is
    the current one, a step costs little more than its own: residuals are recorded, and conditions
    evaluated.

    Attributes:
        x: the iterate, a stored field.
        residual: judges all iterates.
        precision: of the iterate.

    Args:
        problem: the problem.
        entries: the chain.
        first: workspace of the first method; it has the iterate and the residual of the whole
            solve.
    """

    def __init__(
        self,
        problem: LCP | VariationalInequality,
        entries: tuple[FallbackEntry, ...],
        first: Workspace,
    ) -> None:
        self.problem, self._entries, self._first = problem, entries, first
        self.x, self.residual, self.round_iterate = first.x, first.residual, first.round_iterate
        self.precision = (
            first.precision
            if isinstance(first.precision, Precision)
            else Precision(first.precision)
        )
        self._optional = first if isinstance(first, WorkspaceDefaults) else WorkspaceDefaults()
        self.scratch, self.begins_on_device = (
            self._optional.scratch,
            self._optional.begins_on_device,
        )
        # Workspaces by position in the chain; None: the method does not take the problem.
        self._works: dict[int, Workspace | None] = {0: first}
        # By position: whether a method takes such a problem, before it has a workspace.
        self._suited: dict[int, bool] = {}
        self._best: DeviceArray | None = None
        self._place = 0
        # The iterate that the current method was given, if it is a restarted one.
        self._start: DeviceArray | None = None
        # Whether only the rounding floor prevents a hand-over.
        self._floored = False
        # Whether the best iterate is stored here and no longer by the first workspace.
        self._left_first = False
        self._at_best, self._best_norm = False, math.inf

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the first method's workspace."""
        if name in ("_first", "__setstate__"):
            raise AttributeError(name)
        return getattr(self._first, name)

    @property
    def has_device_steps(self) -> bool:
        """Whether the first method's device has already taken the next step."""
        return self._optional.has_device_steps

    @property
    def begins_on_gpu(self) -> bool:
        """Whether a GPU begins the first method's solve before the host knows its problem."""
        return self._optional.begins_on_gpu

    def solution(self) -> DeviceArray | None:
        """Return x as the first method's workspace does."""
        return self._optional.solution()

    def begin_on_device(
        self, guess: DeviceArray | None, criteria: StoppingCriteria | MeanCriteria, steps: int
    ) -> float | None:
        """Begin a solve on the device by the first method."""
        return self._optional.begin_on_device(guess, criteria, steps)

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> bool | None:
        """Begin with the first method, at an iterate that `keep` has stored.

        The operator may have changed.
        """
        self._place, self._since, self._floating = 0, 0, floating
        if self._left_first:
            self._left_first = False
            self._first.keep()
        self._progress = Progress(self.problem, tolerance)
        given = {"floating": floating} if takes_floating(self._first) else {}
        return self._first.start(warm=warm, tolerance=tolerance, **given)

    @property
    def _current(self) -> Workspace:
        """Workspace of the current method."""
        work = self._works[self._place]
        assert work is not None, "a method that does not take the problem is not chosen"
        return work

    def keep(self) -> None:
        """Store x as the best iterate."""
        self._at_best, self._best_norm = True, self.residual.norm
        if not self._left_first:
            self._first.keep()
            return
        self._store_best()
        work = self._current
        if work is not self._first:
            work.keep()

    def restore(self) -> None:
        """Set x to the best iterate."""
        if not self._left_first:
            self._first.restore()
        elif self._best is not None:
            wp.copy(self.x, self._best)
        self._at_best = True

    def step(self) -> Step:
        """Hand over if a condition holds, then take a step.

        A failure with which a condition holds is replaced by an interim step: the next step then
        hands over.
        """
        progress, first, at_first = self._progress, self._first, self._place == 0
        progress.record(self.residual.norm)
        # No hand-over while the device has already taken the step.
        ahead = at_first and self._optional.has_device_steps
        if not ahead and (place := self._due()) is not None:
            self._hand_over(place)
            at_first = False
        self._at_best = False
        if at_first:
            done = progress.step = self._entries[0].method.step(self.problem, first, first.x)
            if ahead:
                return done
        else:
            done = progress.step = self._advance()
            patient = self._since <= GRACE or (
                self._place + 1 < len(self._entries) and not self._floored
            )
            name = done.method or method_name(self._entries[self._place].method)
            done = replace(done, interim=done.interim or patient, method=name)
        if done.failure is not None and done.failure not in PROVED:
            evaluate_unless_current(self)
            if self._due() is not None:  # at the next step
                return replace(done, failure=None, interim=True)
        return done

    def _due(self) -> int | None:
        """Return the position of the method that takes over now, None if none does."""
        self._floored = False
        for entry in self._entries[self._place + 1 :]:
            if entry.when(self._progress):
                break
        else:
            return None  # conditions cost less than the tests below
        for place in range(self._place + 1, len(self._entries)):
            entry = self._entries[place]
            if entry.method == self._entries[self._place].method or not self._may_take(place):
                continue
            if not entry.when(self._progress):
                return None
            # A path that is joined far from the start reaches large x, where rounding errors are
            # large: the method before it was not at its rounding floor.
            if not self._entries[self._place].restart and self._at_floor():
                self._floored = True
                return None
            if self._workspace(place) is not None:
                return place
        return None

    def _may_take(self, place: int) -> bool:
        """Return whether a method takes the problem, without creating its workspace."""
        if place in self._works:
            return self._workspace(place) is not None
        if place not in self._suited:
            method, p = self._entries[place].method, self.problem
            suits = not isinstance(p, LCP) or takes(method, p.A)
            self._suited[place] = suits and refusal(p, method, preconditioned=False) is None
        return self._suited[place]

    def _at_floor(self) -> bool:
        """Return whether the residual, here or of the best iterate, is at its floor.

        The rounding floor is the residual that rounding errors leave.
        """
        floor = FLOOR_MARGIN * self.residual.rounding_floor(self.x, self.precision.epsilon)
        return bool(min(self.residual.norm, self._best_norm) <= floor)

    def _workspace(self, place: int) -> Workspace | None:
        """Return the workspace of a method, None if it does not take the problem."""
        if place not in self._works:
            self._works[place] = self._workspace_of(self._entries[place].method)
        work = self._works[place]
        return (
            None
            if work is None or (self._floating is not None and not takes_floating(work))
            else work
        )

    def _workspace_of(self, method: Solver) -> Workspace | None:
        """Return a workspace of a method, None if it does not take the problem.

        An equal method of the chain shares its workspace.
        """
        same = next(
            (
                k
                for k, work in self._works.items()
                if work is not None and self._entries[k].method == method
            ),
            None,
        )
        if same is not None:
            return self._works[same]
        before = self._current
        try:
            return (
                method.init_after(self.problem, before)
                if isinstance(method, HasInitAfter)
                else method.init(self.problem)
            )
        except ValueError:
            return None

    def _hand_over(self, place: int) -> None:
        """Start the method at a position of the chain.

        It begins at the iterate or at clip(0, l, u).
        """
        entry, before, work = (
            self._entries[place],
            self._entries[self._place],
            self._workspace(place),
        )
        failed = fails(self._progress)
        if not self._left_first:
            self._leave_first()
        if before.restart and self._start is not None:
            wp.copy(self.x, self._start)
        elif failed and not self._at_best:
            wp.copy(self.x, self._best)
        if entry.restart:
            self._start = wp.clone(self.x)
        self._place, self._since = place, 0
        self._progress.begin()
        assert work is not None, "`_due` returns methods that take the problem"
        self._begin(work, restart=entry.restart)

    def _leave_first(self) -> None:
        """Store the best iterate here.

        The first workspace cannot restore it once other methods change x.
        """
        first = self._first
        if self._at_best:
            self._store_best()
        else:
            now = wp.clone(first.x)
            first.restore()
            self._store_best()
            wp.copy(first.x, now)
        self._left_first = True

    def _store_best(self) -> None:
        if self._best is None:
            self._best = wp.clone(self.x)
        else:
            wp.copy(self._best, self.x)

    def _begin(self, work: Workspace, *, restart: bool) -> None:
        """Start a workspace as the outer loop does, from x or from clip(0, l, u)."""
        residual, box = work.residual, isinstance(self.problem, LCP)
        now = wp.clone(self.x)
        if box:
            residual.start(work.x, keep=False)
        if not restart:
            wp.copy(work.x, now)
            if box:
                residual.start(work.x, keep=True)
        work.round_iterate()
        residual.evaluate(work.x)
        work.keep()
        given = {"floating": self._floating} if takes_floating(work) else {}
        work.start(warm=not restart, tolerance=self._progress.tolerance, **given)
        if work is not self._first:
            self._copy_iterate(work)
            self.residual.evaluate(self.x)
        self._progress.record(self.residual.norm)

    def _advance(self) -> Step:
        """Take a step, or a batch of steps, of a later method; write the iterate to x."""
        entry, work, first = self._entries[self._place], self._current, self._first
        self._since += 1
        done = self._one_step(entry.method, work) if entry.batch == 1 else self._batch(entry, work)
        if work is not first:
            self._copy_iterate(work)
        return done

    def _copy_iterate(self, work: Workspace) -> None:
        """Copy the iterate of the current method to x."""
        wp.copy(self.x, work.x)
        self._first.round_iterate()
        self.residual.current = False

    def _one_step(self, method: Solver, work: Workspace) -> Step:
        done = method_step(method, self.problem, work)
        evaluate_unless_current(work)
        return done

    def _batch(self, entry: FallbackEntry, work: Workspace) -> Step:
        """Take steps until the residual has fallen to a tenth.

        The step fails with STAGNATED if the residual does not fall for GRACE steps.

        The target is max(tolerance, BATCH norm) with the norm of the residual before.
        """
        residual, linear, idle, sank = work.residual, 0, 0, False
        least, target = residual.norm, max(self._progress.tolerance, BATCH * residual.norm)
        done = Step("none", 0)
        for _ in range(entry.batch):
            done = self._one_step(entry.method, work)
            linear, sank = linear + done.linear_iterations, sank or done.interim
            idle = 0 if done.interim or residual.norm < least else idle + 1
            least = min(least, residual.norm)
            if done.failure is not None or residual.norm <= target:
                break
            if idle >= GRACE:
                done = replace(done, failure=SolveStatus.STAGNATED)
                break
        return replace(done, linear_iterations=linear, interim=sank)


def _entry(pair: EntryLike, *, first: bool) -> FallbackEntry:
    """Return an argument of `Fallback` as an entry."""
    if isinstance(pair, FallbackEntry):
        entry = pair
    elif isinstance(pair, tuple) and len(pair) == 2:
        entry = FallbackEntry(*pair)
    elif first:
        entry = FallbackEntry(pair)
    else:
        raise ValueError(
            f"Fallback: {pair!r} must be a pair (method, condition) or an FallbackEntry"
        )
    method = entry.method
    if not is_method(method):
        raise ValueError(
            f"Fallback: {method!r} must be a method with its settings, such as "
            "wl.MinimumMapNewton()"
        )
    if not callable(entry.when):
        raise ValueError(
            f"Fallback: {entry.when!r} must be a condition, a function of a Progress, such as "
            "wl.stalls"
        )
    return entry


def _described(entry: FallbackEntry, *, first: bool) -> str:
    """Describe an entry in words."""
    return (
        method_name(entry.method)
        if first
        else f"({method_name(entry.method)}, {_condition(entry)})"
    )


def _named(method: Solver) -> str:
    """Return a method's name, with the form of A that it works on if that differs."""
    return method_name(method) + declared(method).form


def _condition(entry: FallbackEntry) -> str:
    return entry.when.__name__ if isinstance(entry.when, FunctionType) else repr(entry.when)
