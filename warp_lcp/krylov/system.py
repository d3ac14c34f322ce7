"""Systems that a Krylov method solves, and the norm in which they measure residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.krylov.conjugate_gradient import HEADERS
from warp_lcp.rows import RowPass
from warp_lcp.rows.vectors import Sums, rows_of

NORM = RowPass("krylov.norm", HEADERS / "norm.h", "S", reads={"r": "S", "w": "S"}, optional=("w",), sums=("rr",))


class WeightedNorm:
    """||weight^(1/2) r||.

    Args:
        like: a field like those to be measured.
        weight: field like it, >= 0; None: all 1.
    """

    def __init__(self, like: wp.array[Any], weight: wp.array[Any] | None = None) -> None:
        self._weight, self._sums = weight, Sums(rows_of(like))

    def of(self, r: wp.array[Any]) -> float:
        """Return the norm of r."""
        return float(np.sqrt(self._sums.of(NORM, r=r, w=self._weight)[0]))


class KrylovSystem:
    """A system that a Krylov method solves; `r` is its right-hand side."""

    r: wp.array[Any]

    def _iterate_by(self, method: Any, weight: wp.array[Any] | None) -> None:
        """Take what iterates: it has `solve`, and the solution in `x`. Norms are weighted like its own."""
        self._krylov, self.e, self._norm = method, method.x, WeightedNorm(self.r, weight)

    def norm(self) -> float:
        """Return the norm of r."""
        return self._norm.of(self.r)

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from e = 0 until the norm is at most the tolerance; return iterations and the norm reached."""
        return self._krylov.solve(tolerance, max_iterations)
