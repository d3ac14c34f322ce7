"""Assemble the matrix of a grid operator."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.sparse

from warp_lcp.kernels.layout import Pattern
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.problem.operator_protocol import HasStencil


def grid_matrix(A: HasStencil) -> scipy.sparse.csr_array:
    """Assemble a grid operator on its FLUID cells, in their order.

    From its diagonal and its weights of neighbors.

    a_ii = unit d_i and a_ij = -w_ij for the weight of each FLUID neighbor j; neighbors of other
    types have no column. Weights of two faces between the same cells add up.

    Args:
        A: an operator in one process.

    Returns:
        The matrix, float64.
    """
    s, padding = A.stencil, A.layout.padding
    fluid = (A.cells.numpy() == FLUID).ravel()
    index = np.where(fluid, np.cumsum(fluid) - 1, -1)
    around = index.reshape(padding.shape)
    for axis, wraps in enumerate(A.periodic):
        if wraps:  # below the first cell is the last one, and above that the first
            lines = np.moveaxis(around, 2 - axis, 0)
            lines[0], lines[-1] = lines[-2], lines[1]
    cells = np.flatnonzero(fluid)
    rows, columns, entries = (
        [index[cells]],
        [index[cells]],
        [s.d.numpy()[cells].astype(np.float64) * s.unit],
    )
    for step, weight, mirrored in _weights(A):
        offset = step[0] + step[1] * padding.row + step[2] * padding.plane
        joined = cells[index[cells + offset] >= 0]
        entries_here = (
            weight[joined].astype(np.float64)
            if isinstance(weight, np.ndarray)
            else np.full(len(joined), weight)
        )
        i, j = index[joined], index[joined + offset]
        rows += [i, j] if mirrored else [i]
        columns += [j, i] if mirrored else [j]
        entries += [-entries_here] * (1 + mirrored)
    n = len(cells)
    matrix = scipy.sparse.coo_array(
        (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n)
    ).tocsr()
    matrix.eliminate_zeros()
    return matrix


def _weights(A: HasStencil) -> Iterator[tuple[tuple[int, int, int], np.ndarray | float, bool]]:
    """Yield the neighbors of a cell and their weights.

    Each item is a step (x, y, z), its weight for each stored cell or everywhere, and whether the
    weight counts for both cells.
    """
    s = A.stencil
    pattern = s.pattern or Pattern(
        ((-1, 0, 0), (0, -1, 0), (0, 0, -1)), True, "numbers" if s.weights is None else "arrays"
    )
    for place, step in enumerate(pattern.offsets):
        if pattern.functions:
            function = pattern.functions[place]
            yield (
                step,
                -A.evaluated(function)  # type: ignore[attr-defined]
                if callable(function)
                else -function,
                False,
            )
        else:
            yield (
                step,
                s.coefficients[place] if s.weights is None else s.weights[place].numpy(),
                pattern.symmetric,
            )
