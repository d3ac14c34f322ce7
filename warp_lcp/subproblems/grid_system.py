"""Principal system of a grid: a Krylov method preconditioned by multigrid.

Conjugate gradients, or GMRES if A is not symmetric.
"""

from __future__ import annotations

from functools import partial

from warp_lcp.kernels import Rows
from warp_lcp.kernels.fields import zeros_like
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import Reduction, rows_of
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovMethod
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.multigrid.multiple_semicoarsening import make_hierarchy
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import HasStencil
from warp_lcp.subproblems.active_set_kernels import ALL_FREE, ON_FREE, SHIFT
from warp_lcp.subproblems.fused_conjugate_gradient import FusedConjugateGradient
from warp_lcp.subproblems.grid_step_kernels import GAPS, SIZE
from warp_lcp.subproblems.sparse_system import GuardedSystem, MatrixSystem


class GridSystem(GuardedSystem):
    """Conjugate gradients on a grid, preconditioned by a multigrid cycle.

    The cycle is linear, on the free set, and of `hierarchy` if that is given.
    """

    def __init__(
        self,
        A: HasStencil,
        real: DataType,
        *,
        bounded: bool,
        settings: CycleSettings | None = None,
        shifted: bool = False,
        hierarchy: Hierarchy | None = None,
    ) -> None:
        self._A = A
        self._version = A.version
        self.hierarchy = hierarchy or make_hierarchy(
            A.stencil, real, bounded=bounded, settings=settings, shifted=shifted
        )
        self.r, self.z = self.hierarchy.finest.b, self.hierarchy.finest.x
        self._weight = zeros_like(self.r) if shifted else None
        # One CPU thread, no ghost cells to fill.
        self.fused = self.hierarchy.ends_in_wave and A.symmetric and A.stencil.ghosts is None
        if self.fused:
            method: KrylovMethod = FusedConjugateGradient(
                A.stencil, self.hierarchy, weighted=shifted
            )
        else:
            method = (ConjugateGradient if A.symmetric else GMRES)(
                self.hierarchy.finest.stencil.product, self, weight=self._weight
            )
        self._iterate_by(method, self._weight)
        if not A.symmetric and A.stencil.ghosts is None:
            self._guard(partial(MatrixSystem, A, shifted=shifted))

    def refresh(self) -> None:
        """Read the rows and the weights again if the operator has changed."""
        if self._version != self._A.version:
            self._version, self._substitute = self._A.version, None
            self.hierarchy.refresh()
            if isinstance(self._krylov, FusedConjugateGradient):
                self._krylov.clear()

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Mask and shift the finest diagonal and coarsen.

        Raises:
            ValueError: a shift, but the system was not made for one.
        """
        self._note(free, shift)
        source, target = self._A.stencil, self.hierarchy.finest.stencil.d
        if self._weight is None:
            if shift is not None:
                raise ValueError("shift: construct the system with shifted=True")
            self.hierarchy.mask_diagonal(source.d, free)
            self.hierarchy.rebuild_changed()
        else:
            rows, weight = rows_of(target), self._weight
            SHIFT.bind(
                rows,
                free=free,
                shift=shift,
                d=source.d,
                unit=source.unit,
                diagonal=target,
                weight=weight,
            ).launch()
            self.hierarchy.rebuild()

    @property
    def program(self) -> CommandBuffer:
        """The preconditioner: z = one cycle on r."""
        return self.hierarchy.cycle

    def apply(self) -> None:
        """Apply the preconditioner: run `program`."""
        self.program.run()

    def monotone_cycle(self) -> None:
        """Run a projected cycle on r within the finest bounds; the correction is `z`."""
        self.hierarchy.monotone_cycle.run()


def projected_cycle(
    problem: LCP,
    system: GridSystem,
    x: DeviceArray,
    y: DeviceArray,
    size: float,
    free: DeviceArray,
    sums: Reduction,
    *,
    restrict: bool = True,
) -> None:
    """Run a projected cycle from x: the correction is `system.z` times `size`.

    Args:
        problem: on a grid.
        system: of its corrections.
        x: the start, a stored field like y and free.
        y: A x + b.
        size: divisor of the right-hand side.
        free: set to all unknowns.
        sums: memory; `SIZE` of its scalars is written.
        restrict: whether the system must be restricted to all unknowns first.
    """
    rows, finest = Rows.flat(problem.layout.size, problem.device), system.hierarchy.finest
    ALL_FREE.bind(rows, unknown=problem.unknown, free=free).launch()
    if restrict:
        system.restrict(free)
    ON_FREE.bind(rows, y=y, free=free, g=system.r, scale=1 / size, out=sums.partials).launch()
    sums.scalars[int(SIZE) : int(SIZE) + 1].fill_(size)
    bounds, lo, hi = problem.bounds.operands, finest.lower, finest.upper
    GAPS.bind(
        rows, bounds=bounds, x=x, unknown=problem.unknown, lo=lo, hi=hi, scalars=sums.scalars
    ).launch()
    system.monotone_cycle()
