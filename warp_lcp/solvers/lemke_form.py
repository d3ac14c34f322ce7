"""Boxed problems as the LCP of larger size that Lemke's method pivots in: 0 <= z, w = M z + q >= 0, z'w = 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from warp_lcp.solvers.dense_problem import DenseProblem

REGULAR = 1e-10  # reciprocal condition number above which the equations' block is eliminated


@dataclass(frozen=True)
class LemkeForm:
    """M, q and the affine map from z back to x ([Book] 1.2.2 and table 3.4 state the reformulations).

    - l = u: x is known; its row asks nothing.
    - a finite l: x = l + z; only u finite: x = u - z, and the row changes its sign.
    - both finite: one more pair, s = u - l - z >= 0 with v >= 0 and y = w - v: M = [[A, I], [-I, 0]], positive semi-definite if A is.
    - equations: x_E = -A_EE^-1 (b_E + A_EI x_I) is eliminated where A_EE is regular (M is then the Schur complement); otherwise x = x+ - x-
      with M = [[A, -A], [-A, A]], positive semi-definite if A is.

    Attributes:
        M: shape (m, m); sparse, like `map`, where the problem is.
        q: shape (m,).
        base: x at z = 0, shape (n,).
        map: x = base + map z, shape (n, m).
    """

    M: Any
    q: np.ndarray
    base: np.ndarray
    map: Any

    @classmethod
    def of(cls, data: DenseProblem) -> LemkeForm:
        """Reformulate a boxed problem."""
        if scipy.sparse.issparse(data.A):
            return cls._of_one_sided(data)
        A, lower, upper, n = data.A, data.lower, data.upper, len(data.b)
        fixed = lower == upper
        below, above = np.isfinite(lower) & ~fixed, np.isfinite(upper) & ~fixed
        equations = np.flatnonzero(~below & ~above & ~fixed)
        sided = np.flatnonzero(below | above)
        base = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper, 0.0))
        sign = np.where(below, 1.0, -1.0)[sided]
        # columns: what z does to x; the rows of y are combined likewise
        columns = np.zeros((n, len(sided)))
        columns[sided, np.arange(len(sided))] = sign
        if len(sided) == n:
            M, q = sign[:, None] * A * sign, sign * (A @ base + data.b)
        elif len(equations):
            block = A[np.ix_(equations, equations)]
            if 1 / np.linalg.cond(block) > REGULAR:
                base[equations] = 0.0
                base[equations] = -np.linalg.solve(block, (A @ base + data.b)[equations])
                columns[equations] = -np.linalg.solve(block, (A @ columns)[equations])
                tests = columns[sided].T
                M, q = tests @ (A @ columns)[sided], tests @ (A @ base + data.b)[sided]
            else:
                split = np.zeros((n, 2 * len(equations)))
                split[np.r_[equations, equations], np.arange(2 * len(equations))] = np.repeat([1.0, -1.0], len(equations))
                columns = np.hstack([columns, split])
                M, q = columns.T @ A @ columns, columns.T @ (A @ base + data.b)
        else:  # a choice of rows and columns with signs, no product of matrices
            M, q = sign[:, None] * A[np.ix_(sided, sided)] * sign, sign * (A @ base + data.b)[sided]
        both = np.flatnonzero((below & above)[sided])
        if len(both):
            m, k = len(q), len(both)
            pick = np.zeros((k, m))
            pick[np.arange(k), both] = 1.0
            M = np.block([[M, pick.T], [-pick, np.zeros((k, k))]])
            q = np.r_[q, (upper - lower)[sided][both]]
            columns = np.hstack([columns, np.zeros((n, k))])
        return cls(M, q, base, columns)

    @classmethod
    def _of_one_sided(cls, data: DenseProblem) -> LemkeForm:
        """Reformulate a sparse problem all of whose rows are one-sided."""
        below = np.isfinite(data.lower)
        S, base = scipy.sparse.diags_array(np.where(below, 1.0, -1.0)), np.where(below, data.lower, data.upper)
        return cls((S @ data.A @ S).tocsr(), S @ data.affine(base), base, S)

    def solution(self, z: np.ndarray) -> np.ndarray:
        """Return x."""
        return self.base + self.map @ z


def one_sided(data: DenseProblem) -> np.ndarray:
    """Return which rows have one finite bound, shape (n,)."""
    return np.isfinite(data.lower) != np.isfinite(data.upper)
