"""Projected multigrid on a grid operator plus a term of low rank.

For example a liquid that carries rigid bodies.
"""

from __future__ import annotations

from collections.abc import Hashable
from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.kernels.launch_graph import CommandBuffer, Launch, LaunchGraph, launch_now
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import CONVERT, rows_of
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import HasStencil
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.subproblems import grid_step_kernels as kernels
from warp_lcp.subproblems import low_rank_correction as coupling
from warp_lcp.subproblems.device_iteration import DeviceIteration
from warp_lcp.subproblems.low_rank_correction import WoodburyCorrection
from warp_lcp.subproblems.multigrid_workspace import MultigridWorkspace
from warp_lcp.subproblems.residual_and_active_set import ResidualAndActiveSet

if TYPE_CHECKING:
    from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid


class CoupledResidual(ResidualAndActiveSet):
    """Natural residual of y = A x + (b + U W U' x).

    The term in brackets changes on U's rows only and replaces b. Its d_i are the diagonal of A
    alone, which is no larger.
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
        self._low, self._b = low, wp.zeros_like(problem.b)  # replaces the problem's b
        self._low_version = -1

    def renew(self) -> None:
        """Read operator and bodies again if they have changed."""
        super().renew()
        if self._low_version != self._low.version:
            self._low_version, self.free_set = self._low.version, self.free_set + 1

    def project(self, x: DeviceArray, *, keep: bool, launch: Launch = launch_now) -> None:
        """Launch the projection of x, or of 0, onto the bounds; copy b.

        The copy is exact off U's rows.
        """
        CONVERT.bind(rows_of(self._b), a=self.problem.b, b=self._b).launch(launch)
        super().project(x, keep=keep, launch=launch)

    def assess(self, x: DeviceArray, *, classify: bool, launch: Launch = launch_now) -> None:
        """Launch the evaluation with b + U W U' x, and correct the energy for it."""
        low = self._low
        low.add(x, self.problem.b, self._b, launch=launch)
        super().assess(x, classify=classify, launch=launch)
        inputs = [low.columns.sums, low.weighed, low.rank, self.scalars, low.products.array]
        launch(coupling.subtract_energy_kernel, 1, inputs, device=low.device)

    def read(self, *, classified: bool) -> float:
        """Read the results of the evaluation, and U'x."""
        self._low.products.changed()
        return super().read(classified=classified)

    def advance(
        self, x: DeviceArray, direction: DeviceArray, *, classify: bool, launch: Launch = launch_now
    ) -> None:
        """Launch the step and the evaluation at its end; U'x is needed between them."""
        self.update(x, direction, launch=launch)
        self.assess(x, classify=classify, launch=launch)


class CoupledWorkspace(MultigridWorkspace):
    """Workspace of the method for one problem of a grid and bodies."""

    residual: CoupledResidual
    correction: WoodburyCorrection
    # The projection changes the force on a very light body by a large factor each time, and the
    # projected cycles of the grid hardly reduce the energy of grid and bodies.
    most_runs = 3

    def __init__(
        self, problem: LCP, A: HasStencil, low: LowRankOperator, settings: ProjectedMultigrid
    ) -> None:
        super().__init__(
            problem, A, settings, residual=partial(CoupledResidual, low=low), ahead=False
        )
        self._low = low
        self.correction = WoodburyCorrection(low, self.hierarchy)
        self._device_iteration = (
            DeviceIteration(self, rebuilds=False) if DeviceIteration.suits(self) else None
        )
        self._evaluation = LaunchGraph(
            problem.device, self._launch_evaluation, at_once=problem.layout.comm is not None
        )
        self._monotone = LaunchGraph(
            problem.device, self._launch_monotone, at_once=problem.layout.comm is not None
        )
        self._along = wp.zeros(low.rank, dtype=wp.float64, device=problem.device)  # U'p
        self._fresh = True  # whether the correction is still that of the last solve
        self.readings = (low.products, *self.correction.readings)
        self._prepared = False  # whether potentials have been computed as the solve began
        low.products_of = self.x if problem.layout.comm is None else None

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the search direction; operator and bodies may have changed."""
        super().start(warm=warm, tolerance=tolerance, floating=floating)
        self._fresh = True

    def begin_on_device(
        self, guess: DeviceArray | None, criteria: StoppingCriteria | MeanCriteria, steps: int
    ) -> float | None:
        """Begin a solve, and take steps, without the host, see `MultigridWorkspace`."""
        if guess is not None:
            self.correction.prepare()
        reference = super().begin_on_device(guess, criteria, steps)
        self._prepared = reference is not None and self.correction.is_made_on_gpu
        return reference

    def begin_cycles(self, count: int) -> None:
        """Schedule projected cycles.

        Their right-hand side contains all unknowns.
        """
        self.cycles_left = count
        self.forget_direction()
        self.free_set_noted = False
        self._evaluation.run(self.x, False, variant=self.problem_key())
        self.residual.read(classified=False)

    def _move_monotonely(self, safe: bool, classify: bool, launch: Launch) -> None:
        if not self.exact:
            super()._move_monotonely(safe, classify, launch)
            return
        # Recorded now, not among other launches.
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
        """Update the hierarchy and the correction for the free set."""
        stale = self.stale
        super().rebuild(classify=classify)
        if not (stale or self._fresh) or self.cycles_left > 0:
            return
        begins, self._fresh = self._fresh, False
        noted, self.free_set_noted = self.free_set_noted, False
        has_potentials, self._prepared = (
            self._prepared,
            False,
        )  # this has overwritten the right-hand side
        # `renew` may have overwritten it too.
        if (
            self.correction.renew(
                begins=begins, noted=noted, has_potentials=noted and has_potentials
            )
            or has_potentials
        ):
            self._evaluation.run(self.x, classify, variant=self.problem_key())
            if self.floating is not None:
                self._project()

    def _launch_evaluation(self, x: DeviceArray, classify: bool) -> None:
        self.residual.assess(x, classify=classify, launch=launch_recorded)

    def _cycle(self) -> None:
        """Run a corrected cycle on the residual."""
        self.correction.begin()
        super()._cycle()

    def problem_key(self) -> tuple[Hashable, ...]:
        """Return the key of launches that depend on the problem's data.

        It includes the memory of the columns' entries.
        """
        return (*super().problem_key(), self._low.columns.rows.ptr)

    def program_key(self) -> tuple[Hashable, ...]:
        """Return the key of the launches of a truncated cycle, with the correction's."""
        return (*super().program_key(), *self.correction.key)

    def _correct(self, program: CommandBuffer) -> None:
        """Record a cycle, its correction, its products and the choice of the step."""
        self.correction.begin(launch=program.launch)
        program.extend(self.hierarchy.cycle)
        self._measure(launch=program.launch)

    def _measure(self, *, launch: Launch = launch_now) -> None:
        """Correct the cycle's z for the bodies, sum its products, choose the step."""
        self.correction.end(launch=launch)
        self._sum_products(launch=launch)
        launch(kernels.plan_step_kernel, 1, [self.residual.scalars], device=self.A.device)

    def _sum_products(self, *, launch: Launch = launch_now) -> None:
        """Sum the products for beta and the step, with A + U W U'."""
        residual, finest, device, columns = (
            self.residual,
            self.hierarchy.finest,
            self.A.device,
            self._low.columns,
        )
        finest.stencil.wrap(finest.x, launch=launch)
        kernels.measure_kernel(finest, self._p, residual.sums.partials).launch(launch)
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
