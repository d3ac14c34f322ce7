"""Renumbering of a sparse matrix's unknowns for memory locality.

If unknowns are numbered at random, each entry of a product reads x from another line of memory. At
a million unknowns a product then takes three to five times as long, and a solve three times, as in
an order that follows the matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

SMALLEST = 1 << 16  # number of unknowns from which fields exceed a core's own caches
# Mean distance of entries from the diagonal, as a share of n, above which renumbering is faster;
# the share is one third for a random numbering.
SCATTERED = 0.05
# Largest share of that distance that an order may leave: small-world graphs have no good order.
GAIN = 0.5
SAMPLE = 1 << 16  # number of entries in the sample of the mean distance


@dataclass(frozen=True)
class Renumbering:
    """A renumbering of unknowns.

    Unknown i of the new numbering is unknown `order[i]` of the old one; `place` is the inverse,
    both of shape (n,).
    """

    order: np.ndarray
    place: np.ndarray

    def matrix(self, host: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
        """Return a matrix in the new numbering, columns sorted."""
        moved = host[self.order]
        moved = scipy.sparse.csr_array(
            (moved.data, self.place[moved.indices], moved.indptr), shape=host.shape
        )
        moved.sort_indices()
        return moved


def renumbering(host: scipy.sparse.csr_array, block: int = 1) -> Renumbering | None:
    """Return the reverse Cuthill-McKee order (SciPy), or None.

    None where the numbering is a good one or that order is no better.

    Args:
        host: the matrix, shape (n, n), columns sorted.
        block: unknowns that stay together, such as the displacements of a node; divides n.
    """
    n = host.shape[0]
    before = _mean_distance(host)
    if n < SMALLEST or before < SCATTERED * n:
        return None
    graph = host if block == 1 else _blocks(host, block)
    # Breadth first by rows alone: on an unsymmetric pattern this is still an order, without the
    # cost of A + A'.
    nodes = scipy.sparse.csgraph.reverse_cuthill_mckee(
        scipy.sparse.csr_matrix(graph), symmetric_mode=True
    )
    order = (block * nodes[:, None] + np.arange(block, dtype=nodes.dtype)).ravel()
    place = np.empty_like(order)
    place[order] = np.arange(n, dtype=order.dtype)
    return Renumbering(order, place) if _mean_distance(host, place) < GAIN * before else None


def _blocks(host: scipy.sparse.csr_array, block: int) -> scipy.sparse.csr_array:
    """Return the pattern of the blocks of a matrix."""
    blocks = host.tobsr((block, block))
    return scipy.sparse.csr_array(
        (np.ones(len(blocks.indices), dtype=np.int8), blocks.indices, blocks.indptr),
        shape=(host.shape[0] // block,) * 2,
    )


def _mean_distance(host: scipy.sparse.csr_array, place: np.ndarray | None = None) -> float:
    """Return the mean |i - j| over entries, from a sample spread over all of them."""
    if host.nnz == 0:
        return 0.0
    entries = np.arange(0, host.nnz, max(1, host.nnz // SAMPLE))
    rows, columns = np.searchsorted(host.indptr, entries, side="right") - 1, host.indices[entries]
    if place is not None:
        rows, columns = place[rows], place[columns]
    return float(np.abs(rows.astype(np.int64) - columns).mean())
