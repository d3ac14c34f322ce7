"""Distances to solids, measured by several processes together.

Each process measures its share of the nodes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warp_lcp.grid.cell_box import CellBox
from warp_lcp.grid.node_distance import NodeDistances, NodeSampler, nodes_near
from warp_lcp.grid.node_distance_kernels import claim_nodes
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.signed_distance_kernels import block_of
from warp_lcp.grid.staggered import StaggeredGrid

# Nodes of the domain, and the distances [cells] there, shape (nz, ny, nx).
Layer = tuple[CellBox, np.ndarray]


def measure_together(
    sampler: NodeSampler, geometries: Mapping[int, Geometry]
) -> dict[int, list[Layer]]:
    """Measure solids, each process one layer of the nodes of each solid; collective.

    The layers of a solid have equally many nodes.

    Args:
        sampler: sampler of this process's part of the grid.
        geometries: the solids where they are, the same on all processes.

    Returns:
        For each solid the layers of all processes; none where no node of the domain is near.
    """
    grid, ranks = sampler.grid, sampler.grid.part.ranks
    domain = StaggeredGrid(grid.domain_counts, grid.spacing, grid.dimension, grid.device)
    boxes = {
        key: box
        for key, geometry in geometries.items()
        if (box := nodes_near(domain, geometry)) is not None
    }
    measured: dict[int, list[Layer]] = {key: [] for key in geometries}
    if not boxes:
        return measured
    layers = {
        key: [layer_of(box, rank, ranks.size) for rank in range(ranks.size)]
        for key, box in boxes.items()
    }
    thickest = {key: of[0].cells for key, of in layers.items()}
    own_distances = np.empty(sum(thickest.values()), dtype=np.float32)
    first = 0
    for key, rank_layers in layers.items():
        layer = rank_layers[ranks.rank]
        own_distances[first : first + layer.cells] = _measure(sampler, geometries[key], layer)
        first += thickest[key]
    everyone, first = ranks.gather(own_distances), 0
    for key, rank_layers in layers.items():
        for layer, distances in zip(
            rank_layers, everyone[:, first : first + thickest[key]], strict=True
        ):
            measured[key].append((layer, distances[: layer.cells].reshape(layer.counts[::-1])))
        first += thickest[key]
    return measured


def layer_of(box: tuple[np.ndarray, np.ndarray], rank: int, ranks: int) -> CellBox:
    """Return the layer of a box of nodes that a rank measures.

    The box is cut across its longest axis; the first layer is the thickest.
    """
    low, high = (corner.copy() for corner in box)
    axis = int(np.argmax(high - low))
    thick, end = -(-int(high[axis] - low[axis]) // ranks), high[axis]
    low[axis] = min(low[axis] + rank * thick, end)
    high[axis] = min(low[axis] + thick, end)
    return CellBox.of(low, high)


def _measure(sampler: NodeSampler, geometry: Geometry, layer: CellBox) -> np.ndarray:
    """Return the distances [cells] of a solid at a layer of the domain's nodes, flat."""
    if not layer.cells:
        return np.empty(0, dtype=np.float32)
    grid = sampler.grid
    nx, ny, nz = (max(n - 2, 1) for n in layer.counts)
    before = (*layer.low[:2], layer.low[2] if grid.dimension == 3 else 0)
    around = StaggeredGrid(
        (nx, ny, nz), grid.spacing, grid.dimension, grid.device, before, grid.domain_counts
    )
    nodes = NodeDistances(around, second=False)
    sampler.enter(nodes, 1, geometry)
    return np.asarray(nodes.near.numpy()[layer.moved(before, -1).slices].ravel())


def enter_layers(nodes: NodeDistances, number: int, layers: list[Layer]) -> None:
    """Enter a solid's measured distances at the nodes of this process's part.

    Args:
        nodes: the node distances (updated).
        number: the solid's, > 0.
        layers: layers of `measure_together`.
    """
    grid = nodes.grid
    stored = CellBox((0, 0, 0), grid.shape[::-1]).moved(grid.origin)
    for layer, distances in layers:
        common = layer.common(stored)
        if common.cells:
            inside, local_box = common.moved(layer.low, -1), common.moved(grid.origin, -1)
            device_distances = wp.array(
                np.ascontiguousarray(distances[inside.slices]).ravel(),
                dtype=wp.float32,
                device=grid.device,
            )
            block = block_of(local_box.low, local_box.high, 1.0, grid.dimension, grid.origin)
            wp.launch(
                claim_nodes,
                len(device_distances),
                [block, device_distances, 0.0, number, nodes.struct],
                device=grid.device,
            )
