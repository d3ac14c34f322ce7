"""Distances to meshes measured by several processes: equal to those of one."""

import numpy as np
import pytest
import warp as wp

from default_run import covering
from warp_lcp.grid.distributed_distance import enter_layers, layer_of, measure_together
from warp_lcp.grid.grid_part import GridPart
from warp_lcp.grid.node_distance import NodeDistances, NodeSampler, nodes_near
from warp_lcp.grid.node_distance_kernels import FAR
from warp_lcp.grid.signed_distance import Placement, TriangleMesh
from warp_lcp.grid.staggered import StaggeredGrid

COUNTS, DX = (18, 14, 11), 0.05


class RanksInTurn:
    """Several ranks in turn.

    `everyone` maps each rank to its values; `gather` returns them.
    """

    def __init__(self, rank, size, everyone):
        self.rank, self.size, self.everyone = rank, size, everyone

    def gather(self, values):
        self.everyone[self.rank] = values
        return np.stack([self.everyone.get(rank, values) for rank in range(self.size)])


def part_of(rank, size, everyone):
    """Return the grid of the cells of a rank, cut along x."""
    first, end = COUNTS[0] * rank // size, COUNTS[0] * (rank + 1) // size
    grid = StaggeredGrid(
        (end - first, *COUNTS[1:]), DX, 3, "cpu", origin=(first, 0, 0), whole=COUNTS
    )
    object.__setattr__(grid, "part", GridPart(grid))
    grid.part.ranks = RanksInTurn(rank, size, everyone)
    return grid


@pytest.mark.parametrize(("size", "seed"), covering([2, 3, 5], [311, 312]))
def test_ranks_have_the_distances_of_one_process(size, seed):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0.0, 360.0, 3).tolist()
    meshes = {
        key: TriangleMesh.from_file(
            "builtin:torus",
            placement=Placement.from_degrees(scale, angles, rng.uniform(0.2, 0.6, 3).tolist(), 3),
        )
        for key, scale in ((4, 0.3), (7, 0.5))
    }
    # No node is near.
    meshes[9] = TriangleMesh.from_file(
        "builtin:torus", placement=Placement(scale=0.2, translation=[5.0, 5.0, 5.0])
    )
    whole = StaggeredGrid(COUNTS, DX, 3, "cpu")
    expected = NodeDistances(whole, second=True)
    for key, mesh in meshes.items():
        NodeSampler(whole).enter(expected, key, mesh)
    everyone: dict[int, np.ndarray] = {}
    for rank in range(size):  # each measures; the measurements of others come in the next round
        measure_together(NodeSampler(part_of(rank, size, everyone)), meshes)
    for rank in range(size):
        grid = part_of(rank, size, everyone)
        nodes, layers = (
            NodeDistances(grid, second=True),
            measure_together(NodeSampler(grid), meshes),
        )
        assert layers[9] == []
        for key in meshes:
            enter_layers(nodes, key, layers[key])
        x = grid.origin[0]
        for found, one in zip(nodes.arrays, expected.arrays, strict=True):
            mine, theirs = found.numpy(), one.numpy()[:, :, x : x + grid.shape[2]]
            near = expected.near.numpy()[:, :, x : x + grid.shape[2]] < FAR
            if found.dtype is wp.float32:
                np.testing.assert_allclose(
                    np.minimum(mine, FAR), np.minimum(theirs, FAR), rtol=0, atol=1e-4
                )
            elif found is nodes.owner:
                np.testing.assert_array_equal(mine[near], theirs[near])


@pytest.mark.parametrize("ranks", [1, 2, 3, 7])
def test_layers_cover_a_box_once(ranks):
    low, high = nodes_near(
        StaggeredGrid(COUNTS, DX, 3, "cpu"),
        TriangleMesh.from_file("builtin:torus", placement=Placement(scale=0.3)),
    )
    layers = [layer_of((low, high), rank, ranks) for rank in range(ranks)]
    assert sum(layer.cells for layer in layers) == np.prod(high - low)
    assert layers[0].cells == max(layer.cells for layer in layers)
    covered = np.zeros(high[::-1], dtype=int)
    for layer in layers:
        covered[layer.slices] += 1
    assert covered.max() == 1
