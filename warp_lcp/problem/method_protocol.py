"""Interface of methods: settings, workspaces, steps.

`init(problem)` of a method allocates a workspace, in which `step` moves the iterate. The loop of
`warp_lcp.problem.solve_loop` calls both.
"""

from __future__ import annotations

import inspect
import re
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

from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import convert
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import Scratch
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveResult, SolveStatus
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria

if TYPE_CHECKING:
    from warp_lcp.operators.components import FloatingComponents


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


def checked_workspace(work: Any, problem: Any, solver: Solver) -> Workspace:
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
