"""The matrix of a grid operator, for what needs its rows."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.problem.protocol import HasStencil


def grid_matrix(A: HasStencil) -> scipy.sparse.csr_array:
    """Assemble a grid operator on its FLUID cells, in their order, from its diagonal and lower-face weights.

    Args:
        A: an operator that no other process has a part of.

    Returns:
        The matrix, float64.
    """
    s, padding = A.stencil, A.layout.padding
    fluid = (A.cells.numpy() == FLUID).ravel()
    index = np.where(fluid, np.cumsum(fluid) - 1, -1)
    around = index.reshape(padding.shape)
    for axis, wraps in enumerate(A.periodic):
        if wraps:  # below the first cell is the last one
            np.moveaxis(around, 2 - axis, 0)[0] = np.moveaxis(around, 2 - axis, 0)[-2]
    cells = np.flatnonzero(fluid)
    rows, columns, entries = [index[cells]], [index[cells]], [s.d.numpy()[cells].astype(np.float64) * s.unit]
    for axis, offset in enumerate((1, padding.row, padding.plane)):
        joined = cells[index[cells - offset] >= 0]
        weight = s.weights[axis].numpy()[joined].astype(np.float64) if s.weights is not None else np.full(len(joined), s.coefficients[axis])
        i, j = index[joined], index[joined - offset]
        rows += [i, j]
        columns += [j, i]
        entries += [-weight, -weight]
    n = len(cells)
    matrix = scipy.sparse.coo_array((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n)).tocsr()
    matrix.eliminate_zeros()
    return matrix
