"""Banded matrices on the host, in the storage of LAPACK's band solvers."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator

# Bandwidth up to which LAPACK's band factors cost less than kernel launches, for every number of
# unknowns.
NARROW = 3
SINGULAR = 1e-13  # relative to the largest column sum: a smaller pivot is rounding


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
        return np.asarray(self.bands[self.width])

    def product(self, x: np.ndarray) -> np.ndarray:
        """Return A x, shape (n,)."""
        n, k = len(x), self.width
        return np.asarray(scipy.linalg.blas.dgbmv(n, n, k, k, 1.0, self._by_columns, x))

    def solve(
        self, free: np.ndarray, r: np.ndarray, shift: np.ndarray | float = 0.0
    ) -> np.ndarray | None:
        """Return e with (A + D)_FF e_F = r_F and 0 elsewhere.

        None where a pivot shows that the block is singular. Held rows and columns, those off F,
        keep a diagonal entry of the column's size.

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
            _, pivots, _, e, info = scipy.linalg.lapack.dgtsv(
                masked[2, :-1], masked[1], masked[0, 1:], right
            )
        else:
            factors, _, e, info = scipy.linalg.lapack.dgbsv(
                k, k, np.vstack([np.zeros((k, n)), masked]), right
            )
            pivots = factors[2 * k]
        return None if info != 0 or np.abs(pivots).min() <= SINGULAR * self.size else e


def bandwidth(A: DenseOperator | SparseOperator) -> int:
    """Return the distance of the farthest entry from the diagonal."""
    if isinstance(A, SparseOperator):
        return A.bandwidth
    return int(max(scipy.linalg.bandwidth(A.matrix.numpy())))


def bands_of(A: DenseOperator | SparseOperator, width: int) -> np.ndarray:
    """Return the entries of an operator in banded form.

    Shape (2 width + 1, n), as `BandedMatrix` takes them.
    """
    n = A.unknowns
    bands = np.zeros((2 * width + 1, n))
    if isinstance(A, SparseOperator):
        columns = A.indices.numpy()
        bands[width + np.repeat(np.arange(n), np.diff(A.indptr.numpy())) - columns, columns] = (
            A.values.numpy()
        )
        return bands
    host = A.matrix.numpy()
    for o in range(-width, width + 1):
        bands[width - o, max(o, 0) : n + min(o, 0)] = host.diagonal(o)
    return bands


class BandedFactors:
    """Factors of a complementary basis C = T + u e_p' of small bandwidth.

    Column i of the banded matrix T is e_i or -M_i. Column p, of the pair both of whose variables
    are nonbasic, is e_p; C has -d there, so that u = -d - e_p. C^-1 follows from the factors of T
    by the Sherman-Morrison formula.

    Args:
        M: sparse, shape (m, m).
        d: covering vector: z0's column is -d, in place p.
    """

    def __init__(self, M: scipy.sparse.csr_array, d: np.ndarray) -> None:
        m, entries = len(d), M.tocoo()
        self.m, self.k = m, int(np.abs(entries.row - entries.col).max(initial=0))
        self._bands, self._unit = np.zeros((3 * self.k + 1, m)), np.zeros((3 * self.k + 1, m))
        self._bands[2 * self.k + entries.row - entries.col, entries.col] = -entries.data
        self._unit[2 * self.k] = 1.0
        self._d = d

    def factor(self, by_z: np.ndarray, p: int) -> bool:
        """Factor T, whose columns i with `by_z[i]` are -M_i; return whether it is regular."""
        self._p = p
        chosen = by_z.copy()
        chosen[p] = False
        self._lu, self._pivots, info = scipy.linalg.lapack.dgbtrf(
            np.where(chosen, self._bands, self._unit), self.k, self.k
        )
        u = -self._d.copy()
        u[p] -= 1.0
        self._update = self._back(u)
        self._denominator = 1.0 + self._update[p]
        return bool(info == 0 and self._denominator != 0 and np.isfinite(self._update).all())

    def column(self, j: int) -> np.ndarray:
        """Return -M_j, shape (m,), from the bands."""
        column, first, last = np.zeros(self.m), max(j - self.k, 0), min(j + self.k + 1, self.m)
        column[first:last] = self._bands[2 * self.k + first - j : 2 * self.k + last - j, j]
        return column

    def solve(self, r: np.ndarray) -> np.ndarray:
        """Return C^-1 r, r of shape (m,) or (m, columns)."""
        s = self._back(r)
        return np.asarray(s - np.multiply.outer(self._update, s[self._p] / self._denominator))

    def rows(self, indices: np.ndarray) -> np.ndarray:
        """Return rows of C^-1, shape (len(indices), m)."""
        unit = np.zeros((self.m, len(indices) + 1))
        unit[np.r_[indices, self._p], np.arange(len(indices) + 1)] = 1.0
        t = self._back(unit, transposed=True).T
        return np.asarray(
            t[:-1] - np.multiply.outer(self._update[indices] / self._denominator, t[-1])
        )

    def _back(self, r: np.ndarray, *, transposed: bool = False) -> np.ndarray:
        return np.asarray(
            scipy.linalg.lapack.dgbtrs(
                self._lu, self.k, self.k, r, self._pivots, trans=int(transposed)
            )[0]
        )
