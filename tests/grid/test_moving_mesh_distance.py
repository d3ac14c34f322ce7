"""Meshes and gaps of one cell, measured on the device.

The results are those of the sampler that the host leads.
"""

import numpy as np
import pytest
import warp as wp
from cut_cell_tools import grid_of
from scipy.spatial.transform import Rotation

from warp_lcp.grid.motion import Pose
from warp_lcp.grid.moving_mesh_distance import FlatCells, MovingMesh, tables_of
from warp_lcp.grid.node_distance import NodeDistances, NodeSampler
from warp_lcp.grid.signed_distance import Box, Placement, Sphere, TriangleMesh, Union
from warp_lcp.grid.triangle_mesh import builtin_mesh


def compare_meshes(seed: int, dimension: int) -> None:
    """Enter a ball and then a turned torus by both, and compare every field exactly."""
    rng = np.random.default_rng(seed)
    counts = (22, 17) if dimension == 2 else (15, 13, 11)
    grid = grid_of(dimension, counts, 1.0 / counts[0])
    placement = Placement(
        scale=rng.uniform(0.2, 0.6),
        translation=np.append(rng.uniform(0.2, 0.6, dimension), 0.0)[:3],
    )
    mesh = TriangleMesh(
        surface=builtin_mesh("torus"), placement=placement, invert=bool(rng.random() < 0.2)
    )
    ball = Sphere(center=rng.uniform(0.2, 0.7, dimension), radius=0.15)
    table, sampler = MovingMesh(grid, 2, mesh), NodeSampler(grid)
    fields = [NodeDistances(grid, second=True) for _ in range(2)]
    for field in fields:
        sampler.enter(field, 1, ball)
    rotation = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    translation = rng.uniform(-0.2, 0.2, 3) * ([1, 1, 0] if dimension == 2 else 1)
    sampler.enter(fields[0], 2, mesh.moved(Pose(rotation, translation)))
    table.place(rotation[None], translation[None])
    table.enter(fields[1], sampler.snap)
    for one, other in zip(*(field.arrays for field in fields), strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_mesh_has_the_distances_of_the_sampler(dimension: int) -> None:
    for seed in range(3):
        compare_meshes(700 + seed, dimension)


def compare_gaps(seed: int, dimension: int) -> int:
    """Mark the gaps between plates on faces of cells by both; return their number."""
    rng = np.random.default_rng(seed)
    n = 12
    grid = grid_of(dimension, (n,) * dimension, 1.0 / n)
    solids = []
    # Plates and blocks, some next to a gap of one cell, some one cell thick.
    for number in range(1, 7):
        low = rng.integers(1, n - 3, dimension)
        high = low + rng.integers(1, 4, dimension)
        solids.append((number, Box(lower=low / n, upper=high / n)))
    nodes, sampler = NodeDistances(grid, second=True), NodeSampler(grid)
    for number, geometry in solids:
        sampler.enter(nodes, number, geometry)
    marks = [wp.zeros(grid.shape, dtype=wp.int8, device=grid.device) for _ in range(2)]
    geometries = [geometry for _, geometry in solids]
    sampler.look_at_centers(nodes, lambda: geometries, (0, 0, 0), grid.shape[::-1], marks[0])
    tables = tables_of(grid, solids)
    assert tables is not None
    FlatCells(grid, tables).mark(nodes, grid.domain, marks[1])
    np.testing.assert_array_equal(marks[0].numpy(), marks[1].numpy())
    return int(marks[0].numpy().sum())


@pytest.mark.parametrize("dimension", [2, 3])
def test_gaps_of_one_cell_are_marked_as_by_the_sampler(dimension: int) -> None:
    assert sum(compare_gaps(800 + seed, dimension) for seed in range(12)) > 0


def test_a_plate_that_a_mesh_fills_is_no_gap() -> None:
    """Plate filled by a mesh: no gap.

    A cell between two plates is a gap until a mesh lies in it, whose surface has distance 0 at the
    corners.
    """
    n = 12
    grid = grid_of(3, (n,) * 3, 1.0 / n)
    plates = [
        (1, Box(lower=[4 / n] * 3, upper=[8 / n, 5 / n, 8 / n])),
        (2, Box(lower=[4 / n, 6 / n, 4 / n], upper=[8 / n, 7 / n, 8 / n])),
    ]
    nodes, sampler = NodeDistances(grid, second=True), NodeSampler(grid)
    for number, geometry in plates:
        sampler.enter(nodes, number, geometry)
    found = []
    torus = TriangleMesh(
        surface=builtin_mesh("torus"), placement=Placement(scale=0.01, translation=np.full(3, 2.5))
    )
    for inverted in (False, True):  # far away: outside of it, or inside its complement
        mesh = TriangleMesh(surface=torus.surface, placement=torus.placement, invert=inverted)
        marks = wp.zeros(grid.shape, dtype=wp.int8, device=grid.device)
        tables = tables_of(grid, [*plates, (3, mesh)])
        assert tables is not None
        FlatCells(grid, tables).mark(nodes, grid.domain, marks)
        found.append(int(marks.numpy().sum()))
    assert found[0] > 0
    assert found[1] == 0


def test_unions_of_meshes_are_left_to_the_sampler() -> None:
    mesh = TriangleMesh(surface=builtin_mesh("torus"))
    assert (
        tables_of(
            grid_of(3, (6, 6, 6), 1 / 6),
            [(1, Union(parts=(mesh, Sphere(center=[0.5] * 3, radius=0.1))))],
        )
        is None
    )
