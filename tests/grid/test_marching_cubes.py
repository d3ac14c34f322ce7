"""Marching cubes and squares: closed surfaces, and known volumes of shapes."""

import numpy as np
import pytest
import warp as wp

from mesh_checks import assert_closed, enclosed, pieces
from warp_lcp.grid.marching_cubes import EDGES, MarchingCubes, segment_table, triangle_table
from warp_lcp.grid.staggered import StaggeredGrid

FLAT, DEEP = StaggeredGrid((23, 30, 1), 0.5, 2), StaggeredGrid((13, 9, 16), 0.5, 3)
GRIDS = pytest.mark.parametrize("grid", [FLAT, DEEP], ids=["2d", "3d"])


def centers(grid: StaggeredGrid) -> np.ndarray:
    """Return the stored cells' centers [m], shape (nz, ny, nx, 3); z = 0 in 2-D."""
    k, j, i = np.indices(grid.shape)
    x = (np.stack([i, j, k], axis=-1) - 0.5) * grid.spacing
    x[..., grid.dimension :] = 0.0
    return x


def mesh_of(grid: StaggeredGrid, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points and corners of phi = 0; the ring is air."""
    closed = np.abs(phi) + 1.0
    inner = (slice(1, -1) if grid.dimension == 3 else slice(None), slice(1, -1), slice(1, -1))
    closed[inner] = phi[inner]
    field = wp.array(closed.astype(np.float32), device="cpu")
    mesh = MarchingCubes(grid).contour(field, wp.empty(grid.shape, dtype=wp.int32, device="cpu"))
    return mesh.points.numpy(), mesh.corners.numpy()


@GRIDS
@pytest.mark.parametrize("seed", [3, 17, 291])
def test_noise_has_a_closed_surface(grid, seed):
    """Closed surface of noise.

    Random signs include all 256 cases, with ambiguous ones next to each other.
    """
    phi = np.random.default_rng(seed).standard_normal(grid.shape)
    points, corners = mesh_of(grid, phi)
    assert_closed(corners)
    assert len(np.unique(corners)) == len(points)
    assert len(np.unique(points, axis=0)) == len(points)


@GRIDS
def test_a_ball_has_its_volume_and_faces_outward(grid):
    center, radius = np.array([3.1, 2.3, 3.8 * (grid.dimension - 2)]), 1.5  # away from the sides
    phi = np.linalg.norm(centers(grid) - center, axis=-1) - radius
    points, corners = mesh_of(grid, phi)
    assert_closed(corners)
    volume = np.pi * radius**2 if grid.dimension == 2 else 4.0 / 3.0 * np.pi * radius**3
    assert 0.93 < enclosed(points, corners) / volume < 1.0  # of an inscribed polyhedron
    out = (points - center) / radius
    assert np.abs(np.linalg.norm(out, axis=1) - 1.0).max() < 0.03
    assert pieces(points, corners) == 1
    # Euler characteristic of a sphere; 0 for a loop.
    assert len(points) - len(corners) / 2 == (2 if grid.dimension == 3 else len(points) / 2)


def test_a_plane_is_exact():
    normal = np.array([0.48, 0.6, 0.64])
    phi = centers(DEEP) @ normal - 3.1
    points, _ = mesh_of(DEEP, phi)
    size = np.array(DEEP.counts) * DEEP.spacing
    inside = ((points > 0.3) & (points < size - 0.3)).all(axis=1)
    assert inside.sum() > 50
    assert np.abs(points[inside] @ normal - 3.1).max() < 0.01 * DEEP.spacing


@GRIDS
def test_a_surface_beyond_the_domain_is_cut_at_its_sides(grid):
    """Cut on the sides of a domain full of material.

    However deep the last cells are, the surface lies on the sides.
    """
    points, corners = mesh_of(grid, np.full(grid.shape, -7.0))
    size = np.array(grid.counts) * grid.spacing
    assert_closed(corners)
    x = points[:, : grid.dimension]
    assert (np.isclose(x, 0.0, atol=1e-6) | np.isclose(x, size[: grid.dimension])).sum(
        axis=1
    ).min() == 1
    assert enclosed(points, corners) == pytest.approx(size[: grid.dimension].prod(), rel=1e-4)


def test_a_surface_meets_a_wall_on_the_wall():
    phi = centers(DEEP)[..., 1] - 2.13
    points, corners = mesh_of(DEEP, phi)
    size = np.array(DEEP.counts) * DEEP.spacing
    assert_closed(corners)
    assert enclosed(points, corners) == pytest.approx(size[0] * 2.13 * size[2], rel=1e-4)
    top = points[points[:, 1] > 2.0]
    assert top[:, 1] == pytest.approx(2.13, abs=1e-5)
    assert (top[:, [0, 2]].min(axis=0) == 0.0).all()
    assert top[:, [0, 2]].max(axis=0) == pytest.approx(size[[0, 2]])


def test_a_layer_of_one_cell_is_a_cell_thick():
    grid = StaggeredGrid((6, 5, 1), 0.5, 3)
    points, corners = mesh_of(grid, np.full(grid.shape, -1.0))
    assert_closed(corners)
    # Its edges are cut off where the centers lie.
    assert enclosed(points, corners) > 0.5 * 3.0 * 2.5 * 0.5


@GRIDS
def test_no_surface_is_no_surface(grid):
    points, corners = mesh_of(grid, np.ones(grid.shape))
    assert points.shape == (0, 3)
    assert corners.shape == (0, grid.dimension)


def test_a_value_of_zero_is_air_and_makes_no_triangle_without_area():
    phi = np.ones(DEEP.shape)
    phi[4:8, 3:6, 5:9] = -1.0
    phi[4:8, 3:6, 9] = 0.0
    points, corners = mesh_of(DEEP, phi)
    assert_closed(corners)
    x = points[corners].astype(np.float64)
    assert np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1).min() > 0.0


def test_the_table_uses_the_edges_that_the_surface_cuts():
    for case, row in enumerate(triangle_table()):
        cut = {n for n, (a, b) in enumerate(EDGES) if (case >> a & 1) != (case >> b & 1)}
        assert set(row[1 : 1 + 3 * row[0]].tolist()) == cut
    for case, row in enumerate(segment_table()):
        cut = {n for n, (a, b) in enumerate(EDGES) if b < 4 and (case >> a & 1) != (case >> b & 1)}
        assert set(row[1 : 1 + 2 * row[0]].tolist()) == cut
