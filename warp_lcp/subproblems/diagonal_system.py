"""Principal system of an operator with products only.

A Krylov method with the operator's diagonal, or the problem's preconditioner.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import rows_of
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.preconditioner import Preconditioner
from warp_lcp.subproblems.active_set_kernels import DIVIDE, MASK, SHIFT


class DiagonalSystem(KrylovSystem):
    """Krylov method preconditioned by the diagonal, for any operator, in float64.

    Conjugate gradients if A is symmetric, else GMRES.
    """

    _definite = True  # whether conjugate gradients can use the preconditioner

    def __init__(self, problem: LCP, *, shifted: bool = False) -> None:
        self._A, self._layout = problem.A, problem.layout
        self.r, self.z = self._layout.zeros(wp.float64), self._layout.zeros(wp.float64)
        self._diagonal, self._inverse = (
            self._layout.zeros(wp.float64),
            self._layout.zeros(wp.float64),
        )
        weight = self._inverse if shifted else None
        self._shift: DeviceArray | None = None
        method = ConjugateGradient if self._A.symmetric and self._definite else GMRES
        self._iterate_by(method(self._product, self, weight=weight), weight)
        self.refresh()

    def refresh(self) -> None:
        """Read the diagonal of A again; entries may have changed."""
        self._own = self._layout.load(self._A.diagonal().numpy(), wp.float64)

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Store the free set and the shift, and shift the diagonal."""
        self._free, self._shift = free, shift
        rows, weight = rows_of(self.r), self._inverse
        SHIFT.bind(
            rows,
            free=free,
            shift=shift,
            d=self._own,
            unit=1.0,
            diagonal=self._diagonal,
            weight=weight,
        ).launch()

    def apply(self) -> None:
        """Apply the preconditioner: z = r / d."""
        DIVIDE.bind(rows_of(self.r), r=self.r, d=self._diagonal, z=self.z).launch()

    def _product(self, p: DeviceArray, q: DeviceArray, *, launch: Launch = launch_now) -> None:
        shape = self._layout.stored_shape
        self._A.apply(p.reshape(shape), q.reshape(shape))
        MASK.bind(rows_of(q), free=self._free, shift=self._shift, direction=p, q=q).launch()


class PreconditionedSystem(DiagonalSystem):
    """Krylov method preconditioned by P M P with the problem's own M, on the host.

    Conjugate gradients if A is symmetric and M seems definite.
    """

    def __init__(self, problem: LCP, M: Preconditioner) -> None:
        self._M, self._definite = M, M.definite
        super().__init__(problem)

    def apply(self) -> None:
        """Apply the preconditioner: z = P M r; r is 0 off the free set."""
        self.z.assign(np.where(self._free.numpy() != 0, self._M(np.array(self.r.numpy())), 0.0))
