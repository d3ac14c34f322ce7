"""Reduced systems of Newton's method on the minimum map: protocol, choice, shared settings."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from warp_lcp.multigrid.black_box_multigrid import takes_points
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step, WorkspaceBase
from warp_lcp.settings import Count, CountOrZero, Settings, Share
from warp_lcp.subproblems.correction_system import CorrectionSystem
from warp_lcp.subproblems.fused_grid_system import FusedGridSystem
from warp_lcp.subproblems.host_system import HostSystem

if TYPE_CHECKING:
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton


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


class ReducedSystem(Protocol):
    """Newton's equations on the free unknowns: A_FF e_F = -y_F.

    Free are the unknowns that the minimum map selects at the iterate. A step is `classify`,
    `restrict`, `solve`, `move`, then `accept` or `fall_back`.

    Attributes:
        whole: whether the step of `solve` is taken whole, even if the residual rises.
    """

    whole: bool

    @property
    def iterate(self) -> WorkspaceBase:
        """x, which `move` changes in place, its residual, and the best x so far."""

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the state of the last solve; the operator may have changed."""

    def monotone_cycle(self) -> Step | None:
        """Take a projected multigrid cycle after a cold start.

        Returns None, with nothing done, if none is due.
        """

    def classify(self) -> Step | None:
        """Find the free set F at x.

        Returns a step that has been taken instead of Newton's, such as one on coarse unknowns, else
        None.
        """

    def restrict(self) -> bool:
        """Move held unknowns onto their bounds, and set up the equations on F.

        Returns whether their right-hand side is nonzero.
        """

    def solve(self) -> int | None:
        """Solve the equations to the accuracy of the settings.

        Returns the number of linear iterations, None if there is no step from here.
        """

    def move(self, length: float) -> float:
        """Set x = clip(x + length e, l, u) from the start of the step.

        The first length is 1. Returns the residual's norm there.
        """

    def accept(self, iterations: int) -> Step:
        """Return the step that ends at x, with its number of linear iterations."""

    def fall_back(
        self, iterations: int, norms: deque[float], best: float, length: float
    ) -> Step | ReducedSystem:
        """Continue where `solve` finds no step, or the search no length.

        Returns the step taken, or a system that takes over.

        Args:
            iterations: linear iterations so far.
            norms: last residual norms, whose maximum all lengths have exceeded; to be cleared if no
                later step may undo this one.
            best: the smallest residual norm of the search, inf if there was none.
            length: where it was.
        """


def reduced_system(problem: LCP, settings: MinimumMapNewton) -> ReducedSystem:
    """Return the system for a problem's operator.

    Args:
        problem: the problem.
        settings: of Newton's method, a `MinimumMapNewton`.

    Raises:
        ValueError: A is neither a grid operator, dense nor symmetric; or `direct`, and A is neither
            small nor narrow.
    """
    if settings.direct:
        return HostSystem(problem, settings)
    if settings.safeguard and takes_points(problem.A):
        return FusedGridSystem(problem, settings)
    return CorrectionSystem(problem, settings)
