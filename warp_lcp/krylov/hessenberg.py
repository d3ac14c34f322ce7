"""Least squares of GMRES: Givens rotations of a Hessenberg matrix."""

from __future__ import annotations

import math

import numpy as np


class HessenbergLeastSquares:
    """min |g - H y| for a matrix H that grows by a column at a time.

    Givens rotations keep H upper triangular; |g_k+1| is the norm of the residual.

    Args:
        columns: the most columns.

    Attributes:
        H: the triangle, shape (columns + 1, columns).
        g: the right-hand side, shape (columns + 1,).
    """

    def __init__(self, columns: int) -> None:
        self.H, self.g = np.zeros((columns + 1, columns)), np.zeros(columns + 1)
        self._rotations = np.zeros((columns, 2))

    def begin(self, norm: float) -> None:
        """Begin with the norm of a residual."""
        self.g[:] = 0.0
        self.g[0] = norm

    def rotate(self, k: int) -> None:
        """Make column k of H upper triangular by the old rotations and a new one."""
        H, g, rotations = self.H, self.g, self._rotations
        for i in range(k):
            c, s = rotations[i]
            H[i, k], H[i + 1, k] = c * H[i, k] + s * H[i + 1, k], c * H[i + 1, k] - s * H[i, k]
        length = math.hypot(H[k, k], H[k + 1, k])
        c, s = (H[k, k] / length, H[k + 1, k] / length) if length > 0 else (1.0, 0.0)
        rotations[k] = c, s
        H[k, k], H[k + 1, k] = length, 0.0
        g[k], g[k + 1] = c * g[k], -s * g[k]

    def solve(self, columns: int) -> np.ndarray:
        """Return y with H y = g, shape (columns + 1,) of the constructor, 0 behind its end.

        Columns of H that are singular to rounding are omitted.
        """
        # Back substitution with the triangle H.
        H, g = self.H[:columns, :columns], self.g
        y = np.zeros(len(g))
        largest = float(np.abs(np.diag(H)).max(initial=0.0))
        for k in reversed(range(columns)):
            if abs(H[k, k]) > 1e-14 * largest:
                y[k] = (g[k] - H[k, k + 1 :] @ y[k + 1 : columns]) / H[k, k]
        return y
