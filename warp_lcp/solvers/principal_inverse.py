"""The inverse of A's principal block on a set of indices that changes by one index at a time, O(n^2) a change."""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dger

from warp_lcp.solvers.dense_problem import RANK

CLOSE = 1e-12  # the same, from which a direction is refined: a tenth of what IncrementalPivoting takes for no change
ACCEPTED = 1e-10  # backward error, relative to the right-hand side, with which a direction is used; a singular block's stays near 1


class PrincipalInverse:
    """Solves A_FF z = r for a growing and shrinking set F of a symmetric positive semi-definite A.

    The inverse is bordered when an index joins and deflated when one leaves. A is kept with the rows and columns of F first, in the order
    of `members`, so that a product with A's columns F tells the solution's residual too. An inverse that has lost its accuracy is
    computed afresh; where the block itself is singular the minimum-norm least-squares solution takes over.

    Args:
        A: symmetric, shape (n, n).

    Attributes:
        refactorizations: fresh inverses made so far.
        singular: whether A_FF is numerically singular now.
    """

    def __init__(self, A: np.ndarray) -> None:
        n = len(A)
        self.count, self.refactorizations, self.singular = 0, 0, False
        self._order, self._place, self._permuted = np.arange(n), np.arange(n), A.copy()
        self._inverse, self._padded = np.zeros((n, n), order="F"), np.zeros(n)
        self._last: tuple[int, np.ndarray] | None = None  # index and solution of the last direction, while F has not changed

    @property
    def members(self) -> np.ndarray:
        """F in the order of its rows here, shape (k,)."""
        return self._order[: self.count]

    @property
    def block(self) -> np.ndarray:
        """A_FF in the order of `members`, shape (k, k)."""
        return self._permuted[: self.count, : self.count]

    def direction(self, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return z with A_FF z = -A_Fj, shape (k,), and the rate of y = A x where x_F moves by z and x_j by 1, shape (n,)."""
        k, row = self.count, self._permuted[self._place[j]]
        z = np.zeros(k) if self.singular else -(self._inverse[:k, :k] @ row[:k])
        rate = self._permuted[:, :k] @ z + row
        if k and (self.singular or not np.abs(rate[:k]).max() <= CLOSE * np.abs(row[:k]).max()):
            z = self.solve(-row[:k])
            rate = self._permuted[:, :k] @ z + row
        self._last = j, -z
        dy = np.empty(len(rate))
        dy[self._order] = rate
        return z, dy

    def insert(self, j: int) -> None:
        """Add an index to F."""
        k, last = self.count, self._last
        column = self._permuted[self._place[j], :k].copy()
        u = last[1] if last is not None and last[0] == j else self.solve(column)
        self._swap(int(self._place[j]), k)
        schur = self._permuted[k, k] - column @ u
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
        last, at = self.count - 1, int(self._place[j])
        _exchange(self._inverse[: last + 1, : last + 1], at, last)
        self._swap(at, last)
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
        for fresh in (False, True):
            if not self.singular:
                z = self._refined(r)
                if self._meets(z, r):
                    return z
                if not fresh:
                    self.refresh()
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

    def _swap(self, at: int, other: int) -> None:
        """Let two indices change places."""
        self._last = None
        _exchange(self._permuted, at, other)
        self._order[[at, other]] = self._order[[other, at]]
        self._place[self._order[[at, other]]] = at, other

    def _add_outer(self, v: np.ndarray, factor: float, k: int) -> None:
        """Add factor v v' to the leading k x k part of the inverse."""
        self._padded[:k], self._padded[k:] = v, 0.0
        if k:  # of whole columns, which BLAS updates in place
            dger(factor, self._padded, v, a=self._inverse[:, :k], overwrite_a=True)


def _exchange(matrix: np.ndarray, i: int, j: int) -> None:
    """Exchange two rows and the same columns."""
    if i != j:
        for view in (matrix, matrix.T):
            view[[i, j]] = view[[j, i]]
