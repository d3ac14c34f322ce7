"""Smoothing of closed surfaces, with constant volume and fixed walls."""

import numpy as np
import pytest
import warp as wp

from mesh_checks import assert_closed, enclosed
from warp_lcp.grid.marching_cubes import DeviceMesh, MarchingCubes
from warp_lcp.grid.mesh_smoothing import MOST, smooth
from warp_lcp.grid.staggered import StaggeredGrid

GRID = StaggeredGrid((40, 44, 42), 0.1, 3)
FLAT = StaggeredGrid((40, 44, 1), 0.1, 2)


def rough_ball(grid, center, radius, roughness):
    """Return the contour of a distance [cells] with noise from node to node."""
    k, j, i = np.indices(grid.shape)
    x = np.stack([i, j, k], axis=-1) - 0.5
    axes = slice(grid.dimension)
    phi = np.linalg.norm((x - center)[..., axes], axis=-1) - radius
    phi += roughness * np.random.default_rng(4177).uniform(-1.0, 1.0, phi.shape)
    ring = np.ones(grid.shape, dtype=bool)
    ring[1 : -1 if grid.dimension == 3 else 2, 1:-1, 1:-1] = False
    field = wp.array(np.where(ring, 1.0, phi).astype(np.float32), device="cpu")
    return MarchingCubes(grid).contour(field, wp.empty(grid.shape, dtype=wp.int32, device="cpu"))


@pytest.mark.parametrize("grid", [GRID, FLAT], ids=["3d", "2d"])
def test_noise_goes_and_volume_stays(grid):
    center, radius = np.array([20.2, 21.4, 20.7]), 15.0
    mesh = rough_ball(grid, center, radius, 0.2)
    before, corners = mesh.points.numpy().copy() / grid.spacing, mesh.corners.numpy().copy()
    smooth(mesh, grid, None, 3)
    after = mesh.points.numpy() / grid.spacing
    assert np.array_equal(mesh.corners.numpy(), corners)
    assert enclosed(after, corners) == pytest.approx(enclosed(before, corners), rel=1.5e-3)
    axes = slice(grid.dimension)
    rough = [
        (np.linalg.norm((x - center)[:, axes], axis=1) - radius).std() for x in (before, after)
    ]
    assert rough[1] < 0.8 * rough[0]
    assert np.linalg.norm(after - before, axis=1).max() < MOST + 1e-4


def test_walls_and_solids_hold_their_points():
    mesh = rough_ball(GRID, np.array([4.0, 21.0, 21.0]), 15.0, 0.2)
    j = np.indices(GRID.shape)[1]
    room = wp.array((24.0 - (j - 0.5)).astype(np.float32), device="cpu")  # a solid above y = 24
    before = mesh.points.numpy().copy()
    smooth(mesh, GRID, room, 2)
    after = mesh.points.numpy()
    stayed = (before == after).all(axis=1)
    on_wall, on_solid = before[:, 0] == 0.0, before[:, 1] / GRID.spacing > 23.76
    assert on_wall.sum() > 300
    assert stayed[on_wall].all()
    assert stayed[on_solid].all()
    assert stayed[~on_wall & ~on_solid].mean() < 0.01


def test_a_drop_of_six_points_stays_a_drop():
    phi = np.full(GRID.shape, 0.6, dtype=np.float32)
    phi[20, 21, 22] = -0.4
    mesh = MarchingCubes(GRID).contour(
        wp.array(phi, device="cpu"), wp.empty(GRID.shape, dtype=wp.int32, device="cpu")
    )
    before = enclosed(mesh.points.numpy(), mesh.corners.numpy())
    smooth(mesh, GRID, None, 3)
    assert_closed(mesh.corners.numpy())
    assert 0.05 * before < enclosed(mesh.points.numpy(), mesh.corners.numpy()) < 4.0 * before


def test_an_empty_mesh_stays_empty():
    empty = DeviceMesh(
        wp.empty(0, dtype=wp.vec3, device="cpu"), wp.empty((0, 3), dtype=wp.int32, device="cpu")
    )
    smooth(empty, GRID, None, 3)
    assert len(empty.points) == 0
