"""Projected multigrid for the LCP of a grid, at the cost of a linear solve.

Monotone cycles, then truncated cycles with a carried conjugate-gradient direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.operators.sum import grid_and_low_rank
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step
from warp_lcp.problem.operator_protocol import HasLowRankTerm, HasStencil, check_taken, has
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.workspace_cache import CachedWorkspace, cached_or_new_workspace
from warp_lcp.settings import Count, CountOrZero, Settings
from warp_lcp.subproblems.multigrid_coupled import CoupledWorkspace
from warp_lcp.subproblems.multigrid_workspace import MultigridWorkspace


@dataclass(frozen=True, kw_only=True)
class ProjectedMultigrid(Settings):
    """Monotone multigrid for the LCP of a grid.

    It takes about as many cycles as multigrid for the linear system [Kornhuber 1994; Graeser &
    Kornhuber 2009].

    After a cold start, the first step is a projected (monotone) cycle, which moves whole aggregates
    on and off their bounds. Each later step evaluates y = A x + b in float64 and removes the
    unknowns that are at a bound with y of the right sign from the hierarchy (they are *truncated*).
    It preconditions -y by one linear cycle on the others, makes the correction conjugate to what is
    left of the last direction, and projects the step onto the bounds. There are no inner
    tolerances: without bounds this is the method of preconditioned conjugate gradients with a true
    residual, and the same code is the linear solver.

    Steps are judged by the energy x'Ax/2 + b'x (`energy_monitor.EnergyMonitor`). If it falls evenly
    while the free set changes, a contact's boundary moves by only one layer of cells per step, and
    a monotone cycle follows. If `patience` steps reach no new least energy, monotone cycles follow,
    twice as many each time; with rigid bodies the third run of them ends the solve with STAGNATED.
    Cycles are slow in channels one cell wide and where coefficients are random over decades:
    `wl.solve` without a method then continues with `MinimumMapNewton` on the assembled matrix
    (`wl.default_chain`).

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate
            rounded to float32 as well.
        monotone_cycles: projected cycles of a cold start.
        patience: steps without a new least energy before monotone cycles are taken.
        cycle: settings of multigrid cycles.
    """

    supports: ClassVar = (HasStencil, HasLowRankTerm)
    needs: ClassVar[str] = ""
    distributed: ClassVar[bool] = True

    precision: PrecisionName = "mixed"
    # Without one the active set advances slowly. Nested iteration from the coarsest level saves one
    # step in ten, and takes as long.
    monotone_cycles: CountOrZero = 1
    patience: Count = 3
    cycle: CycleSettings = field(default_factory=CycleSettings)

    def init(self, problem: LCP) -> MultigridWorkspace | CoupledWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A has no stencil, or columns that are not symmetric.
        """
        check_taken(self, problem.A)
        if has(problem.A, HasStencil):
            if not problem.A.symmetric:
                raise ValueError(
                    "A is not symmetric: ProjectedMultigrid minimizes an energy, which exists only "
                    "for a symmetric A; use MinimumMapNewton"
                )
            return MultigridWorkspace(problem, problem.A, self)
        terms = grid_and_low_rank(problem.A)
        if terms is None:
            raise ValueError(
                "A is not symmetric: ProjectedMultigrid needs a symmetric low-rank part; use "
                "MinimumMapNewton"
            )
        return CoupledWorkspace(problem, *terms, self)

    def cached_workspace(self, problem: LCP) -> CachedWorkspace | None:
        """Return a kept workspace of an earlier solve with the problem's data.

        Returns None if `init` has to create one. From the second consecutive solve of a form on,
        one workspace is kept, see `wl.release_workspace`.
        """
        return cached_or_new_workspace(problem, self) if type(self) is ProjectedMultigrid else None

    def step(self, problem: LCP, work: MultigridWorkspace, x: DeviceArray) -> Step:
        """Take a monotone cycle or a truncated one.

        Monotone cycles come after a cold start and where steps do not lower the energy; truncated
        ones otherwise.
        """
        if work.goes_in_circles:
            work.residual.mark_evaluated(work.residual.norm)  # x has not moved
            return Step("truncated cycle", 0, work.residual.active, SolveStatus.STAGNATED)
        if work.wants_monotone_cycle():
            return work.monotone_step()
        return work.truncated_step()
