"""Banded matrices on the host, in the storage of LAPACK's band solvers."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator

NARROW = 3  # bandwidth up to which LAPACK's band factors cost less than launches of kernels, whatever the number of unknowns
SINGULAR = 1e-13  # of the largest column sum: a pivot below it is rounding


class BandedMatrix:
    """A matrix with few diagonals, float64.

    Args:
        bands: a_ij at (width + i - j, j), shape (2 width + 1, n).

    Attributes:
        width: the number of diagonals on either side of the main one.
        size: the largest column sum of magnitudes.
    """

    def __init__(self, bands: np.ndarray) -> None:
        self.bands, self.width = bands, len(bands) // 2
        self._by_columns = np.asfortranarray(bands)
        sizes = np.abs(bands).sum(axis=0)
        self.size, self._own = sizes.max(), np.where(sizes > 0, sizes, 1.0)

    @property
    def diagonal(self) -> np.ndarray:
        """The main diagonal, shape (n,)."""
        return self.bands[self.width]

    def product(self, x: np.ndarray) -> np.ndarray:
        """Return A x, shape (n,)."""
        n, k = len(x), self.width
        return scipy.linalg.blas.dgbmv(n, n, k, k, 1.0, self._by_columns, x)

    def solve(self, free: np.ndarray, r: np.ndarray, shift: np.ndarray | float = 0.0) -> np.ndarray | None:
        """Return e with (A + D)_FF e_F = r_F and 0 elsewhere; None where a pivot shows that the block is singular.

        Held rows and columns, those off F, keep a diagonal entry of the column's size.

        Args:
            free: F, bool, shape (n,).
            r: shape (n,).
            shift: the diagonal of D >= 0, a number or shape (n,).
        """
        k, n, masked = self.width, len(r), self.bands * free
        for o in range(-k, k + 1):
            masked[k - o, max(o, 0) : n + min(o, 0)] *= free[max(-o, 0) : n - max(o, 0)]
        masked[k] += np.where(free, shift, self._own)
        right = np.where(free, r, 0.0)
        if k == 0:
            pivots, info = masked[0], 0
            e = right / np.where(pivots == 0, 1.0, pivots)
        elif k == 1:
            _, pivots, _, e, info = scipy.linalg.lapack.dgtsv(masked[2, :-1], masked[1], masked[0, 1:], right)
        else:
            factors, _, e, info = scipy.linalg.lapack.dgbsv(k, k, np.vstack([np.zeros((k, n)), masked]), right)
            pivots = factors[2 * k]
        return None if info != 0 or np.abs(pivots).min() <= SINGULAR * self.size else e


def bandwidth(A: DenseOperator | SparseOperator) -> int:
    """Return the distance of the farthest entry from the diagonal."""
    if isinstance(A, SparseOperator):
        return A.bandwidth
    return max(scipy.linalg.bandwidth(A.matrix.numpy()))


def bands_of(A: DenseOperator | SparseOperator, width: int) -> np.ndarray:
    """Return the entries of an operator as the bands of a `BandedMatrix`, shape (2 width + 1, n)."""
    n = A.unknowns
    bands = np.zeros((2 * width + 1, n))
    if isinstance(A, SparseOperator):
        columns = A.indices.numpy()
        bands[width + np.repeat(np.arange(n), np.diff(A.indptr.numpy())) - columns, columns] = A.values.numpy()
        return bands
    host = A.matrix.numpy()
    for o in range(-width, width + 1):
        bands[width - o, max(o, 0) : n + min(o, 0)] = host.diagonal(o)
    return bands
