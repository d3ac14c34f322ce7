"""Principal system of a grid plus a term of low rank (Woodbury).

For example a liquid that carries rigid bodies.
"""

from __future__ import annotations

import warp as wp

from warp_lcp.kernels.fields import zeros_like
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import rows_of
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.operators.sum import SumOperator
from warp_lcp.problem.operator_protocol import HasStencil
from warp_lcp.subproblems.active_set_kernels import SHIFT
from warp_lcp.subproblems.grid_system import GridSystem
from warp_lcp.subproblems.low_rank_correction import WoodburyCorrection


class CoupledGridSystem(KrylovSystem):
    """Conjugate gradients on a grid operator plus a term of low rank.

    The preconditioner is the grid's multigrid cycle, corrected for the columns.
    """

    def __init__(
        self,
        A: SumOperator,
        grid: HasStencil,
        low: LowRankOperator,
        real: DataType,
        *,
        settings: CycleSettings | None,
        shifted: bool,
    ) -> None:
        self._grid, self._low, self._A = (
            GridSystem(grid, real, bounded=False, settings=settings, shifted=shifted),
            low,
            A,
        )
        self.r, self.z = self._grid.r, self._grid.z
        self._correction, self._begins = WoodburyCorrection(low, self._grid.hierarchy), True
        self._extra = zeros_like(self.r)
        self._free: DeviceArray | None = None
        self._weight = zeros_like(self.r) if shifted else None
        comm = A.layout.comm
        # Without ghost cells, which other ranks sum.
        rows = None if comm is None else grid.stencil.rows
        self._iterate_by(
            ConjugateGradient(self._product, self, weight=self._weight, rows=rows, comm=comm),
            self._weight,
            rows,
            comm,
        )
        self._take_diagonal()

    def refresh(self) -> None:
        """Read the grid's rows again if they have changed."""
        self._grid.refresh()
        self._take_diagonal()
        self._begins = True

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Set another free set and shift."""
        self._free = free
        self._grid.restrict(free, shift)
        if self._weight is not None:
            rows, weight = rows_of(self.r), self._weight
            SHIFT.bind(
                rows,
                free=free,
                shift=shift,
                d=self._own,
                unit=1.0,
                diagonal=self._extra,
                weight=weight,
            ).launch()
        wp.copy(self._extra, self.r)
        self._correction.renew(begins=self._begins)
        wp.copy(self.r, self._extra)
        self._begins = False

    def apply(self) -> None:
        """Apply the preconditioner: one corrected cycle of the grid's multigrid."""
        self._correction.begin()
        self._grid.apply()
        self._correction.end()

    def _product(self, p: DeviceArray, q: DeviceArray, *, launch: Launch = launch_now) -> None:
        self._grid.hierarchy.finest.stencil.product(p, q)
        self._low.add(p, q, q, mask=self._free)

    def _take_diagonal(self) -> None:
        if self._weight is not None:
            self._own = self._A.layout.load(self._A.diagonal().numpy(), wp.float64)
