"""Lemke's basis where the matrix is narrow: banded factors at each pivot, O(n) instead of O(n^2)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.solvers.dense_problem import DenseProblem
from warp_lcp.solvers.lemke_form import one_sided

WIDEST, FEW = 3, 30  # bandwidth that is called narrow, and unknowns up to which a dense inverse costs no more


def narrow_problem(problem: LCP) -> DenseProblem | None:
    """Return a sparse problem of small bandwidth whose every row has one finite bound, None if it is another one."""
    A = problem.A
    if not isinstance(A, SparseOperator) or A.unknowns <= FEW or A.bandwidth > WIDEST:
        return None
    data = DenseProblem.read(problem, keep_sparse=True)
    return data if one_sided(data).all() else None


class BandedFactors:
    """C = T + u e_p' and its factors: column i of T is e_i or -M_i, that of the pair p, both of whose variables are out, is e_p.

    Args:
        M: sparse, shape (m, m).
        d: covering vector: z0's column is -d, and stands in place p.
    """

    def __init__(self, M: scipy.sparse.csr_array, d: np.ndarray) -> None:
        m, entries = len(d), M.tocoo()
        self.m, self.k = m, int(np.abs(entries.row - entries.col).max(initial=0))
        self._bands, self._unit = np.zeros((3 * self.k + 1, m)), np.zeros((3 * self.k + 1, m))
        self._bands[2 * self.k + entries.row - entries.col, entries.col] = -entries.data
        self._unit[2 * self.k] = 1.0
        self._d = d

    def factor(self, by_z: np.ndarray, p: int) -> bool:
        """Take -M_i where `by_z` says so; return whether T is regular."""
        self._p = p
        chosen = by_z.copy()
        chosen[p] = False
        self._lu, self._pivots, info = scipy.linalg.lapack.dgbtrf(np.where(chosen, self._bands, self._unit), self.k, self.k)
        u = -self._d.copy()
        u[p] -= 1.0
        self._update = self._back(u)
        self._denominator = 1.0 + self._update[p]
        return bool(info == 0 and self._denominator != 0 and np.isfinite(self._update).all())

    def column(self, j: int) -> np.ndarray:
        """Return -M_j."""
        column, first, last = np.zeros(self.m), max(j - self.k, 0), min(j + self.k + 1, self.m)
        column[first:last] = self._bands[2 * self.k + first - j : 2 * self.k + last - j, j]
        return column

    def solve(self, r: np.ndarray) -> np.ndarray:
        """Return C^-1 r, r of shape (m,) or (m, columns)."""
        s = self._back(r)
        return s - np.multiply.outer(self._update, s[self._p] / self._denominator)

    def rows(self, indices: np.ndarray) -> np.ndarray:
        """Return rows of C^-1, shape (len(indices), m)."""
        unit = np.zeros((self.m, len(indices) + 1))
        unit[np.r_[indices, self._p], np.arange(len(indices) + 1)] = 1.0
        t = self._back(unit, transposed=True).T
        return t[:-1] - np.multiply.outer(self._update[indices] / self._denominator, t[-1])

    def _back(self, r: np.ndarray, *, transposed: bool = False) -> np.ndarray:
        return scipy.linalg.lapack.dgbtrs(self._lu, self.k, self.k, r, self._pivots, trans=int(transposed))[0]
