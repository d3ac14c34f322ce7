"""The outer loop of all solves: start, criteria, status, history, best iterate.

Methods only take steps.
"""

from __future__ import annotations

import inspect
import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    Protocol,
    TypeGuard,
    get_args,
    get_type_hints,
    runtime_checkable,
)

import numpy as np
import warp as wp

from warp_lcp.deadline import Deadline, DeadlineReached
from warp_lcp.kernels.fields import Array
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import convert
from warp_lcp.problem.curvature import has_negative_curvature
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.merits import Merits, merits_at
from warp_lcp.problem.operator_protocol import (
    HasFloatingComponents,
    Scratch,
    asks_beyond_storage,
    declared,
    has,
    version_of,
)
from warp_lcp.problem.residual import EPS, NaturalResidual
from warp_lcp.problem.result import Record, SolveResult, SolveStatus
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria, check_criteria, limit_of_steps

if TYPE_CHECKING:
    from warp_lcp.operators.components import FloatingComponents

# Least norm for which residuals 16 digits smaller have squares that float64 can hold.
SMALLEST = 1e-138
# A stagnated residual within this multiple of the rounding estimate is at the precision's floor.
FLOOR_MARGIN = 8.0


class Precision(StrEnum):
    """Types of iterate and corrections.

    `mixed` keeps the iterate in float64 and computes corrections in float32.
    """

    MIXED = "mixed"
    SINGLE = "single"
    DOUBLE = "double"

    @property
    def iterate(self) -> DataType:
        """Warp's type of the iterate."""
        kind: DataType = wp.float32 if self is Precision.SINGLE else wp.float64
        return kind

    @property
    def correction(self) -> DataType:
        """Warp's type of corrections."""
        kind: DataType = wp.float64 if self is Precision.DOUBLE else wp.float32
        return kind

    @property
    def epsilon(self) -> float:
        """Rounding unit of the iterate."""
        return float(np.finfo(np.float32 if self is Precision.SINGLE else np.float64).eps)


PrecisionName = Literal[tuple(map(str, Precision))]


@dataclass(frozen=True)
class Step:
    """Report of one step of a method.

    Args:
        name: a word of the method.
        linear_iterations: number of iterations on the finest grid.
        active: number of unknowns held at a bound, None where the method has no active set.
        failure: the status with which the method ends, None to go on.
        interim: the residual need not fall (an intermediate pivot, or a step that lowers the
            energy): patience and divergence do not apply.
        iterations: number of steps that it represents, for a method that takes several at once.
        due: the residual should be recomputed; otherwise nothing is recorded and the solve goes on,
            unless a limit is reached.
        final: the iterate is the result so far, though an earlier one may have had a smaller
            residual.
        method: name of the method that has taken it; None: that of the solve.
    """

    name: str
    linear_iterations: int = 1
    active: int | None = None
    failure: SolveStatus | None = None
    interim: bool = False
    iterations: int = 1
    due: bool = True
    final: bool = False
    method: str | None = None


class VariationalInequality:
    """Base class of variational inequalities over a convex set K other than a box.

    Find x in K with y(x)'(z - x) >= 0 for all z in K.

    Equivalently, x = P_K(x - y/d) for any d > 0, where P_K is the projection onto K. The natural
    residual is the distance from x to that projection. For a box K = [l, u] and y = A x + b use
    `LCP`. K may depend on x.

    A subclass holds the data of y and K. `wl.solve` needs only the residual: a method and its
    workspace evaluate y and P_K, together in one kernel if they can. The stresses of sand
    (`granular.stress.Stress`) are such a problem.

    The workspace holds the iterate and a `Residual`. The iterate starts with its current values
    unless `x0` is given, and the result's x is that array. A method names the class of problems
    that it solves as `problems`.
    """


class Residual(Protocol):
    """Interface of a natural residual to the loop.

    Attributes:
        norm: at the x of the last evaluation, in units of y or of d x.
        current: whether that is the current iterate; `method_step` sets it to False.
    """

    norm: float
    current: bool

    def evaluate(self, x: DeviceArray) -> float:
        """Return the norm at x, recomputed in float64."""

    def rounding_floor(self, x: DeviceArray, epsilon: float) -> float:
        """Estimate the norm that rounding x to `epsilon` leaves; 0 if there is none."""


@runtime_checkable
class Workspace(Protocol):
    """Memory that a method allocates once for a problem.

    It can be used again when b, the bounds or the cells change in place.
    """

    problem: Any
    x: DeviceArray
    residual: Any  # a NaturalResidual of an LCP, else a Residual
    precision: Precision

    def start(self, *, warm: bool, tolerance: float) -> bool | None:
        """Begin a solve.

        Returns True if steps are wanted even where the start meets the tolerance. A workspace that
        needs the operator's floating components (None if there are none) has another argument
        `floating`.

        Args:
            warm: x is a guess better than clip(0, l, u).
            tolerance: the required residual norm.
        """

    def round_iterate(self) -> None:
        """Round x to its precision."""

    def keep(self) -> None:
        """Store x as the best iterate."""

    def restore(self) -> None:
        """Set x to the best iterate."""


class WorkspaceDefaults:
    """Members of workspaces that have defaults.

    Attributes:
        scratch: stored fields, of 4-byte elements and of bytes, that the search of floating
            components may overwrite before `start`; None: there are none.
        begins_on_device: whether `begin_on_device` may begin a solve.
    """

    scratch: Scratch | None = None
    begins_on_device = False

    @property
    def begins_on_gpu(self) -> bool:
        """Whether a GPU begins a solve before the host knows its problem."""
        return False

    @property
    def has_device_steps(self) -> bool:
        """Whether the device has already taken the next step."""
        return False

    def solution(self) -> DeviceArray | None:
        """Return x in its precision and stored shape; None: x itself."""
        return None

    def begin_on_device(
        self, guess: DeviceArray | None, criteria: StoppingCriteria | MeanCriteria, steps: int
    ) -> float | None:
        """Begin a solve on the device, and take steps, without the host.

        `start` comes next, then the steps. Returns the residual that tolerances refer to, None
        where nothing has begun; by default nothing does.

        Args:
            guess: stored field, or None.
            criteria: of the solve.
            steps: largest number of steps of this solve without the host.
        """
        return None


class WorkspaceBase(WorkspaceDefaults):
    """Base of workspaces: x, its residual, and the best iterate.

    x is moved in place and rounded to its precision; the best iterate is a copy.

    Args:
        problem: the problem.
        precision: of the iterate.
        x: stored field; its own if None.
        residual: evaluated at x; a NaturalResidual of its own if None.
    """

    floating: FloatingComponents | None = None
    _best: DeviceArray | None = None
    _solution: DeviceArray | None = None

    def __init__(
        self,
        problem: LCP,
        precision: str = Precision.DOUBLE,
        *,
        x: DeviceArray | None = None,
        residual: NaturalResidual | None = None,
    ) -> None:
        self.problem, self.precision = problem, Precision(precision)
        self.x = problem.layout.zeros(wp.float64) if x is None else x
        self.residual = NaturalResidual(problem) if residual is None else residual
        self._rounded = (
            problem.layout.zeros(wp.float32) if self.precision is Precision.SINGLE else None
        )

    def keep(self) -> None:
        """Store x as the best iterate."""
        if self._best is None:
            self._best = self.problem.layout.zeros(wp.float64)
        self.problem.layout.copy(self._best, self.x)

    def restore(self) -> None:
        """Set x to the best iterate."""
        if self._best is not None:
            self.problem.layout.copy(self.x, self._best)

    def round_iterate(self, *, launch: Launch = launch_now) -> None:
        """Round x to its precision."""
        self._round(self.x, launch=launch)

    def solution(self) -> DeviceArray:
        """Return x in its precision and stored shape: the same array after each solve."""
        single = self._rounded is not None
        if self._solution is None:
            memory = self.problem.layout.zeros(wp.float32) if single else self.x
            self._solution = memory.reshape(self.problem.layout.stored_shape)
        if single and self.x.device.is_cuda:
            convert(self.x, self._solution.flatten())
        elif single:
            np.copyto(self._solution.numpy().reshape(-1), self.x.numpy(), casting="same_kind")
        return self._solution

    def _finish_move(self, x: DeviceArray) -> None:
        """Choose the constants of floating components after a move of x, and round."""
        if self.floating is not None:
            self.floating.settle(x, self.problem.lower, self.problem.upper)
        self._round(x)

    def _round(self, x: DeviceArray, *, launch: Launch = launch_now) -> None:
        if self._rounded is not None:
            convert(x, self._rounded, launch=launch)
            convert(self._rounded, x, launch=launch)


@runtime_checkable
class Solver(Protocol):
    """A method: its settings; its memory is a Workspace."""

    def init(self, problem: Any) -> Any:
        """Return a workspace for the problem.

        Raises:
            ValueError: the method's assumptions on A do not hold.
        """

    def step(self, problem: Any, work: Any, x: DeviceArray) -> Step:
        """Move x once.

        `work.residual` holds the norm at x, with `current` False, which becomes True only where the
        norm is that at the new x.
        """


def method_step(solver: Solver, problem: Any, work: Workspace) -> Step:
    """Take a step of a method.

    The residual is then current only if the method has evaluated it at the new x.
    """
    work.residual.current = False
    return solver.step(problem, work, work.x)


def evaluate_unless_current(work: Workspace) -> None:
    """Evaluate the residual at the iterate, unless it is current."""
    if not work.residual.current:
        work.residual.evaluate(work.x)


@cache
def _name_of_class(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()


def method_name(method: Solver) -> str:
    """Return a method's name.

    Its `name` if it has one, else the words of its class, joined by hyphens.
    """
    name: str | None = getattr(method, "name", None)  # of the class, or of an instance
    return name or _name_of_class(type(method).__name__)


class ReusableWorkspace(Protocol):
    """A workspace of an earlier solve that has taken a problem's data.

    Attributes:
        work: the workspace; its problem is a copy.
    """

    @property
    def work(self) -> Workspace: ...  # noqa: D102

    def give_back(self, result: SolveResult) -> None:
        """Keep the workspace for later solves, if the result does not share its memory."""


@runtime_checkable
class HasWorkspaceCache(Protocol):
    """A method that keeps the workspace of a solve for later ones."""

    def cached_workspace(self, problem: Any) -> ReusableWorkspace | None:
        """Return a workspace for the problem, None if `init` has to create one."""


@cache
def _implements(kind: type, protocol: type) -> bool:
    """Return whether instances have a protocol's methods; looked up once for each class."""
    return issubclass(kind, protocol)


def is_method(solver: object) -> TypeGuard[Solver]:
    """Return whether an object is a method with its settings."""
    kind: type = type(solver)
    return not isinstance(solver, type) and _implements(kind, Solver)


def caches_workspace(solver: Solver) -> TypeGuard[HasWorkspaceCache]:
    """Return whether a method keeps workspaces."""
    return _implements(type(solver), HasWorkspaceCache)


def cached_workspace_of(solver: Solver, problem: Any) -> ReusableWorkspace | None:
    """Return a workspace of an earlier solve with a problem's data, or None.

    The method must have kept one.
    """
    return solver.cached_workspace(problem) if caches_workspace(solver) else None


def solve(
    problem: LCP | VariationalInequality,
    solver: Solver,
    *,
    stopping: StoppingCriteria | MeanCriteria | None = None,
    x0: Array | None = None,
    workspace: Workspace | None = None,
    callback: Callable[[Record], None] | None = None,
) -> SolveResult:
    """Solve a problem by a given method.

    See `wl.solve`; this function is for callers that choose the method themselves.
    """
    if not isinstance(problem, (LCP, VariationalInequality)):
        raise ValueError(f"problem is a {type(problem).__name__}: expected an LCP")
    if not is_method(solver):
        kind = (
            f"the class {solver.__name__}"
            if isinstance(solver, type)
            else f"a {type(solver).__name__}"
        )
        raise ValueError(
            f"solver is {kind}: expected a name in wl.METHODS or a method with its settings, such "
            "as wl.MinimumMapNewton()"
        )
    check_criteria(stopping)
    reason = refusal(problem, solver)
    if reason is not None:
        raise ValueError(reason)
    comm, loop = (
        (problem.layout.comm, _BoxSolveLoop) if isinstance(problem, LCP) else (None, _SolveLoop)
    )
    stopping = stopping or StoppingCriteria()
    deadline = Deadline(
        stopping.max_seconds if isinstance(stopping, StoppingCriteria) else math.inf, comm
    )
    if workspace is None and (cached := cached_workspace_of(solver, problem)) is not None:
        result = loop(problem, solver, stopping, deadline, cached.work, callback).run(x0)
        cached.give_back(result)
        return result
    work = solver.init(problem) if workspace is None else _checked(workspace, problem, solver)
    return loop(problem, solver, stopping, deadline, work, callback).run(x0)


def refusal(
    problem: LCP | VariationalInequality, solver: Solver, *, preconditioned: bool = True
) -> str | None:
    """Return the reason why a method does not take a problem, None if it does.

    The operator is not examined.

    Args:
        problem: the problem.
        solver: the method.
        preconditioned: whether the method has to use the problem's preconditioner.
    """
    kind, own = type(solver).__name__, declared(solver)
    taken = own.problems or LCP
    if not isinstance(problem, taken):
        return (
            f"{kind} takes problems of the class {taken.__name__}: this is a "
            f"{type(problem).__name__}"
        )
    if not isinstance(problem, LCP):
        return None
    if problem.bounds.affine is not None and not own.affine_bounds:
        return (
            f"{kind} cannot use bounds that are affine in x: use ProjectedSOR or another "
            "sweeping method"
        )
    if preconditioned and problem.preconditioner is not None and not own.preconditioned:
        return (
            f"preconditioner: {kind} does not use one: use MinimumMapNewton or PrimalDualActiveSet"
        )
    if problem.layout.comm is not None and not own.distributed:
        return f"{kind} does not work on several ranks: use ProjectedMultigrid or MinimumMapNewton"
    return None


def _checked(work: Any, problem: Any, solver: Solver) -> Workspace:
    """Return a caller's workspace if it fits the problem and the method.

    Raises:
        ValueError: it does not.
    """
    name, expected = type(solver).__name__, _workspaces_of(type(solver))
    if isinstance(work, type) or not (type(work) in expected or isinstance(work, Workspace)):
        kind = (
            f"the class {work.__name__}" if isinstance(work, type) else f"a {type(work).__name__}"
        )
        raise ValueError(f"workspace is {kind}: expected what {name}.init(problem) returned")
    if expected and type(work) not in expected:
        raise ValueError(
            f"workspace is a {type(work).__name__}, made by another method: expected what "
            f"{name}.init(problem) returned"
        )
    if work.problem is not problem:
        raise ValueError(
            "workspace was made for another problem; it fits only the problem that it was made "
            "for, changed in place or not"
        )
    checked: Workspace = work
    return checked


@cache
def _workspaces_of(method: type) -> tuple[type, ...]:
    """Return the types of workspace in the annotation of a method's `init`.

    Empty if there is no annotation.
    """
    try:
        hint = get_type_hints(method.init).get("return")  # type: ignore[attr-defined]
    except NameError:  # a user's method, with names that exist for type checkers only
        return ()
    return tuple(
        kind
        for kind in get_args(hint) or (hint,)
        if isinstance(kind, type) and kind is not type(None)
    )


def takes_floating(workspace: Workspace) -> bool:
    """Return whether a workspace's `start` accepts floating components."""
    return _takes_floating(type(workspace))


@cache
def _takes_floating(workspace: type) -> bool:
    return "floating" in inspect.signature(workspace.start).parameters  # type: ignore[attr-defined]


class _SolveLoop:
    """State of one solve."""

    def __init__(
        self,
        problem: Any,
        solver: Solver,
        stopping: StoppingCriteria | MeanCriteria,
        deadline: Deadline,
        work: Workspace,
        callback: Callable[[Record], None] | None,
    ) -> None:
        self.problem, self.solver, self.criteria, self.work, self.callback = (
            problem,
            solver,
            stopping,
            work,
            callback,
        )
        self.stopping = (
            stopping
            if isinstance(stopping, StoppingCriteria)
            else limit_of_steps(stopping.max_iterations)
        )
        self.deadline = deadline
        self.residual, self.history = work.residual, list[Record]()
        self.begun = time.perf_counter()
        self.linear = 0
        self.name = method_name(solver)
        self.floating: FloatingComponents | None = None  # components of the operator
        self.best_iteration, self.best_norm, self.progress, self.stopped = 0, math.inf, 0, False
        self.best_method = self.name

    def run(self, x0: Array | None) -> SolveResult:
        """Solve from the current iterate, from x0 or, in a box, from clip(0, l, u)."""
        ended = self._begin(x0)
        if ended is not None:
            return self._finish(ended, 0)
        try:
            with self.deadline:
                given = {"floating": self.floating} if takes_floating(self.work) else {}
                wanted = (
                    self.work.start(warm=self.warm, tolerance=self.tolerance, **given)
                    and self.stopping.max_iterations > 0
                )
                return self._iterate(None if wanted and not self.stopped else self._status(0, None))
        except DeadlineReached:  # the current step is discarded
            self._restore()
            ended = (
                self._solved() if self.residual.norm <= self.tolerance else SolveStatus.TIME_LIMIT
            )
            return self._finish(ended, self.history[-1].iteration)

    def _begin(self, x0: Array | None) -> SolveStatus | None:
        """Evaluate the residual at the start.

        Returns the status if there is nothing to solve, else None.
        """
        if x0 is not None:
            self.work.x.assign(x0)
        self.warm = True
        self._set_reference_residual(self._begun_in_place())
        self._record(0, Step("start", 0))
        self._keep(0)
        return None if math.isfinite(self.reference) else SolveStatus.NON_FINITE

    def _begun_in_place(self) -> float | None:
        """Begin on the device at the current iterate.

        Returns the residual there, None if the device has not begun.
        """
        return self._begin_on_device(None)

    def _begin_on_device(self, x0: Array | None) -> float | None:
        """Begin a solve on the device if the workspace supports that.

        Returns the value of `WorkspaceDefaults.begin_on_device`. With a callback, merits or a
        deadline the host takes each step.
        """
        work = self.work
        if not (isinstance(work, WorkspaceDefaults) and work.begins_on_device):
            return None
        watched = (
            self.callback is not None or self.stopping.merits or self.deadline.ends != math.inf
        )
        guess = None if x0 is None or watched else self.problem.layout.load(x0, wp.float64, "x0")
        return work.begin_on_device(
            guess, self.criteria, 0 if watched else self.stopping.max_iterations
        )

    def _set_reference_residual(self, reference: float | None = None) -> None:
        """Set the residual that tolerances refer to; None: that of the iterate."""
        self.reference = self.residual.evaluate(self.work.x) if reference is None else reference
        if isinstance(self.criteria, MeanCriteria):
            self.stopping = self.criteria.known()
        self.tolerance = self.stopping.tolerance(self.reference)

    def _iterate(self, status: SolveStatus | None) -> SolveResult:
        """Take steps until a status ends the solve."""
        iteration = 0
        while status is None:
            step = method_step(self.solver, self.problem, self.work)
            iteration += step.iterations
            self.linear += step.linear_iterations
            if (
                not step.due
                and iteration < self.stopping.max_iterations
                and self.deadline.left() > 0
            ):
                continue
            evaluate_unless_current(self.work)
            self._record(iteration, step)
            if step.final or self.residual.norm < self.best_norm:
                self._keep(iteration)
            if step.interim:
                self.progress = iteration
            status = self._status(iteration, step.failure, interim=step.interim)
        return self._finish(status, iteration)

    def _status(
        self, iteration: int, failure: SolveStatus | None, *, interim: bool = False
    ) -> SolveStatus | None:
        """Return the status with which the solve ends now, None if it goes on."""
        norm, first = self.residual.norm, max(self.history[0].residual, self.reference)
        if self.stopped and self.tolerance < norm < math.inf:
            return SolveStatus.STOPPED
        if failure is not None and self.tolerance < norm < math.inf:
            return self._floor_or(failure)
        idle = iteration - max(self.best_iteration, self.progress)
        status = self.stopping.status(norm, self.tolerance, first, iteration, idle, interim=interim)
        if status is SolveStatus.STAGNATED or (status is SolveStatus.NON_FINITE and iteration > 0):
            return self._floor_or(status)
        late = SolveStatus.TIME_LIMIT if status is None and self.deadline.left() <= 0 else status
        return self._solved() if status is SolveStatus.CONVERGED else late

    def _solved(self) -> SolveStatus:
        """Return CONVERGED, or FLOOR for a tolerance below the storage rounding of A."""
        share = self.tolerance / max(self.reference, self.tolerance, SMALLEST)
        below = isinstance(self.problem, LCP) and asks_beyond_storage(self.problem.A, share)
        return SolveStatus.FLOOR if below else SolveStatus.CONVERGED

    def _floor_or(self, status: SolveStatus) -> SolveStatus:
        """Return FLOOR if the best residual is at its rounding floor, else the status.

        The solve ends with it. A proof that there is no solution is kept: the rounding errors of
        divergent iterates are arbitrary.
        """
        if self.best_iteration != self.history[-1].iteration:
            self.work.restore()
        floor = FLOOR_MARGIN * self.residual.rounding_floor(
            self.work.x, self.work.precision.epsilon
        )
        return (
            SolveStatus.FLOOR
            if self.best_norm <= floor and status is not SolveStatus.INFEASIBLE
            else status
        )

    def _record(self, iteration: int, step: Step) -> None:
        """Append a record to the history and call the callback."""
        seconds = time.perf_counter() - self.begun
        method = step.method or self.name
        record = Record(
            iteration,
            self.residual.norm,
            self.linear,
            step.active,
            step.name,
            seconds,
            self._merits(),
            method,
        )
        self.history.append(record)
        if self.callback is not None:
            try:
                self.callback(record)
            except StopIteration:
                self.stopped = True

    def _merits(self) -> Merits | None:
        """Return the merit functions at the iterate, None if they are not requested."""
        return None

    def _keep(self, iteration: int) -> None:
        """Store the iterate as the best one."""
        self.work.keep()
        self.best_iteration, self.best_norm = iteration, self.residual.norm
        self.best_method = self.history[-1].method or self.name

    def _restore(self) -> None:
        """Set the iterate to the best one."""
        self.work.restore()
        self.residual.evaluate(self.work.x)

    def _finish(self, status: SolveStatus, iterations: int) -> SolveResult:
        """Return the result, at the best iterate."""
        if self.best_iteration != iterations or not math.isfinite(self.residual.norm):
            self._restore()
        norm = self.residual.norm
        relative = norm / self.reference if self.reference > 0 else 0.0
        version = version_of(self.problem.A) if isinstance(self.problem, LCP) else None
        return SolveResult(
            self._result_x(),
            status,
            iterations,
            self.linear,
            norm,
            relative,
            self.history,
            method=self.best_method,
            problem=self.problem,
            version=version,
        )

    def _result_x(self) -> DeviceArray:
        """Return the x of the result: the iterate in place."""
        return self.work.x


class _BoxSolveLoop(_SolveLoop):
    """State of a solve of an LCP."""

    problem: LCP
    _y: DeviceArray | None = None  # A x + b for merit functions

    def _begin(self, x0: Array | None) -> SolveStatus | None:
        """Start from clip(0, l, u), and go on from x0.

        A relative tolerance refers to the residual at clip(0, l, u).
        """
        reference = self._begin_on_device(x0)
        if reference is not None:
            self.warm = True
            self._set_reference_residual(reference)
            self._record(0, Step("start", 0))
            self._keep(0)
            return None
        x, residual = self.work.x, self.residual
        guess = None if x0 is None else self._guess(x0)
        self.warm = guess is not None
        self.problem.bounds.refresh()
        residual.start(x, keep=False)
        self.work.round_iterate()
        self._set_reference_residual()
        ended = self._trivial()
        if ended is not None:
            self._record(0, Step("start", 0))
            self._keep(0)
            return ended
        if declared(self.solver).definite and has_negative_curvature(self.problem):
            self._record(0, Step("start", 0))
            self._keep(0)
            return SolveStatus.NEGATIVE_CURVATURE
        A = self.problem.A
        floating = (
            A.floating_components(
                self.work.scratch if isinstance(self.work, WorkspaceDefaults) else None
            )
            if has(A, HasFloatingComponents)
            else None
        )
        self.floating = floating
        unattainable = (
            floating.unattainable(self.problem.b, self.problem.lower, self.problem.upper)
            if floating
            else residual.unattainable()
        )
        if guess is not None:
            self._start_at(guess)
        if floating is not None or residual.row_sizes is not None:
            residual.settle_isolated(self.work.x)
            residual.evaluate(self.work.x)
        self._record(0, Step("start", 0))
        self._keep(0)
        return SolveStatus.INFEASIBLE if unattainable > self.tolerance else None

    def _merits(self) -> Merits | None:
        """Return the merit functions at the iterate, None if they are not requested."""
        if not self.stopping.merits:
            return None
        if self._y is None:
            self._y = self.problem.layout.zeros(wp.float64)
        return merits_at(self.problem, self.work.x, self._y)

    def _trivial(self) -> SolveStatus | None:
        """Return the status of a solve that ends at its start, None if it goes on.

        Data that are not finite, or that the start solves. Refuses data so small that every x would
        seem to be a solution.
        """
        if not math.isfinite(self.reference) or not math.isfinite(self.residual.norm_of_b()):
            self._refuse_unrepresentable()
            return SolveStatus.NON_FINITE
        self._refuse_vanishing()
        # The rule for rows implies this where x = 0, and it is cheap.
        small = self.reference <= 4 * EPS * self.residual.norm_of_b()
        return SolveStatus.CONVERGED if small and self.residual.is_rounding(self.work.x) else None

    def _refuse_unrepresentable(self) -> None:
        """Refuse bounds that no x in the method's precision can meet."""
        iterate, p = self.work.precision.iterate, self.problem
        for name, side, sign in (("lower", p.lower, 1), ("upper", p.upper, -1)):
            least = float((sign * side.numpy()).max())  # x must be as large, in this direction
            if float(np.finfo(wp.dtype_to_numpy(iterate)).max) < least < math.inf:
                raise ValueError(
                    f"{name}: x must be {sign * least:.1e}, too large for precision='single': use "
                    "'mixed'"
                )

    def _refuse_vanishing(self) -> None:
        """Refuse data so small that squares of residuals underflow.

        Every x would then seem to be a solution.
        """
        if (
            max(self.reference, self.stopping.atol) >= SMALLEST
            or self.residual.norm_of_b() >= SMALLEST
        ):
            return
        inside = self.problem.unknown.numpy() == 1
        for name, field in (("b", self.problem.b), ("lower, upper", self.work.x)):
            largest, comm = (
                float(np.abs(field.numpy()[inside]).max(initial=0.0)),
                self.problem.layout.comm,
            )
            largest = largest if comm is None else comm.max(largest)
            if 0.0 < largest < SMALLEST:
                raise ValueError(
                    f"{name}: largest value {largest:.1e}, whose square underflows in float64; "
                    "scale b and the bounds by one factor"
                )

    def _guess(self, x0: Array) -> DeviceArray:
        """Return a guess as a stored field that is not the iterate itself."""
        stored = self.problem.layout.load(x0, wp.float64, "x0")
        if self.problem.not_finite(stored):
            raise ValueError(
                f"x0 holds {self.problem.not_finite(stored)} values that are not finite"
            )
        return wp.clone(stored) if stored.ptr == self.work.x.ptr else stored

    def _start_at(self, guess: DeviceArray) -> None:
        self.problem.layout.copy(self.work.x, guess)
        self.residual.start(self.work.x, keep=True)
        self.work.round_iterate()
        if not math.isfinite(self.residual.evaluate(self.work.x)):
            raise ValueError("x0 gives a residual that is not finite")

    def _result_x(self) -> DeviceArray:
        """Return x in the problem's original layout, rounded to its precision."""
        layout, x = self.problem.layout, self.work.x
        if self.problem.in_place and isinstance(self.work, WorkspaceDefaults):
            solution = self.work.solution()
            if solution is not None:
                return solution
        if self.problem.in_place:
            out = x.reshape(layout.stored_shape)
        else:
            out = layout.unload(x)
            out = wp.clone(out) if out.ptr == x.ptr else out
        if self.work.precision.iterate is not wp.float64:
            out = wp.array(out.numpy(), dtype=self.work.precision.iterate, device=layout.device)
        return out
