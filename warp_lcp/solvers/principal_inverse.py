"""The inverse of A's principal block on a set of indices that changes by one index at a time, O(n^2) a change."""

from __future__ import annotations

import numpy as np

from warp_lcp.solvers.dense_problem import RANK

ACCEPTED = 1e-10  # backward error, relative to the right-hand side, with which a direction is used; a singular block's stays near 1


class PrincipalInverse:
    """Solves A_FF z = r for a growing and shrinking set F of a symmetric positive semi-definite A.

    The inverse is bordered when an index joins and deflated when one leaves; A_FF is kept contiguous in the order of `members`, so that
    every solve is refined once and its residual is known. An inverse that has lost its accuracy is computed afresh; where the block
    itself is singular the minimum-norm least-squares solution takes over.

    Args:
        A: symmetric, shape (n, n).

    Attributes:
        refactorizations: fresh inverses made so far.
        singular: whether A_FF is numerically singular now.
    """

    def __init__(self, A: np.ndarray) -> None:
        n = len(A)
        self.A, self.count, self.refactorizations, self.singular = A, 0, 0, False
        self._members = np.empty(n, dtype=np.int64)
        self._inverse, self._block, self._scratch = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))

    @property
    def members(self) -> np.ndarray:
        """F in the order of its rows here, shape (k,)."""
        return self._members[: self.count]

    @property
    def block(self) -> np.ndarray:
        """A_FF, shape (k, k)."""
        return self._block[: self.count, : self.count]

    def insert(self, j: int) -> None:
        """Add an index to F."""
        k, A = self.count, self.A
        column = A[self.members, j]
        u = self.solve(column)
        schur = A[j, j] - column @ u
        self._members[k] = j
        self._block[:k, k] = self._block[k, :k] = column
        self._block[k, k] = A[j, j]
        self.count = k + 1
        if self.singular or schur <= 0:
            self.refresh()
            return
        H = self._inverse
        self._add_outer(u, 1 / schur, k)
        H[:k, k] = H[k, :k] = -u / schur
        H[k, k] = 1 / schur

    def remove(self, j: int) -> None:
        """Take an index out of F."""
        last, at = self.count - 1, int(np.flatnonzero(self.members == j)[0])
        for matrix in (self._block, self._inverse):
            for view in (matrix, matrix.T):
                view[[at, last], : last + 1] = view[[last, at], : last + 1]
        self._members[[at, last]] = self._members[[last, at]]
        self.count = last
        pivot = self._inverse[last, last]
        if self.singular or not pivot > 0:
            self.refresh()
            return
        self._add_outer(self._inverse[:last, last].copy(), -1 / pivot, last)

    def solve(self, r: np.ndarray) -> np.ndarray:
        """Return z with A_FF z = r, refined; the least-squares solution where A_FF is singular."""
        if self.count == 0:
            return np.zeros(0)
        if not self.singular:
            z = self._refined(r)
            if self._meets(z, r):
                return z
            self.refresh()
        if not self.singular:
            z = self._refined(r)
            if self._meets(z, r):
                return z
        return np.linalg.lstsq(self.block, r, rcond=RANK)[0]

    def refresh(self) -> None:
        """Compute the inverse afresh, O(k^3)."""
        k = self.count
        self.refactorizations += 1
        try:
            self._inverse[:k, :k] = np.linalg.inv(self.block)
            self.singular = not np.isfinite(self._inverse[:k, :k]).all()
        except np.linalg.LinAlgError:
            self.singular = True

    def _refined(self, r: np.ndarray) -> np.ndarray:
        H = self._inverse[: self.count, : self.count]
        z = H @ r
        return z + H @ (r - self.block @ z)

    def _meets(self, z: np.ndarray, r: np.ndarray) -> bool:
        error = np.abs(r - self.block @ z).max()
        return bool(error <= ACCEPTED * np.abs(r).max())

    def _add_outer(self, v: np.ndarray, factor: float, k: int) -> None:
        """Add factor v v' to the leading k x k part of the inverse."""
        change = self._scratch[:k, :k]
        np.multiply(v[:, None], factor * v, out=change)
        self._inverse[:k, :k] += change
