"""Independent A x + b and natural residual of hostile problems, in float64.

Everything is assembled without code of the library. The natural residual is

    r_i = d_i (x_i - clip(x_i - y_i / d_i, l_i, u_i)),   d_i = 1 / (s_i c_i),

where diag(s) A diag(c) is equilibrated. d_i is |A_ii| if no transversal of A has a larger product
than the diagonal; otherwise it is that of columns scaled to 1, then rows. d_i is 1 for empty rows
and columns. Norms are scaled by their largest entry, so that squares neither overflow nor vanish.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from scipy.optimize import linear_sum_assignment

from warp_lcp.files import TableView

AIR, FLUID, SOLID = 0, 1, 2
AXES = "xyz"


@dataclass(frozen=True)
class ExactEquations:
    """Equations of the unknowns alone, in float64."""

    matrix: scipy.sparse.csr_array  # shape (n, n)
    b: np.ndarray  # shape (n,), units of y
    lower: np.ndarray  # shape (n,)
    upper: np.ndarray  # shape (n,)
    columns: np.ndarray | None = None  # U of a term U W U', shape (n, k); none if None
    weights: np.ndarray | None = None  # W, shape (k, k)

    @property
    def start(self) -> np.ndarray:
        """Clipped zero: clip(0, l, u)."""
        return np.clip(np.zeros(len(self.b)), self.lower, self.upper)

    @cached_property
    def scale(self) -> np.ndarray:
        """Scale d of the natural residual, from the matrix."""
        return equilibrated_scale(self.matrix)

    def diagonal(self, *, bodies: bool = True) -> np.ndarray:
        """Return d, without the semi-definite term of the bodies if `bodies` is False."""
        if self.columns is None or self.weights is None:
            return self.scale
        d = np.asarray(self.matrix.diagonal(), dtype=np.float64)
        if bodies:
            d = d + np.einsum("ij,jk,ik->i", self.columns, self.weights, self.columns)
        return np.where(d == 0.0, 1.0, np.abs(d))

    def residual(self, x: np.ndarray, *, bodies: bool = True) -> float:
        """Return the norm of the natural residual at x, shape (n,).

        `bodies` is that of `diagonal` and affects the scale alone.
        """
        d = self.diagonal(bodies=bodies)
        y = self.matrix @ x + self.b
        if self.columns is not None:
            y = y + self.columns @ (self.weights @ (self.columns.T @ x))
        return norm(d * (x - np.clip(x - y / d, self.lower, self.upper)))

    def sizes(self, x: np.ndarray) -> float:
        """Return || (d + |A|) |x| + |b| ||.

        Rounding errors of a residual are proportional to it.
        """
        size = abs(self.matrix) @ np.abs(x) + self.diagonal() * np.abs(x) + np.abs(self.b)
        if self.columns is not None and self.weights is not None:
            size = size + np.abs(self.columns) @ (
                np.abs(self.weights) @ (np.abs(self.columns).T @ np.abs(x))
            )
        return norm(size)


def equilibrated_scale(matrix: scipy.sparse.sparray) -> np.ndarray:
    """Return the scale d of a matrix's natural residual.

    The cost of an entry is log(sqrt(|a_ii a_jj|) / |a_ij|). The cost of the diagonal is 0, and a
    transversal has a negative cost if its product is larger than that of the diagonal. A matching
    is computed only if some cost is negative. Without a larger transversal d_i = |a_ii|. Otherwise
    q_j is the largest entry of a column, t_i the largest of a row after the division by q, and d =
    q t.
    """
    A = scipy.sparse.csr_array(matrix, dtype=np.float64)
    A.eliminate_zeros()
    entries, d = A.tocoo(), np.abs(A.diagonal())
    size, row, column = np.abs(entries.data), entries.row, entries.col
    empty = (np.diff(A.indptr) == 0) & (np.bincount(column, minlength=len(d)) == 0)
    if (d[~empty] > 0).all():
        one = np.where(empty, 1.0, d)
        cost = np.log(np.sqrt(one[row])) + np.log(np.sqrt(one[column])) - np.log(size)
        if (cost >= -1e-6).all() or _least_cost(
            cost, row, column, np.flatnonzero(empty), len(d)
        ) >= -1e-6 * len(d):
            return one
    q, t = np.zeros(len(d)), np.zeros(len(d))
    np.maximum.at(q, column, size)
    q[q == 0] = 1.0
    np.maximum.at(t, row, size / q[column])
    t[t == 0] = 1.0
    return q * t


def _least_cost(
    cost: np.ndarray, row: np.ndarray, column: np.ndarray, alone: np.ndarray, n: int
) -> float:
    """Return the least cost of matching rows and columns, dense in O(n^3).

    `alone`: rows and columns that are matched with themselves at no cost.
    """
    # The other entries are practically forbidden.
    table = np.full((n, n), 4.0 * n * (float(np.abs(cost).max()) + 1.0))
    table[row, column], table[alone, alone] = cost, 0.0
    return float(table[linear_sum_assignment(table)].sum())


def norm(values: np.ndarray) -> float:
    """Return the 2-norm; inf or NaN where a value is."""
    largest = float(np.abs(values).max(initial=0.0))
    if largest == 0.0 or not np.isfinite(largest):
        return largest
    return largest * float(np.linalg.norm(values / largest))


def stencil(
    cells: np.ndarray,
    faces: TableView,
    shift: float | np.ndarray | None = None,
    periodic: tuple[bool, ...] = (False, False, False),
) -> tuple[scipy.sparse.csr_array, np.ndarray]:
    """Return the matrix of the FLUID cells, and which cells these are, flat.

    It is assembled face by face from the definition. A face with the coefficient c adds c to the
    diagonal of each FLUID cell beside it, and -c between two of them. A SOLID cell on one side
    closes the face. The end of the array closes it too, unless the axis is periodic.

    Args:
        cells: AIR, FLUID, SOLID, shape (nz, ny, nx) or (ny, nx).
        faces: `face_x`, `face_y`, `face_z`: numbers or arrays with one face more along their axis;
            1 by default.
        shift: added to the diagonal, a number or shape of `cells`.
        periodic: whether x, y, z wrap around.
    """
    grid = cells.reshape((1,) * (3 - cells.ndim) + cells.shape)
    index = np.arange(grid.size).reshape(grid.shape)
    d = (
        np.zeros(grid.size)
        if shift is None
        else np.broadcast_to(shift, cells.shape).astype(np.float64).ravel().copy()
    )
    rows, columns, values = [], [], []
    for axis in range(cells.ndim):
        ax, count = 2 - axis, grid.shape[2 - axis]
        wraps = axis < len(periodic) and periodic[axis] and count > 1
        below = np.arange(-1 if wraps else 0, count - 1)
        face = np.asarray(faces.get(f"face_{AXES[axis]}", 1.0), dtype=np.float64)
        shape = [n + (q == ax) for q, n in enumerate(grid.shape)]
        c = (
            np.broadcast_to(face.reshape(shape if face.ndim else ()), shape)
            .take(below + 1, ax)
            .ravel()
        )
        p, q = index.take(below % count, ax).ravel(), index.take(below + 1, ax).ravel()
        types = grid.ravel()
        is_open = (types[p] != SOLID) & (types[q] != SOLID)
        p, q, c = p[is_open], q[is_open], c[is_open]
        np.add.at(d, p, c)
        np.add.at(d, q, c)
        between = (types[p] == FLUID) & (types[q] == FLUID)
        rows += [p[between], q[between]]
        columns += [q[between], p[between]]
        values += [-c[between], -c[between]]
    fluid = grid.ravel() == FLUID
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    coupling = scipy.sparse.coo_array(entries, shape=(grid.size, grid.size)).tocsr()[fluid][
        :, fluid
    ]
    return (coupling + scipy.sparse.diags_array(d[fluid])).tocsr(), fluid
