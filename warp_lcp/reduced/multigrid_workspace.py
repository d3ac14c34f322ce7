"""Projected and truncated multigrid cycles at work on a grid problem: the iterate, its residual with a free set, and a direction."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_lcp.multigrid.cycle_passes import CLEAR
from warp_lcp.multigrid.halo_levels import beside_cuts
from warp_lcp.multigrid.turning import make_hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil
from warp_lcp.problem.solve import IterateMemory, Precision, Step
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.reduced import grid_step_kernels as kernels
from warp_lcp.reduced.descent import Descent
from warp_lcp.reduced.multigrid_ahead import RunAhead
from warp_lcp.reduced.multigrid_residual import AssessedResidual
from warp_lcp.rows import Rows
from warp_lcp.rows.fields import nothing
from warp_lcp.rows.program import Launch, Program, as_one_table, launch_now
from warp_lcp.rows.program import launch as launch_recorded
from warp_lcp.rows.readings import Reading

if TYPE_CHECKING:
    from warp_lcp.reduced.low_rank_correction import LowRankCorrection

AHEAD = 20  # steps that the device may take without the host: then their pace is looked at


class MultigridWorkspace(IterateMemory):
    """Memory of `ProjectedMultigrid` for one problem; its cycles also serve other methods on grids.

    x is moved in place. The best iterate is not stored while it is x, nor when x is one step past
    it, for a step can be taken back; it is when the residual has risen and goes on from there.

    Args:
        problem: the problem.
        A: its operator.
        settings: of the method, with `precision`, `monotone_cycles` and `cycle`.
        residual: makes the residual of the problem, the operator and the hierarchy.
        shifted: whether the finest diagonal takes shifts.
        ahead: whether the device may take steps without the host.

    Attributes:
        cycles_left: projected cycles that come next.
        cycles_against_creeping: whether a projected cycle follows a step in which the free set
            creeps.
    """

    residual: AssessedResidual
    readings: tuple[Reading, ...] = ()  # that evaluations leave besides the residual's
    correction: LowRankCorrection | None = None  # of the cycle, for bodies
    # of projected cycles that were due: after those, the free set goes round in circles
    most_runs: float = math.inf
    cycles_against_creeping = True
    # whether `LowRankCorrection.note` has been launched for the free set as it is
    free_set_noted = False

    def __init__(
        self,
        problem: LCP,
        A: HasStencil,
        settings: Any,
        *,
        residual: Callable[..., AssessedResidual] = AssessedResidual,
        shifted: bool = False,
        ahead: bool = True,
    ) -> None:
        precision = Precision(settings.precision)
        real, self.A, self.settings, self.bounded = (
            precision.correction,
            A,
            settings,
            problem.bounded,
        )
        self._p = problem.layout.zeros(real)
        # a projected cycle forgets the search direction, so its lower bounds may lie in that
        # memory: finite numbers, and 0 off the unknowns
        upper = (
            problem.layout.zeros(real) if problem.bounds.may_bind[1] else nothing(real, A.device)
        )
        options: dict[str, Any] = {
            "bounded": self.bounded,
            "settings": settings.cycle,
            "bounds": (self._p, upper),
            "shifted": shifted,
        }
        self.hierarchy = make_hierarchy(A.stencil, real, **options)
        super().__init__(
            problem,
            precision,
            residual=residual(problem, A, self.hierarchy, rounded=precision is Precision.SINGLE),
        )
        self.flat = Rows.of_fields(problem.layout)
        self._programs: dict[tuple[Any, ...], Program] = {}  # truncated cycles
        self._mask: wp.array[Any] | None = None
        self.scratch = self._scratch() if real is wp.float32 else None
        # steps since the best iterate; whether it is in memory of its own
        self._past, self._stored = 0, False
        self.cycles_left, self.descent = 0, Descent(self.precision.epsilon)
        self._tolerance, self._taken = 0.0, 0  # steps of this solve
        self._ahead = RunAhead(self) if ahead and RunAhead.suits(self) else None
        self._one_table = self._ahead is not None  # whether nothing is read on the way of a step
        self._built = 0  # the version of the free set that the hierarchy has
        # steps that the device may take without the host; whether it has begun the solve
        self._budget, self._begun = 0, False

    @property
    def stale(self) -> bool:
        """Whether the free set has changed since the hierarchy was built."""
        return self._built != self.residual.free_set

    def distrust_hierarchy(self) -> None:
        """Have the hierarchy built again before the next cycle."""
        self._built = 0

    def forget_solve(self) -> None:
        """Free what only the last solve needed, and the search direction, which no step must see again."""
        self.floating = None
        self._p.zero_()
        if self._ahead is not None:
            self._ahead.forget_guess()

    def begin_ahead(
        self, guess: wp.array[Any] | None, criteria: StoppingCriteria | MeanCriteria, steps: int
    ) -> float | None:
        """Begin a solve, and take steps, without the host; return the residual at clip(0, l, u), None where nothing has begun.

        Args:
            guess: stored field; None: the host begins.
            criteria: of the solve.
            steps: that may be taken without the host in this solve.
        """
        self._budget = steps
        if self._ahead is None or guess is None or guess.ptr == self.x.ptr or steps <= 0:
            return None
        self.floating = None
        reference = self._ahead.begin(guess, criteria, min(steps, AHEAD))
        self._begun = reference is not None
        return reference

    @property
    def begins_ahead(self) -> bool:
        """Whether a GPU can begin a solve without the host."""
        return self._ahead is not None and self.A.device.is_cuda

    @property
    def exact(self) -> bool:
        """Whether x is no more than a step from where it was before one."""
        return self.floating is None and self._rounded is None

    def _scratch(self) -> tuple[wp.array[Any], wp.array[Any]]:
        """Return what is free between cycles, as fields of four bytes and of one byte a cell."""
        x, t = self.hierarchy.finest.x, self.hierarchy.finest.t
        return t, wp.array(ptr=x.ptr, dtype=wp.uint8, shape=x.shape, device=x.device)

    def keep(self) -> None:
        """Remember x as the best iterate."""
        self._past, self._stored = 0, False

    def restore(self) -> None:
        """Make x the best iterate again."""
        if self._stored:
            self.problem.layout.copy(self.x, self._best)
        elif self._past == 1:
            self._undo(self.x)
        self.residual.set(kernels.STEP, 0.0)
        self.keep()

    def _leave(self) -> None:
        """Store the best iterate before x leaves it behind: it was x, or one step ago."""
        if not self._stored and self._past == (1 if self.exact else 0):
            if self._ahead is not None and self._ahead.rows and not self.exact:
                self._stored = True  # the device has stored it, and x has gone on
            else:
                self._keep_stored(by_undoing=self.exact)
        self._past += 1

    def store_best(self) -> None:
        """Keep the best iterate in memory of its own: x is about to change by more than can be taken back."""
        if not self._stored and self._past <= (1 if self.exact else 0):
            self._keep_stored(by_undoing=self._past == 1)

    def _keep_stored(self, *, by_undoing: bool) -> None:
        """Store x, or where its last step began."""
        if by_undoing:
            self._undo(self.best())
        else:
            self.problem.layout.copy(self.best(), self.x)
        self._stored = True

    def best(self) -> wp.array[Any]:
        """Return the memory of the best iterate, made at the first call."""
        if self._best is None:
            self._best = self.problem.layout.zeros(wp.float64)
        return self._best

    def _undo(self, out: wp.array[Any]) -> None:
        """Write where the last step began."""
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
        """Forget the search direction; the operator may have changed."""
        self.floating = floating
        self.cycles_left = self.settings.monotone_cycles if self.bounded and not warm else 0
        self.descent.start(self.residual.energy, self.residual.norm)
        self._tolerance, self._taken = tolerance, 0
        if self._begun:
            self._begun = False
            return
        self.forget_direction()
        if self.scratch is not None:
            CLEAR.bind(self.flat, x=self.scratch[1]).launch()
        # corrections in float32 would overflow, or vanish
        rescale = not 1e-6 < self.residual.norm / self.residual.size < 1e6
        if rescale:
            self.residual.set(kernels.SIZE, self.residual.norm)
        # unknowns at their bounds leave the free set unless a projected cycle comes next
        classify = self.cycles_left == 0
        if self.floating is not None:
            self.residual.evaluate(self.x, classify)
            self._project()
        elif rescale or (classify and not self.residual.classified and self.bounded):
            self.residual.evaluate(self.x, classify)

    @property
    def goes_in_circles(self) -> bool:
        """Whether the free set keeps coming again, in a problem where that has no end."""
        return self.descent.runs >= self.most_runs

    @property
    def is_ahead(self) -> bool:
        """Whether the device has taken steps that the host does not know of yet."""
        return self._ahead is not None and bool(self._ahead.rows)

    def wants_monotone_cycle(self) -> bool:
        """Return whether the next step is a projected cycle."""
        if self.cycles_left == 0 and self.bounded:
            due = self.descent.due(self.settings.patience)  # an active set can go round in a circle
            if due:
                self.begin_cycles(due)
        return self.cycles_left > 0

    def begin_cycles(self, count: int) -> None:
        """Let projected cycles come next: all unknowns are in their right-hand side."""
        self.cycles_left = count
        self.forget_direction()
        self.residual.evaluate(self.x, classify=False)

    def monotone_step(self) -> Step:
        """Projected cycle on all unknowns; a projected sweep where cycles have been seen to raise the energy."""
        descent = self.descent
        self._leave()
        self._budget -= 1
        self._taken += 1
        classify = self.cycles_left == 1  # truncated cycles come next
        with (
            as_one_table(self.problem.device, self.problem.layout.across)
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
        """Launch a projected cycle, or a sweep if `safe`, its step, and the evaluation where that ends."""
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
        """Take the projected cycle's correction as it is."""
        finest = self.hierarchy.finest
        finest.stencil.wrap(finest.x, launch=launch)
        launch(
            kernels.plan_whole_step_kernel,
            1,
            [self.residual.scalars, False],
            device=self.problem.device,
        )

    def truncated_step(self) -> Step:
        """One linear cycle on the free unknowns, made conjugate to the last direction, projected."""
        active = self.residual.active
        self._leave()
        self._budget -= 1
        self._taken += 1
        if not self._has_run_ahead():
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
        if self._creeps() and self.cycles_against_creeping:
            self.begin_cycles(1)
        return Step("truncated cycle", 1, active, interim=self.descent.sinks)

    def _has_run_ahead(self) -> bool:
        """Let the device take a step, and those that follow it; return whether it has, and take over what came of one."""
        ahead, left = self._ahead, min(self._budget + 1, AHEAD - self._taken)
        if ahead is None or self.floating is not None:
            return False
        # from the best iterate, where steps cannot be taken back
        starts = left > 0 and (self._rounded is None or self._past == 1)
        if not (ahead.rows or (starts and ahead.steps(self._tolerance, left))):
            return False
        self._built = self.residual.free_set
        self.residual.take(ahead.rows.popleft(), classified=True)
        return True

    def _creeps(self) -> bool:
        """Judge a truncated step; return whether a projected cycle should follow."""
        return self.descent.creeps(self.judge(), moved=self.bounded and self.stale)

    def judge(self) -> float:
        """Let the energy judge the step that has been evaluated; return by how much it has lowered it."""
        return self.descent.record(self.residual.energy, self.residual.norm)

    def _cycle(self) -> None:
        """Run a cycle on the right-hand side."""
        self.hierarchy.cycle.run()

    def step_program(self) -> Program:
        """Return the launches of a truncated cycle; bounds in place may be coded now and not in the next solve."""
        key = self.program_key()
        program = self._programs.get(key)
        if program is None:
            program = self._programs[key] = Program(self.A.device)
            self._correct(program)
            self._advance(classify=True, launch=program.launch)
        return program

    def problem_key(self) -> tuple[Any, ...]:
        """Return what launches depend on of the problem's data."""
        lower, least, upper, most, code = self.problem.bounds.operands
        return lower.ptr, float(least), upper.ptr, float(most), code.ptr

    def program_key(self) -> tuple[Any, ...]:
        """Return what the launches of a truncated cycle depend on."""
        return self.problem_key()

    def _correct(self, program: Program) -> None:
        """Record a cycle, the measuring of its correction and the plan of the step; on the CPU the cycle's last leg measures."""
        hierarchy = self.hierarchy
        if not hierarchy.ends_in_wave:
            program.extend(hierarchy.cycle)
            self._measure(launch=program.launch)
            return
        measuring = kernels.measuring(hierarchy.finest, self._p, self.residual.sums.partials)
        program.extend(hierarchy.cycle_with(kernels.CLIMB, measuring))
        self._measure_beside_cuts(program.launch)
        self._plan(program.launch)

    def _measure_beside_cuts(self, launch: Launch) -> None:
        """Measure the correction again beside cells of other processes, whose part of it has come since."""
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
        """Measure the cycle's correction and plan the step."""
        finest = self.hierarchy.finest
        finest.stencil.wrap(finest.x, launch=launch)
        kernels.measuring(finest, self._p, self.residual.sums.partials).launch(launch)
        self._plan(launch)

    def _plan(self, launch: Launch) -> None:
        """Add up what has been measured, and plan the step."""
        self.residual.sums.add_up(int(kernels.ZAZ), columns=4, launch=launch)
        launch(kernels.plan_step_kernel, 1, [self.residual.scalars], device=self.A.device)

    def _advance(self, *, classify: bool, launch: Launch = launch_now) -> None:
        """Take the planned step and evaluate the residual there."""
        if self.exact:
            self.residual.advance(self.x, self._p, classify=classify, launch=launch)
            return
        self.residual.update(self.x, self._p, launch=launch)
        self._round(self.x, launch=launch)
        self.residual.assess(self.x, classify=classify, launch=launch)

    def rebuild(self, *, classify: bool) -> None:
        """Let the hierarchy follow the free set, if that has changed.

        Args:
            classify: as of the residual's `evaluate`, where the right-hand side has to be made
                again.
        """
        if self.stale:
            self.hierarchy.rebuild_changed()
            self._built = self.residual.free_set

    def forget_direction(self) -> None:
        """Let the next step begin without a search direction."""
        self.residual.set(kernels.CARRY, 0.0)

    def _project(self) -> None:
        """Keep the right-hand side compatible on singular components."""
        free = self.hierarchy.finest.stencil.d
        if self._mask is None:
            self._mask = self.problem.layout.zeros(wp.uint8)
        kernels.MASK.bind(self.flat, free=free, mask=self._mask).launch()
        self.floating.project(self.hierarchy.finest.b, self._mask)


class ColdStart(MultigridWorkspace):
    """Memory of the cycles, whose iterate, residual and hierarchy the method shares.

    The finest diagonal of the hierarchy takes the method's shifts, and the method keeps the best
    iterate.

    Args:
        problem: the problem.
        A: its operator.
        settings: of the method, with `precision`, `monotone_cycles` and `cycle`.
    """

    def __init__(self, problem: LCP, A: HasStencil, settings: Any) -> None:
        super().__init__(problem, A, settings, shifted=True, ahead=False)
        self._stored = True  # elsewhere

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Begin; the method may have written the finest diagonal since it was coarsened."""
        self.hierarchy.finest.changed.fill_(1)
        self.distrust_hierarchy()
        super().start(warm=warm, tolerance=tolerance, floating=floating)
