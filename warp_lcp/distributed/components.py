"""Connected components over several ranks.

Each rank finds the parts in its box. The parts are the nodes of a graph, whose components are then
found.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from warp_lcp.distributed.ranks import Ranks

GROUND = 0  # node of the graph that stands for all supports


def nodes_of(ranks: Ranks, counts: np.ndarray) -> tuple[int, int]:
    """Return the node of this rank's first part, and the number of all nodes.

    The argument is the number of parts of each rank.
    """
    return 1 + int(counts[: ranks.rank].sum()), 1 + int(counts.sum())


def joined(ranks: Ranks, nodes: int, edges: np.ndarray) -> np.ndarray:
    """Return the number of each node's component, shape (nodes,); collective.

    Args:
        ranks: that have the parts.
        nodes: number of nodes.
        edges: pairs of nodes that are connected, as far as this rank knows, int32, shape (n, 2).
    """
    everyone = np.concatenate(ranks.collect(edges))
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(everyone)), tuple(everyone.T)), shape=(nodes, nodes)
    )
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1])
