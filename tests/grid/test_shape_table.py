"""Solids entered by one launch: distances as by entering them in sequence."""

import numpy as np
import pytest
from cut_cell_tools import grid_of
from scipy.spatial.transform import Rotation

from warp_lcp.grid.motion import Pose
from warp_lcp.grid.node_distance import NodeDistances, NodeSampler, ShapeTable, nodes_near
from warp_lcp.grid.signed_distance import (
    Box,
    Capsule,
    Placement,
    Plane,
    Sphere,
    TriangleMesh,
    Union,
)
from warp_lcp.grid.triangle_mesh import builtin_mesh


def turn(rng, dimension):
    vector = rng.normal(size=3) * ([0, 0, 1] if dimension == 2 else [1, 1, 1])
    return Rotation.from_rotvec(vector).as_matrix()


def random_solid(rng, dimension, parts=True):
    """Return a shape of any kind, or a union: turned, scaled, sometimes inverted."""
    kind = rng.integers(5 if parts else 4)
    if kind == 4:
        return Union(
            parts=tuple(random_solid(rng, dimension, False) for _ in range(rng.integers(1, 4)))
        )
    low = rng.uniform(0.1, 0.7, dimension)
    shift = np.append(rng.uniform(-0.1, 0.1, dimension), [0.0])[:3]
    placement = Placement(
        scale=rng.uniform(0.5, 1.5), rotation=turn(rng, dimension), translation=shift
    )
    common = {"placement": placement, "invert": bool(rng.random() < 0.1)}
    if kind == 0:
        return Box(lower=low, upper=low + rng.uniform(0.05, 0.3, dimension), **common)
    if kind == 1:
        return Sphere(center=low, radius=rng.uniform(0.05, 0.2), **common)
    if kind == 2:
        return Capsule(
            start=low,
            end=low + rng.uniform(0.05, 0.3, dimension),
            radius=rng.uniform(0.03, 0.1),
            **common,
        )
    return Plane(point=low, normal=rng.normal(size=dimension), **common)


def differences(rng, dimension):
    """Return the largest difference of distances [cells], and agreement of owners.

    Owners must agree where no other solid is as near.
    """
    counts = (14, 11) if dimension == 2 else (9, 8, 7)
    grid = grid_of(dimension, counts, 1.0 / counts[0])
    solids = [(number, random_solid(rng, dimension)) for number in range(1, rng.integers(2, 7))]
    table, sampler = ShapeTable(grid, solids, range(len(solids))), NodeSampler(grid)
    rotations = np.array([turn(rng, dimension) for _ in solids])
    translations = rng.uniform(-0.2, 0.2, (len(solids), 3)) * (
        [1, 1, 0] if dimension == 2 else [1, 1, 1]
    )
    fields, boxes = [NodeDistances(grid, second=True) for _ in range(2)], []
    for (number, geometry), rotation, translation in zip(
        solids, rotations, translations, strict=True
    ):
        moved = geometry.moved(Pose(rotation, translation))
        sampler.enter(fields[0], number, moved)
        boxes.append(nodes_near(grid, moved))
    table.place(rotations, translations)
    table.enter(fields[1], sampler.snap)
    for box, low, high in zip(boxes, table.low, table.high, strict=True):
        assert (box is None) == bool((low >= high).any())
        assert box is None or (np.array_equal(box[0], low) and np.array_equal(box[1], high))
    one, other = ([array.numpy() for array in field.arrays] for field in fields)
    clear = one[2] - one[0] > 1e-4
    off = max(np.abs(one[n] - other[n]).max() for n in (0, 2))
    return float(off), bool((one[1] == other[1])[clear].all())


@pytest.mark.parametrize("dimension", [2, 3])
def test_one_launch_enters_what_launches_of_each_solid_do(dimension):
    rng = np.random.default_rng(600 + dimension)
    for _ in range(15):
        off, owners = differences(rng, dimension)
        assert off < 1e-5
        assert owners


def test_tables_hold_no_meshes():
    mesh = TriangleMesh(surface=builtin_mesh("torus"))
    ball = Sphere(center=[0.5, 0.5, 0.5], radius=0.1)
    assert ShapeTable.holds(Union(parts=(ball, Union(parts=(ball,)))))
    assert not ShapeTable.holds(mesh)
    assert not ShapeTable.holds(Union(parts=(ball, mesh)))
