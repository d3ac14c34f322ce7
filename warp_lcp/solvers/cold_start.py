"""Projected multigrid cycles that begin a cold solve of another method on a grid."""

from __future__ import annotations

from typing import Any

from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil
from warp_lcp.solvers.projected_multigrid_workspace import MultigridWorkspace


class ColdStart(MultigridWorkspace):
    """Memory of the cycles, whose iterate, residual and hierarchy the method shares.

    The finest diagonal of the hierarchy takes the method's shifts, and the method keeps the best iterate.

    Args:
        problem: the problem.
        A: its operator.
        settings: of the method, with `precision`, `monotone_cycles` and `cycle`.
    """

    def __init__(self, problem: LCP, A: HasStencil, settings: Any) -> None:
        super().__init__(problem, A, settings, shifted=True)
        self._stored = True  # elsewhere

    def start(self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None) -> None:
        """Begin; the method may have written the finest diagonal since it was coarsened."""
        self.hierarchy.finest.changed.fill_(1)
        self.distrust_hierarchy()
        super().start(warm=warm, tolerance=tolerance, floating=floating)
