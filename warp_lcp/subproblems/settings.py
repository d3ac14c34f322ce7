"""Settings that Newton-type methods share."""

from __future__ import annotations

from dataclasses import dataclass, field

from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.problem.solve_loop import PrecisionName
from warp_lcp.settings import Count, CountOrZero, Settings, Share


@dataclass(frozen=True, kw_only=True)
class NewtonSettings(Settings):
    """Settings of methods that solve a linear system in each step.

    A method that needs other defaults declares the field again.

    Args:
        precision: "mixed": iterate float64, corrections float32 on grids; "double"; or "single":
            the iterate rounded to float32 too.
        monotone_cycles: projected multigrid cycles of a cold start on a grid.
        eta: each linear solve reduces its residual by this factor.
        max_linear_iterations: maximum number of iterations of one linear solve.
        cycle: settings of multigrid cycles.
    """

    precision: PrecisionName = "mixed"
    monotone_cycles: CountOrZero = 2
    eta: Share = 0.1
    max_linear_iterations: Count = 200
    cycle: CycleSettings = field(default_factory=CycleSettings)
