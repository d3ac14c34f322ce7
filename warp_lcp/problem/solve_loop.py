"""The outer loop of all solves: start, criteria, status, history, best iterate.

Methods only take steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_lcp.deadline import Deadline, DeadlineReached
from warp_lcp.kernels.fields import Array
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.curvature import has_negative_curvature
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.merits import Merits, merits_at
from warp_lcp.problem.method_protocol import (  # noqa: F401 - their older place
    Precision,
    Solver,
    Step,
    Workspace,
    WorkspaceBase,
    WorkspaceDefaults,
    cached_workspace_of,
    checked_workspace,
    evaluate_unless_current,
    is_method,
    method_name,
    method_step,
    takes_floating,
)
from warp_lcp.problem.operator_protocol import (
    HasFloatingComponents,
    asks_beyond_storage,
    declared,
    has,
    version_of,
)
from warp_lcp.problem.residual import EPS
from warp_lcp.problem.result import Record, SolveResult, SolveStatus
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria, check_criteria, limit_of_steps

if TYPE_CHECKING:
    from warp_lcp.operators.components import FloatingComponents

# Least norm for which residuals 16 digits smaller have squares that float64 can hold.
SMALLEST = 1e-138
# A stagnated residual within this multiple of the rounding estimate is at the precision's floor.
FLOOR_MARGIN = 8.0


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
    work = (
        solver.init(problem) if workspace is None else checked_workspace(workspace, problem, solver)
    )
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
