"""Principal system of a compact stencil in 2-D, preconditioned by line multigrid."""

from __future__ import annotations

from functools import partial

from warp_lcp.kernels.fields import zeros_like
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.multigrid.black_box_multigrid import BlackBoxMultigrid
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.problem.operator_protocol import HasStencil
from warp_lcp.subproblems.sparse_system import GuardedSystem, MatrixSystem


class LineSystem(GuardedSystem):
    """Krylov method on a compact stencil in 2-D, preconditioned by line cycles.

    Conjugate gradients, or GMRES if A is not symmetric.
    """

    def __init__(
        self,
        A: HasStencil,
        real: DataType,
        *,
        settings: CycleSettings | None = None,
        shifted: bool = False,
    ) -> None:
        self._A = A
        self.hierarchy = BlackBoxMultigrid(
            A.stencil, real, symmetric=A.symmetric, settings=settings
        )
        finest = self.hierarchy.finest
        self.r, self.z = finest.b, finest.x
        self._weight = zeros_like(self.r) if shifted else None
        method = ConjugateGradient if A.symmetric else GMRES
        self._iterate_by(method(finest.stencil.product, self, weight=self._weight), self._weight)
        if A.stencil.ghosts is None:  # else other processes have parts of the grid
            self._guard(partial(MatrixSystem, A, shifted=shifted))
        self._version = A.version

    def refresh(self) -> None:
        """Try line cycles again if the operator has changed; `restrict` reads A."""
        if self._version != self._A.version:
            self._version, self._substitute = self._A.version, None

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Set another free set and shift, and coarsen."""
        self._note(free, shift)
        self.hierarchy.restrict(free, shift, self._weight)

    @property
    def program(self) -> CommandBuffer:
        """The preconditioner: z = one cycle on r."""
        return self.hierarchy.cycle

    def apply(self) -> None:
        """Apply the preconditioner: run `program`."""
        self.program.run()
