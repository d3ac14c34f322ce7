"""Principal system of a narrow sparse matrix: band factors on the host."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.banded_matrix import BandedMatrix, bands_of
from warp_lcp.operators.sparse import SparseOperator

# Shifts of a singular banded block, in units of the matrix's largest column sum.
NUDGES = (0.0, 1e-12, 1e-9, 1e-6)


class BandedSystem:
    """Band LU factors of the free block of a narrow sparse matrix, on the host.

    A singular block is slightly shifted.
    """

    def __init__(self, A: SparseOperator) -> None:
        self._A, self._version = A, -1
        self.r, self.e = A.layout.zeros(wp.float64), A.layout.zeros(wp.float64)
        self.refresh()

    def refresh(self) -> None:
        """Copy the entries to the host if they have changed."""
        if self._version != self._A.version:
            self._version, self._matrix = (
                self._A.version,
                BandedMatrix(bands_of(self._A, self._A.bandwidth)),
            )

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Set another free set and shift."""
        self._free = free.numpy() != 0
        self._shift = 0.0 if shift is None else np.where(self._free, shift.numpy(), 0.0)

    def norm(self) -> float:
        """Return ||r||, unweighted for matrices that are solved directly."""
        return float(np.linalg.norm(self.r.numpy()))

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Factor the free block and solve; the tolerance is not used."""
        A, r, free = self._matrix, self.r.numpy(), self._free
        for nudge in NUDGES:
            e = A.solve(free, r, self._shift + nudge * A.size)
            if e is not None and np.isfinite(e).all():
                self.e.assign(e)
                return 1, float(
                    np.linalg.norm(np.where(free, A.product(e) + self._shift * e - r, 0.0))
                )
        self.e.zero_()
        return 1, self.norm()
