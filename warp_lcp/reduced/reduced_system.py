"""Protocol of the systems that Newton's method on the minimum map solves, and the choice between them."""

from __future__ import annotations

from collections import deque
from typing import Any, Protocol

from warp_lcp.multigrid.line_hierarchy import takes_points
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.solve import IterateMemory, Step
from warp_lcp.reduced.correction_system import CorrectionSystem
from warp_lcp.reduced.fused_grid_system import FusedGridSystem
from warp_lcp.reduced.host_system import HostSystem


class ReducedSystem(Protocol):
    """Newton's equations at the iterate, reduced to the unknowns that the minimum map calls free: A_FF e_F = -y_F.

    A step is `classify`, `restrict`, `solve`, `move`, then `accept` or `fall_back`.

    Attributes:
        whole: whether the step that `solve` has found is taken whole, whatever the residual does.
    """

    whole: bool

    @property
    def iterate(self) -> IterateMemory:
        """x, which `move` changes in place, its residual, and the best x so far."""

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Forget the last solve; the operator may have changed."""

    def monotone_cycle(self) -> Step | None:
        """Take a projected multigrid cycle if the start is still cold; return None, with nothing done, if it is not."""

    def classify(self) -> Step | None:
        """Find the free set F at x; return a step that has been taken instead of Newton's, such as one on coarse unknowns."""

    def restrict(self) -> bool:
        """Move held unknowns onto their bounds, and set up the equations on F; return whether their right-hand side is not 0."""

    def solve(self) -> int | None:
        """Solve them as accurately as the settings ask; return linear iterations, None where no step leads on from here."""

    def move(self, length: float) -> float:
        """Set x = clip(x + length e, l, u) from where the step began, at first with length 1; return the residual's norm there."""

    def accept(self, iterations: int) -> Step:
        """Return the step that ends at x, with the linear iterations that it took."""

    def fall_back(
        self, iterations: int, norms: deque[float], best: float, length: float
    ) -> Step | ReducedSystem:
        """Go on where `solve` finds no step, or the search no length; return the step taken, or a system that takes over.

        Args:
            iterations: linear iterations so far.
            norms: last residual norms, whose maximum no length has kept to; to be cleared if no
                later step may undo this one.
            best: the smallest residual norm of the search, inf if there was none.
            length: where it was.
        """


def reduced_system(problem: LCP, settings: Any) -> ReducedSystem:
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
