"""Projected multigrid on a grid operator plus one of low rank: a liquid that carries rigid bodies."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.reduced import grid_step_kernels as kernels
from warp_lcp.reduced import low_rank_correction as coupling
from warp_lcp.reduced.low_rank_correction import LowRankCorrection
from warp_lcp.reduced.multigrid_ahead import RunAhead
from warp_lcp.reduced.multigrid_residual import AssessedResidual
from warp_lcp.reduced.multigrid_workspace import MultigridWorkspace
from warp_lcp.rows.program import Launch, LaunchGraph, Program, launch_now
from warp_lcp.rows.program import launch as launch_recorded
from warp_lcp.rows.vectors import CONVERT, rows_of

if TYPE_CHECKING:
    from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid


class CoupledResidual(AssessedResidual):
    """The natural residual of y = A x + (b + U W U' x): the term in brackets changes on U's rows only and takes b's place.

    Its d_i are the diagonal of A alone, which is no larger.
    """

    def __init__(
        self,
        problem: LCP,
        A: HasStencil,
        hierarchy: Hierarchy,
        *,
        low: LowRankOperator,
        rounded: bool,
    ) -> None:
        super().__init__(problem, A, hierarchy, rounded=rounded)
        self.diagonal, self.unit, self._diagonal_of = A.stencil.d, float(A.stencil.unit), None
        self._low, self._b = low, wp.zeros_like(problem.b)  # in the place of the problem's
        self._low_version = -1

    def renew(self) -> None:
        """Take operator and bodies again if they have changed."""
        super().renew()
        if self._low_version != self._low.version:
            self._low_version, self.free_set = self._low.version, self.free_set + 1

    def project(self, x: wp.array[Any], *, keep: bool, launch: Launch = launch_now) -> None:
        """Launch the projection of x, or of 0, onto the bounds; take b, off U's rows."""
        CONVERT.bind(rows_of(self._b), a=self.problem.b, b=self._b).launch(launch)
        super().project(x, keep=keep, launch=launch)

    def assess(self, x: wp.array[Any], *, classify: bool, launch: Launch = launch_now) -> None:
        """Launch the evaluation, of b + U W U' x first, and correct the energy for that."""
        low = self._low
        low.add(x, self.problem.b, self._b, launch=launch)
        super().assess(x, classify=classify, launch=launch)
        inputs = [low.columns.sums, low.weighed, low.rank, self.scalars, low.products.array]
        launch(coupling.subtract_energy_kernel, 1, inputs, device=low.device)

    def read(self, *, classified: bool) -> float:
        """Read what the evaluation found, U'x too."""
        self._low.products.changed()
        return super().read(classified=classified)

    def advance(
        self,
        x: wp.array[Any],
        direction: wp.array[Any],
        *,
        classify: bool,
        launch: Launch = launch_now,
    ) -> None:
        """Launch the step and the evaluation where it ends; U'x is needed between them."""
        self.update(x, direction, launch=launch)
        self.assess(x, classify=classify, launch=launch)


class CoupledWorkspace(MultigridWorkspace):
    """Memory of the method for one problem of a grid and bodies."""

    residual: CoupledResidual
    correction: LowRankCorrection
    # What a projection does to the force on a body that weighs next to nothing is a leap each time,
    # and the energy of grid and bodies lets projected cycles of the grid hardly move.
    most_runs = 3

    def __init__(
        self, problem: LCP, A: HasStencil, low: LowRankOperator, settings: ProjectedMultigrid
    ) -> None:
        super().__init__(
            problem, A, settings, residual=partial(CoupledResidual, low=low), ahead=False
        )
        self._low = low
        self.correction = LowRankCorrection(low, self.hierarchy)
        self._ahead = RunAhead(self, rebuilds=False) if RunAhead.suits(self) else None
        self._evaluation = LaunchGraph(
            problem.device, self._launch_evaluation, at_once=problem.layout.across is not None
        )
        self._monotone = LaunchGraph(
            problem.device, self._launch_monotone, at_once=problem.layout.across is not None
        )
        self._along = wp.zeros(low.rank, dtype=wp.float64, device=problem.device)  # U'p
        self._fresh = True  # whether the correction is still that of the last solve
        self.readings = (low.products, *self.correction.readings)
        self._prepared = False  # whether potentials have been made as the solve began
        low.products_of = self.x if problem.layout.across is None else None

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Forget the search direction; operator and bodies may have changed."""
        super().start(warm=warm, tolerance=tolerance, floating=floating)
        self._fresh = True

    def begin_ahead(
        self, guess: wp.array[Any] | None, criteria: StoppingCriteria | MeanCriteria, steps: int
    ) -> float | None:
        """Begin a solve, and take steps, without the host, see `MultigridWorkspace`."""
        if guess is not None:
            self.correction.prepare()
        reference = super().begin_ahead(guess, criteria, steps)
        self._prepared = reference is not None and self.correction.is_made_ahead
        return reference

    def begin_cycles(self, count: int) -> None:
        """Let projected cycles come next: all unknowns are in their right-hand side."""
        self.cycles_left = count
        self.forget_direction()
        self.free_set_noted = False
        self._evaluation.run(self.x, False, variant=self.problem_key())
        self.residual.read(classified=False)

    def _move_monotonely(self, safe: bool, classify: bool, launch: Launch) -> None:
        if not self.exact:
            super()._move_monotonely(safe, classify, launch)
            return
        # made now, not among recorded launches
        assert self.hierarchy.projected_sweep if safe else self.hierarchy.monotone_cycle
        self._monotone.run(safe, classify, variant=self.problem_key())

    def _launch_monotone(self, safe: bool, classify: bool) -> None:
        super()._move_monotonely(safe, classify, launch_recorded)

    def _plan_monotone_step(self, launch: Launch) -> None:
        self._sum_products(launch=launch)
        launch(
            kernels.plan_whole_step_kernel,
            1,
            [self.residual.scalars, True],
            device=self.problem.device,
        )

    def rebuild(self, *, classify: bool) -> None:
        """Follow the free set, with the correction too."""
        stale = self.stale
        super().rebuild(classify=classify)
        if not (stale or self._fresh) or self.cycles_left > 0:
            return
        begins, self._fresh = self._fresh, False
        noted, self.free_set_noted = self.free_set_noted, False
        made, self._prepared = self._prepared, False  # which has overwritten the right-hand side
        # so has this
        if self.correction.renew(begins=begins, noted=noted, made=noted and made) or made:
            self._evaluation.run(self.x, classify, variant=self.problem_key())
            if self.floating is not None:
                self._project()

    def _launch_evaluation(self, x: wp.array[Any], classify: bool) -> None:
        self.residual.assess(x, classify=classify, launch=launch_recorded)

    def _cycle(self) -> None:
        """Run a cycle on the residual."""
        self.correction.begin()
        super()._cycle()

    def problem_key(self) -> tuple[Any, ...]:
        """Return what launches depend on of the problem's data; where the columns' entries lie, too."""
        return (*super().problem_key(), self._low.columns.rows.ptr)

    def program_key(self) -> tuple[Any, ...]:
        """Return what the launches of a truncated cycle depend on; the correction's too."""
        return (*super().program_key(), *self.correction.key)

    def _correct(self, program: Program) -> None:
        """Record a cycle, its correction, the measuring and the plan of the step."""
        self.correction.begin(launch=program.launch)
        program.extend(self.hierarchy.cycle)
        self._measure(launch=program.launch)

    def _measure(self, *, launch: Launch = launch_now) -> None:
        """Correct the cycle's z for the bodies, measure it and plan the step."""
        self.correction.end(launch=launch)
        self._sum_products(launch=launch)
        launch(kernels.plan_step_kernel, 1, [self.residual.scalars], device=self.A.device)

    def _sum_products(self, *, launch: Launch = launch_now) -> None:
        """Sum the products that beta and the step need, with A + U W U'."""
        residual, finest, device, columns = (
            self.residual,
            self.hierarchy.finest,
            self.A.device,
            self._low.columns,
        )
        finest.stencil.wrap(finest.x, launch=launch)
        kernels.measuring(finest, self._p, residual.sums.partials).launch(launch)
        residual.sums.add_up(int(kernels.ZAZ), columns=4, launch=launch)
        CONVERT.bind(
            rows_of(self._along), a=columns.gather(self._p, launch=launch), b=self._along
        ).launch(launch)
        inputs = [
            self._low.weights.flatten(),
            columns.gather(finest.x, launch=launch),
            self._along,
            self._low.rank,
            residual.scalars,
        ]
        launch(coupling.add_products_kernel, 1, inputs, device=device)
