"""Base of the linear systems that a Krylov method solves, with their norm."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import Communicator, RowReduction, rows_of

KERNELS = KernelFile(Path(__file__).parent / "headers/krylov.h")
NORM = KERNELS["krylov.norm"]


class KrylovMethod(Protocol):
    """Krylov method for one system.

    Attributes:
        x: the solution, a stored field.
    """

    @property
    def x(self) -> DeviceArray: ...  # noqa: D102

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from 0; return the number of iterations and the norm reached."""


class KrylovSystem:
    """A system that a Krylov method solves; `r` is its right-hand side."""

    r: DeviceArray

    def _iterate_by(
        self,
        method: KrylovMethod,
        weight: DeviceArray | None,
        rows: Rows | None = None,
        comm: Communicator | None = None,
    ) -> None:
        """Set the Krylov method.

        It has `solve`, and the solution in `x`. Norms are weighted like its own, over the same
        rows.
        """
        self._krylov, self.e, self._norms, self._weighted_by = (
            method,
            method.x,
            RowReduction(rows or rows_of(self.r), comm=comm),
            weight,
        )

    def norm(self, field: DeviceArray | None = None) -> float:
        """Return the norm ||weight^(1/2) r||, or that of another field like r."""
        return float(
            np.sqrt(
                self._norms.of(NORM, r=self.r if field is None else field, w=self._weighted_by)[0]
            )
        )

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from e = 0 until the norm is at most the tolerance.

        Returns the number of iterations and the norm reached.
        """
        return self._krylov.solve(tolerance, max_iterations)
