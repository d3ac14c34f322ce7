"""Scale d of the natural residual, from A alone.

d_i converts a unit of x_i to one of y_i: d_i = 1 / (r_i c_i), where diag(r) A diag(c) has 1 as the
largest magnitude of each row and column (Ruiz 2001). Such r and c are not unique:

- Where some r and c make every diagonal entry 1, and no entry larger, d_i = |A_ii|: no cycle of
  entries has a product above that of its diagonal entries. That holds for symmetric positive
  semi-definite matrices with a positive diagonal, for M- and H-matrices, and for any of them with
  rows and columns scaled: as A becomes diag(R) A diag(C), d_i becomes R_i C_i d_i.
- Elsewhere Ruiz's iteration starts from the matrix whose columns are scaled. From there its limit
  has a closed form: c_j = 1 / q_j with q_j = max_k |a_kj|, and 1 / r_i = max_j |a_ij| / q_j. It
  does not depend on the units of x. It must depend on those of the rows, because the residual's
  norm adds rows in the units of y. For example [[e, -1], [1, 0]] is [[1, -1], [1, 0]] in other
  units of rows and columns for every e > 0. A scale that changed with both kinds of units would be
  of size e in row 1 and hide y_1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.kernels.fields import Layout
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.data_types import Matrix, dense, is_sparse

if TYPE_CHECKING:
    from warp_lcp.problem.operator_protocol import Operator

# Relative excess of entries over those of the diagonal that storage in float32 causes in
# semi-definite matrices of low rank.
SLACK = 1e-6
# Passes over the entries in search of r and c that make the diagonal 1: chains of rows that differ
# are rarely longer.
PASSES = 50
PROBES = 8  # random sign vectors that estimate the sizes of rows and columns
TRUSTED = 10.0  # times |A_ii|: larger row and column sizes of an operator replace |A_ii|


class NoTranspose(ValueError):
    """The transpose of an operator without one was requested."""


def scale_of_matrix(A: Matrix) -> np.ndarray:
    """Return d > 0, shape (n,), of a numpy or scipy.sparse matrix.

    An empty row or column counts as 1.
    """
    return sizes_of_matrix(A)[0]


def sizes_of_matrix(A: Matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return d, 1 / r and 1 / c, shape (n,); where d_i = |A_ii|, r = c."""
    size = abs(A)
    d = np.asarray(size.diagonal(), dtype=np.float64)
    with np.errstate(over="ignore"):
        if _diagonal_leads(size, d):
            d = np.where(d > 0, d, 1.0)
            return d, np.sqrt(d), np.sqrt(d)
    # Columns are scaled by q, then rows by t.
    q = _largest(size, 0)
    q = np.where(q > 0, q, 1.0)
    t = _largest(scaled(size, np.ones_like(q), 1 / q), 1)
    t = np.where(t > 0, t, 1.0)
    return q * t, t, q


def scale_by_products(
    diagonal: np.ndarray,
    product: Callable[[np.ndarray], np.ndarray],
    transposed: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return d > 0 of an operator with only its diagonal and products.

    |A_ii| where the rest of row and column i is not much larger; elsewhere q_i t_i as for a matrix,
    but with 2-norms, which are no smaller than the largest entries. With vectors z of random signs,
    the same each time, they are the roots of the means of (A'z)_j^2 and of (A diag(1 / q) z)_i^2
    (Hutchinson's estimator). Without a transpose q is 1: the sizes are those of rows.

    Args:
        diagonal: of A, shape (n,); zeros if it is not known.
        product: returns A z.
        transposed: returns A' z, or raises NoTranspose.
    """
    signs = np.random.default_rng(20010611).choice((-1.0, 1.0), (PROBES, len(diagonal)))
    try:
        q = np.sqrt(np.mean([transposed(z) ** 2 for z in signs], axis=0))
    except NoTranspose:
        q = np.ones(len(diagonal))
    q = np.where(q > 0, q, 1.0)
    t = np.sqrt(np.mean([product(z / q) ** 2 for z in signs], axis=0))
    d, found = np.abs(diagonal), q * np.where(t > 0, t, 1.0)
    return np.where((d > 0) & (found <= TRUSTED * d), d, found)


def estimated_scale(
    A: Operator, layout: Layout, unknown: np.ndarray, diagonal: np.ndarray | None = None
) -> np.ndarray:
    """Return `scale_by_products` of an operator, a flat stored field.

    It takes 16 products.

    Args:
        A: the operator.
        layout: of its fields.
        unknown: mask of the unknowns in a stored field, bool, shape (n,).
        diagonal: of A, a stored field; None: not known.
    """
    z, image = layout.zeros(wp.float64), layout.zeros(wp.float64)

    def images(
        apply: Callable[[DeviceArray, DeviceArray], DeviceArray],
    ) -> Callable[[np.ndarray], np.ndarray]:
        def product(values: np.ndarray) -> np.ndarray:
            z.assign(values * unknown)
            apply(z.reshape(layout.stored_shape), image.reshape(layout.stored_shape))
            return np.asarray(image.numpy() * unknown)

        return product

    d = np.zeros(layout.size) if diagonal is None else diagonal * unknown
    return scale_by_products(
        d, images(A.apply), images(A.apply if A.symmetric else A.apply_transpose)
    )


def _diagonal_leads(size: Matrix, d: np.ndarray) -> bool:
    """Return whether some r and c make the diagonal of |A| 1 and no entry larger.

    Rows that are empty together with their columns do not count. With r_i = g_i / sqrt(d_i) and c_i
    = 1 / (g_i sqrt(d_i)) these are difference constraints on log g, which Bellman and Ford's
    iteration solves; g = 1 is a solution for semi-definite matrices. A pair of entries across the
    diagonal that excludes every g is detected first.
    """
    zero = np.flatnonzero(d == 0)
    if zero.size and (_largest(size[zero], 1).any() or _largest(size[:, zero], 0).any()):
        return False
    # w_ij = |a_ij| / sqrt(d_i d_j) must satisfy g_i w_ij / g_j <= 1 for some g > 0.
    root = np.sqrt(np.where(d > 0, d, 1.0))
    w = scaled(size, 1 / root, 1 / root)
    if w.max() <= 1 + SLACK:
        return True
    # g cannot exist if w_ij w_ji > 1.
    if (w.multiply(w.T) if is_sparse(w) else np.asarray(w * w.T)).max() > 1 + 2 * SLACK:
        return False
    g = np.ones_like(d)
    # Bellman-Ford: reduce g_i until no constraint is violated.
    for _ in range(PASSES):
        most = _largest(scaled(w, g, 1 / g), 1)
        if most.max() <= 1 + SLACK:
            return True
        g = g / np.maximum(most, 1.0)
        if not (g > 0).all():
            return False
    return False


def scaled(A: Matrix, left: np.ndarray, right: np.ndarray) -> Matrix:
    """Return diag(left) A diag(right)."""
    if not is_sparse(A):
        return np.asarray(left[:, None] * A * right)
    data = np.repeat(left, np.diff(A.indptr))
    data *= A.data
    data *= right[A.indices]
    return scipy.sparse.csr_array((data, A.indices, A.indptr), shape=A.shape)


def _largest(A: Matrix, axis: int) -> np.ndarray:
    """Return the largest entries of the columns (0) or rows (1) of a matrix.

    The matrix has no negative entries.
    """
    return dense(A.max(axis=axis)).ravel()
