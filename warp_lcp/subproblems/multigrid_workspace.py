"""Workspace of projected and truncated multigrid cycles on a grid problem.

It has the iterate, its residual with a free set, and a search direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Protocol, cast

import warp as wp

from warp_lcp.kernels import Rows
from warp_lcp.kernels.fields import nothing
from warp_lcp.kernels.launch_graph import CommandBuffer, Launch, as_one_table, launch_now
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.cycle_passes import CLEAR
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.halo_levels import beside_cuts
from warp_lcp.multigrid.multiple_semicoarsening import make_hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Precision, Step, WorkspaceBase
from warp_lcp.problem.operator_protocol import HasStencil
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.subproblems import grid_step_kernels as kernels
from warp_lcp.subproblems.device_iteration import DeviceIteration
from warp_lcp.subproblems.energy_monitor import EnergyMonitor
from warp_lcp.subproblems.residual_and_active_set import ResidualAndActiveSet

if TYPE_CHECKING:
    from warp_lcp.subproblems.low_rank_correction import WoodburyCorrection

AHEAD = 20  # steps that the device may take without the host, which then examines their pace


class CycleMethod(Protocol):
    """Settings of a method that takes monotone cycles.

    Attributes:
        precision: of iterate and corrections.
        cycle: how cycles go.
        monotone_cycles: cycles of a cold start.
    """

    @property
    def precision(self) -> str: ...  # noqa: D102
    @property
    def cycle(self) -> CycleSettings: ...  # noqa: D102
    @property
    def monotone_cycles(self) -> int: ...  # noqa: D102


class EnergyDescentMethod(CycleMethod, Protocol):
    """Settings of a method whose steps minimize an energy.

    Attributes:
        patience: steps without a new least energy before monotone cycles are taken.
    """

    @property
    def patience(self) -> int: ...  # noqa: D102


class MultigridWorkspace(WorkspaceBase):
    """Workspace of `ProjectedMultigrid`; its cycles also serve other grid methods.

    x is moved in place. The best iterate is not stored while it is x, nor when x is one step past
    it, because a step can be undone. It is stored when the residual has risen and another step
    follows.

    Args:
        problem: the problem.
        A: its operator.
        settings: of the method, with `precision`, `monotone_cycles` and `cycle`.
        residual: creates the residual of the problem, the operator and the hierarchy.
        shifted: whether the finest diagonal takes shifts.
        ahead: whether the device may take steps without the host.
        cycles_against_creeping: whether a projected cycle follows a step in which the free set
            creeps.

    Attributes:
        cycles_left: number of projected cycles that come next.
    """

    residual: ResidualAndActiveSet
    readings: tuple[DeviceScalar, ...] = ()  # written by evaluations besides the residual's
    correction: WoodburyCorrection | None = None  # of the cycle, for bodies
    # Limit of runs of projected cycles: after those, the free set is considered to cycle.
    most_runs: float = math.inf
    begins_on_device = True
    # Whether `WoodburyCorrection.note` has been launched for the current free set.
    free_set_noted = False

    def __init__(
        self,
        problem: LCP,
        A: HasStencil,
        settings: CycleMethod,
        *,
        residual: Callable[..., ResidualAndActiveSet] = ResidualAndActiveSet,
        shifted: bool = False,
        ahead: bool = True,
        cycles_against_creeping: bool = True,
    ) -> None:
        precision = Precision(settings.precision)
        real, self.A, self.settings, self.bounded = (
            precision.correction,
            A,
            settings,
            problem.bounded,
        )
        self._cycles_against_creeping = cycles_against_creeping
        self._p = problem.layout.zeros(real)
        # A projected cycle resets the search direction, so its lower bounds may use that memory:
        # finite numbers, and 0 off the unknowns.
        upper = (
            problem.layout.zeros(real) if problem.bounds.may_bind[1] else nothing(real, A.device)
        )
        self.hierarchy = make_hierarchy(
            A.stencil,
            real,
            bounded=self.bounded,
            settings=settings.cycle,
            bounds=(self._p, upper),
            shifted=shifted,
        )
        super().__init__(
            problem,
            precision,
            residual=residual(problem, A, self.hierarchy, rounded=precision is Precision.SINGLE),
        )
        self.flat = Rows.of_fields(problem.layout)
        self._programs: dict[tuple[Hashable, ...], CommandBuffer] = {}  # truncated cycles
        self._mask: DeviceArray | None = None
        self.scratch = self._scratch() if real is wp.float32 else None
        # Steps since the best iterate; whether it has memory of its own.
        self._past, self._stored = 0, False
        self.cycles_left, self.energy_monitor = 0, EnergyMonitor(self.precision.epsilon)
        self._tolerance, self._steps_taken = 0.0, 0  # steps of this solve
        self._device_iteration = (
            DeviceIteration(self) if ahead and DeviceIteration.suits(self) else None
        )
        self._one_table = (
            self._device_iteration is not None
        )  # whether nothing is read back within a step
        self._built = 0  # the version of the free set that the hierarchy was built for
        # Steps that the device may take without the host; whether it has begun the solve.
        self._budget, self._started = 0, False

    @property
    def stale(self) -> bool:
        """Whether the free set has changed since the hierarchy was built."""
        return self._built != self.residual.free_set

    def distrust_hierarchy(self) -> None:
        """Mark the hierarchy for a rebuild before the next cycle."""
        self._built = 0

    def forget_solve(self) -> None:
        """Release the data of the last solve, and clear the search direction.

        No later step may read that direction.
        """
        self.floating = None
        self._p.zero_()
        if self._device_iteration is not None:
            self._device_iteration.forget_guess()

    def begin_on_device(
        self, guess: DeviceArray | None, criteria: StoppingCriteria | MeanCriteria, steps: int
    ) -> float | None:
        """Begin a solve, and take steps, without the host.

        Returns the residual at clip(0, l, u), None where nothing has begun.

        Args:
            guess: stored field; None: the host begins.
            criteria: of the solve.
            steps: largest number of steps without the host in this solve.
        """
        self._budget = steps
        if self._device_iteration is None or guess is None or guess.ptr == self.x.ptr or steps <= 0:
            return None
        self.floating = None
        reference = self._device_iteration.begin(guess, criteria, min(steps, AHEAD))
        self._started = reference is not None
        return reference

    @property
    def begins_on_gpu(self) -> bool:
        """Whether a GPU can begin a solve without the host."""
        return self._device_iteration is not None and self.A.device.is_cuda

    @property
    def exact(self) -> bool:
        """Whether a step changes x by no more than the step itself.

        No constant of a floating component is added then, and x is not rounded.
        """
        return self.floating is None and self._rounded is None

    def _scratch(self) -> tuple[DeviceArray, DeviceArray]:
        """Return memory that is free between cycles, with four bytes and one byte a cell."""
        x, t = self.hierarchy.finest.x, self.hierarchy.finest.t
        return t, wp.array(ptr=x.ptr, dtype=wp.uint8, shape=x.shape, device=x.device)

    def keep(self) -> None:
        """Mark x as the best iterate."""
        self._past, self._stored = 0, False

    def restore(self) -> None:
        """Set x to the best iterate."""
        if self._stored:
            self.problem.layout.copy(self.x, self._best)
        elif self._past == 1:
            self._undo(self.x)
        self.residual.set(kernels.STEP, 0.0)
        self.keep()

    def _leave(self) -> None:
        """Store the best iterate before x moves on.

        It was x, or the x of one step ago.
        """
        if not self._stored and self._past == (1 if self.exact else 0):
            if (
                self._device_iteration is not None
                and self._device_iteration.rows
                and not self.exact
            ):
                self._stored = True  # the device has stored it, and x has moved on
            else:
                self._keep_stored(by_undoing=self.exact)
        self._past += 1

    def store_best(self) -> None:
        """Store the best iterate in memory of its own.

        Before x changes by more than can be undone.
        """
        if not self._stored and self._past <= (1 if self.exact else 0):
            self._keep_stored(by_undoing=self._past == 1)

    def _keep_stored(self, *, by_undoing: bool) -> None:
        """Store x, or the start of its last step."""
        if by_undoing:
            self._undo(self.best())
        else:
            self.problem.layout.copy(self.best(), self.x)
        self._stored = True

    def best(self) -> DeviceArray:
        """Return the memory of the best iterate, allocated at the first call."""
        if self._best is None:
            self._best = self.problem.layout.zeros(wp.float64)
        return self._best

    def _undo(self, out: DeviceArray) -> None:
        """Write the start of the last step."""
        p, scalars = self.problem, self.residual.scalars
        kernels.UNDO.bind(
            self.flat,
            bounds=p.bounds.operands,
            scalars=scalars,
            x=self.x,
            q=self._p,
            unknown=p.unknown,
            before=out,
        ).launch(wp.launch)

    def shorten_step(self, before: float, now: float, whole: float) -> None:
        """Change how far x has moved along the last direction.

        Args:
            before: part of the whole step that x has moved.
            now: part that it is to have moved.
            whole: the step, in units of the direction.
        """
        self.residual.set(kernels.STEP, (before - now) * whole)
        self._undo(self.x)
        self._round(self.x)
        self.residual.set(kernels.STEP, now * whole)

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the search direction; the operator may have changed."""
        self.floating = floating
        self.cycles_left = self.settings.monotone_cycles if self.bounded and not warm else 0
        self.energy_monitor.start(self.residual.energy, self.residual.norm)
        self._tolerance, self._steps_taken = tolerance, 0
        if self._started:
            self._started = False
            return
        self.forget_direction()
        if self.scratch is not None:
            CLEAR.bind(self.flat, x=self.scratch[1]).launch()
        # Corrections in float32 would overflow, or vanish.
        rescale = not 1e-6 < self.residual.norm / self.residual.size < 1e6
        if rescale:
            self.residual.set(kernels.SIZE, self.residual.norm)
        # Unknowns at their bounds leave the free set unless a projected cycle comes next.
        classify = self.cycles_left == 0
        if self.floating is not None:
            self.residual.evaluate(self.x, classify)
            self._project()
        elif rescale or (classify and not self.residual.classified and self.bounded):
            self.residual.evaluate(self.x, classify)

    @property
    def goes_in_circles(self) -> bool:
        """Whether the free set keeps recurring, in a problem in which that may not end."""
        return self.energy_monitor.runs >= self.most_runs

    @property
    def has_device_steps(self) -> bool:
        """Whether the device has taken steps that the host has not read yet."""
        return self._device_iteration is not None and bool(self._device_iteration.rows)

    def wants_monotone_cycle(self) -> bool:
        """Return whether the next step is a projected cycle."""
        if self.cycles_left == 0 and self.bounded:
            due = self.energy_monitor.due(
                cast(EnergyDescentMethod, self.settings).patience
            )  # an active set can cycle
            if due:
                self.begin_cycles(due)
        return self.cycles_left > 0

    def begin_cycles(self, count: int) -> None:
        """Schedule projected cycles.

        Their right-hand side contains all unknowns.
        """
        self.cycles_left = count
        self.forget_direction()
        self.residual.evaluate(self.x, classify=False)

    def monotone_step(self) -> Step:
        """Take a projected cycle on all unknowns.

        x stays in [l, u]; the coarse levels have bounds, too, see `warp_lcp.multigrid.cycle`.
        A projected sweep replaces it once cycles have raised the energy.
        """
        descent = self.energy_monitor
        self._leave()
        self._budget -= 1
        self._steps_taken += 1
        classify = self.cycles_left == 1  # truncated cycles come next
        with (
            as_one_table(self.problem.device, self.problem.layout.comm)
            if self._one_table
            else nullcontext()
        ):
            self.rebuild(classify=self.residual.classified)
            self.cycles_left -= 1
            self._move_monotonely(descent.safe, classify, launch_recorded)
        self.residual.read(classified=classify)
        if self.floating is not None and self.cycles_left == 0:
            self._project()
        descent.weigh(self.judge())
        return Step("monotone cycle", 1, None, interim=descent.sinks)

    def _move_monotonely(self, safe: bool, classify: bool, launch: Launch) -> None:
        """Launch a projected cycle, its step, and the evaluation at its end.

        A sweep if `safe`.
        """
        p, finest = self.problem, self.hierarchy.finest
        lo, hi, bounds, scalars = (
            finest.lower,
            finest.upper,
            p.bounds.operands,
            self.residual.scalars,
        )
        kernels.GAPS.bind(
            self.flat, bounds=bounds, x=self.x, unknown=p.unknown, lo=lo, hi=hi, scalars=scalars
        ).launch(launch)
        (self.hierarchy.projected_sweep if safe else self.hierarchy.monotone_cycle).run()
        self._plan_monotone_step(launch)
        self._advance(classify=classify, launch=launch)

    def _plan_monotone_step(self, launch: Launch) -> None:
        """Take the projected cycle's correction unchanged."""
        finest = self.hierarchy.finest
        finest.stencil.wrap(finest.x, launch=launch)
        launch(
            kernels.plan_whole_step_kernel,
            1,
            [self.residual.scalars, False],
            device=self.problem.device,
        )

    def truncated_step(self) -> Step:
        """Take a truncated step: a linear cycle on the free unknowns.

        Its correction z is made conjugate to the last direction p, and the step is projected:
        x <- clip(x + alpha q, l, u) with q = z + beta p.
        """
        active = self.residual.active
        self._leave()
        self._budget -= 1
        self._steps_taken += 1
        if not self._take_device_step():
            self.rebuild(classify=True)
            if self.floating is None:
                self.step_program().run()
            else:
                self._cycle()
                self._measure()
                self.residual.update(self.x, self._p)
                self._finish_move(self.x)
                self.residual.assess(self.x, classify=True)
            self.residual.read(classified=True)
        if self.floating is not None:
            self._project()
        if self._needs_cycle() and self._cycles_against_creeping:
            self.begin_cycles(1)
        return Step("truncated cycle", 1, active, interim=self.energy_monitor.sinks)

    def _take_device_step(self) -> bool:
        """Let the device take a step, and those that follow it.

        Returns whether it has; the results of one step are then read.
        """
        ahead, left = self._device_iteration, min(self._budget + 1, AHEAD - self._steps_taken)
        if ahead is None or self.floating is not None:
            return False
        # From the best iterate, where steps cannot be undone.
        starts = left > 0 and (self._rounded is None or self._past == 1)
        if not (ahead.rows or (starts and ahead.steps(self._tolerance, left))):
            return False
        self._built = self.residual.free_set
        self.residual.store_evaluation(ahead.rows.popleft(), classified=True)
        return True

    def _needs_cycle(self) -> bool:
        """Judge a truncated step; return whether a projected cycle should follow."""
        return self.energy_monitor.needs_cycle(self.judge(), moved=self.bounded and self.stale)

    def judge(self) -> float:
        """Judge the evaluated step by the energy; return the energy's decrease."""
        return self.energy_monitor.record(self.residual.energy, self.residual.norm)

    def _cycle(self) -> None:
        """Run a cycle on the right-hand side."""
        self.hierarchy.cycle.run()

    def step_program(self) -> CommandBuffer:
        """Return the launches of a truncated cycle.

        They are stored by key: bounds in place may be coded now and not in the next solve.
        """
        key = self.program_key()
        program = self._programs.get(key)
        if program is None:
            program = self._programs[key] = CommandBuffer(self.A.device)
            self._correct(program)
            self._advance(classify=True, launch=program.launch)
        return program

    def problem_key(self) -> tuple[Hashable, ...]:
        """Return the key of launches that depend on the problem's data."""
        lower, least, upper, most, code = self.problem.bounds.operands
        return lower.ptr, float(least), upper.ptr, float(most), code.ptr

    def program_key(self) -> tuple[Hashable, ...]:
        """Return the key of the launches of a truncated cycle."""
        return self.problem_key()

    def _correct(self, program: CommandBuffer) -> None:
        """Record a cycle, the products of its correction and the choice of the step.

        On the CPU the last part of the cycle sums the products.
        """
        hierarchy = self.hierarchy
        if not hierarchy.ends_in_wave:
            program.extend(hierarchy.cycle)
            self._measure(launch=program.launch)
            return
        measuring = kernels.measure_kernel(hierarchy.finest, self._p, self.residual.sums.partials)
        program.extend(hierarchy.cycle_with(kernels.CLIMB, measuring))
        self._measure_beside_cuts(program.launch)
        self._plan(program.launch)

    def _measure_beside_cuts(self, launch: Launch) -> None:
        """Sum the correction's products again beside cells of other processes.

        Their part of the correction has arrived since.
        """
        finest, sums = self.hierarchy.finest, self.residual.sums.partials
        s = finest.stencil
        if s.ghosts is not None:
            s.wrap(finest.x, launch=launch)
        _, lines, cells = s.padding.counts
        for (k0, j0, _), (k1, j1, _) in beside_cuts(s, 2):
            rows = Rows.part(s.padding, self.A.device, (k0, j0, 0), (k1, j1, cells))
            place, places = k0 * lines + j0, s.rows.places
            kernels.MEASURE_AGAIN.bind(
                rows,
                stencil=s,
                z=finest.x,
                q=self._p,
                g=finest.b,
                sums=sums,
                place=place,
                lines=lines,
                places=places,
            ).launch(launch)

    def _measure(self, *, launch: Launch = launch_now) -> None:
        """Sum the products of the cycle's correction, and choose the step."""
        finest = self.hierarchy.finest
        finest.stencil.wrap(finest.x, launch=launch)
        kernels.measure_kernel(finest, self._p, self.residual.sums.partials).launch(launch)
        self._plan(launch)

    def _plan(self, launch: Launch) -> None:
        """Add up the products, and choose the step."""
        self.residual.sums.add_up(int(kernels.ZAZ), columns=4, launch=launch)
        launch(kernels.plan_step_kernel, 1, [self.residual.scalars], device=self.A.device)

    def _advance(self, *, classify: bool, launch: Launch = launch_now) -> None:
        """Take the chosen step and evaluate the residual there."""
        if self.exact:
            self.residual.advance(self.x, self._p, classify=classify, launch=launch)
            return
        self.residual.update(self.x, self._p, launch=launch)
        self._round(self.x, launch=launch)
        self.residual.assess(self.x, classify=classify, launch=launch)

    def rebuild(self, *, classify: bool) -> None:
        """Rebuild the hierarchy for the free set, if that has changed.

        Args:
            classify: as of the residual's `evaluate`, where the right-hand side has to be computed
                again.
        """
        if self.stale:
            self.hierarchy.rebuild_changed()
            self._built = self.residual.free_set

    def forget_direction(self) -> None:
        """Reset the search direction for the next step."""
        self.residual.set(kernels.CARRY, 0.0)

    def _project(self) -> None:
        """Make the right-hand side compatible on singular components."""
        free = self.hierarchy.finest.stencil.d
        if self._mask is None:
            self._mask = self.problem.layout.zeros(wp.uint8)
        kernels.MASK.bind(self.flat, free=free, mask=self._mask).launch()
        assert self.floating is not None
        self.floating.project(self.hierarchy.finest.b, self._mask)


class ColdStart(MultigridWorkspace):
    """Workspace of the cycles of a cold start.

    The method shares its iterate, residual and hierarchy. The finest diagonal of the hierarchy
    takes the method's shifts, and the method stores the best iterate.

    Args:
        problem: the problem.
        A: its operator.
        settings: of the method, with `precision`, `monotone_cycles` and `cycle`.
    """

    def __init__(self, problem: LCP, A: HasStencil, settings: CycleMethod) -> None:
        super().__init__(problem, A, settings, shifted=True, ahead=False)
        self._stored = True  # by the method

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Begin a solve.

        The method may have written the finest diagonal since the last coarsening.
        """
        self.hierarchy.finest.changed.fill_(1)
        self.distrust_hierarchy()
        super().start(warm=warm, tolerance=tolerance, floating=floating)
