"""Principal system of a compact stencil in 2-D: a Krylov method with multigrid cycles over lines."""

from __future__ import annotations

from functools import partial
from typing import Any

import warp as wp

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.line_hierarchy import BlackBoxMultigrid
from warp_lcp.problem.protocol import HasStencil
from warp_lcp.reduced.sparse_system import GuardedSystem, MatrixSystem
from warp_lcp.rows.fields import zeros_like
from warp_lcp.rows.program import Program


class LineSystem(GuardedSystem):
    """Conjugate gradients on a compact stencil in 2-D, or GMRES if A is not symmetric, preconditioned by cycles over lines."""

    def __init__(
        self,
        A: HasStencil,
        real: Any,
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
        """Try cycles over lines again if the operator has changed; `restrict` takes A's entries."""
        if self._version != self._A.version:
            self._version, self._substitute = self._A.version, None

    def restrict(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> None:
        """Take another free set and shift, and coarsen."""
        self._note(free, shift)
        self.hierarchy.restrict(free, shift, self._weight)

    @property
    def program(self) -> Program:
        """Precondition: z = one cycle on r."""
        return self.hierarchy.cycle

    def apply(self) -> None:
        """Precondition: run `program`."""
        self.program.run()
