"""Surface around particles against shapes of known volume and place.

The scenes have walls, solids, drops and sheets.
"""

import itertools

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

from mesh_checks import assert_closed, enclosed, pieces
from warp_lcp.grid.level_set import LevelSet
from warp_lcp.grid.particle_seeding import lattice
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.surface_mesh import (
    FilledInterior,
    SurfaceMesh,
    SurfaceObstacles,
    faces_from_particles,
    sample,
)

AIR, SOLID = 0, 2
DX = 0.05
FLAT, DEEP = StaggeredGrid((32, 36, 1), DX, 2), StaggeredGrid((28, 32, 30), DX, 3)
GRIDS = pytest.mark.parametrize("grid", [FLAT, DEEP], ids=["2d", "3d"])
SEED = 8812


def fill(grid, inside, *, per_axis=2, jitter=0.25):
    """Return particles on a jittered lattice where `inside` of points [cells] holds."""
    planes = [
        lattice(grid, per_axis, jitter, SEED, plane) / grid.spacing
        for plane in range(grid.counts[2])
    ]
    x = np.concatenate([points[inside(points)] for points in planes])
    return x * grid.spacing


def on_device(x):
    return wp.array(x.astype(np.float32), dtype=wp.vec3, device="cpu")


def surface_of(grid, x, interior=None, **settings):
    """Return points [cells] and corners of the closed surface of particles [m]."""
    mesh = SurfaceMesh(grid, **({"per_axis": 2} | settings)).find(on_device(x), interior)
    points, corners = mesh.points.numpy() / grid.spacing, mesh.corners.numpy()
    assert_closed(corners)
    return points, corners


def base_of(grid):
    base = np.full(grid.shape, SOLID, np.int8)
    base[1:-1, 1:-1, 1:-1] = AIR
    return base


def node_distances(grid, distance):
    """Return a distance [cells] at the cells' low corners."""
    k, j, i = np.indices(grid.shape)
    x = np.stack([i, j, k], axis=-1) - 1.0
    return wp.array(distance(x).astype(np.float32), device="cpu")


@GRIDS
def test_a_ball_has_its_volume(grid):
    center, radius = np.array([15.3, 16.4, 15.2 * (grid.dimension - 2)]), 11.0
    x = fill(grid, lambda p: np.linalg.norm(p - center, axis=1) < radius, jitter=0.0)
    points, corners = surface_of(grid, x)
    volume = np.pi * radius**2 if grid.dimension == 2 else 4.0 / 3.0 * np.pi * radius**3
    assert enclosed(points, corners) == pytest.approx(volume, rel=0.01)
    assert np.linalg.norm(points - center, axis=1) == pytest.approx(radius, abs=0.2)
    level_set = LevelSet(grid, particles_a_cell=2**grid.dimension)
    base = wp.array(base_of(grid), device="cpu")
    particles = Particles(grid, x, np.zeros_like(x), affine=False)
    particles.sort()
    level_set.update(particles, grid.everywhere, None, base)
    measured = level_set.volume(None, grid.everywhere) / grid.cell_volume
    assert enclosed(points, corners) == pytest.approx(measured, rel=0.01)


@GRIDS
@pytest.mark.parametrize("radius", [3.0, 4.0, 5.0, 8.0])
@pytest.mark.parametrize("settings", [{}, {"smoothing": 2.0}, {"smoothing": 0.8}])
def test_small_balls_keep_their_volume(grid, radius, settings):
    """Smoothing of variance V moves the surface of a ball in by V / R, which is restored."""
    center = np.array([14.3, 15.6, 14.8 * (grid.dimension - 2)])
    x = fill(grid, lambda p: np.linalg.norm(p - center, axis=1) < radius)
    points, corners = surface_of(grid, x, **settings)
    assert pieces(points, corners) == 1
    assert enclosed(points, corners) == pytest.approx(len(x) / 2.0**grid.dimension, rel=0.015)


@pytest.mark.parametrize("base", [0.0, 6.3])
def test_a_drop_on_a_wall_keeps_its_volume(base):
    """Half a ball of 5 cells on the domain's floor, and on a solid that cuts cells."""
    center = np.array([14.2, base, 15.1])
    x = fill(DEEP, lambda p: (np.linalg.norm(p - center, axis=1) < 5.0) & (p[:, 1] > base))
    obstacles = None
    if base:
        floor = node_distances(DEEP, lambda p: p[..., 1] - base)
        obstacles = SurfaceObstacles(wp.array(base_of(DEEP), device="cpu"), floor, False)
    mesh = SurfaceMesh(DEEP, per_axis=2, obstacles=obstacles).find(on_device(x))
    points, corners = mesh.points.numpy() / DX, mesh.corners.numpy()
    assert_closed(corners)
    assert pieces(points, corners) == 1
    assert enclosed(points, corners) == pytest.approx(2.0 / 3.0 * np.pi * 5.0**3, rel=0.03)


@GRIDS
@pytest.mark.parametrize("smoothing", [0.8, 1.5, 2.0])
def test_a_pool_is_flat_and_its_walls_too(grid, smoothing):
    x = fill(grid, lambda p: p[:, 1] < 14.0)
    points, corners = surface_of(grid, x, smoothing=smoothing)
    axes, size = range(grid.dimension), np.array(grid.counts)
    walls = np.min([np.minimum(points[:, a], size[a] - points[:, a]) for a in axes], axis=0) < 1e-4
    top = points[~walls & (points[:, 1] > 10.0), 1]
    assert len(top) >= 50
    assert top.mean() == pytest.approx(14.0, abs=0.015)
    assert top.std() < 0.02
    assert np.abs(top - 14.0).max() < 0.12  # the last row of points before a wall leans to it
    assert walls.sum() + len(top) == len(points)
    assert enclosed(points, corners) == pytest.approx(
        14.0 * size[[0, 2][: grid.dimension - 1]].prod(), rel=2e-3
    )
    assert points[:, : grid.dimension].min() == 0.0
    assert (points <= size + 1e-4).all()


@pytest.mark.parametrize("corner", list(itertools.product([0, 1], repeat=3)))
def test_a_box_in_a_corner_touches_its_walls(corner):
    size, extent, low = np.array(DEEP.counts), np.array([12.0, 11.0, 13.0]), np.zeros(3)
    low = np.where(corner, size - extent, 0.0)
    x = fill(DEEP, lambda p: ((p >= low) & (p < low + extent)).all(axis=1), jitter=0.0)
    points, corners = surface_of(DEEP, x)
    assert enclosed(points, corners) == pytest.approx(extent.prod(), rel=0.01)
    for axis in range(3):
        wall = size[axis] * corner[axis]
        side = points[np.abs(points[:, axis] - wall) < 1e-4]
        across = np.delete(side, axis, axis=1)
        span = across.max(axis=0) - across.min(axis=0)
        # Up to the free edges, which are round.
        assert span == pytest.approx(np.delete(extent, axis), abs=0.3)


@GRIDS
@pytest.mark.parametrize("per_axis", [1, 2, 3])
def test_a_single_particle_is_a_drop_at_any_position(grid, per_axis):
    rng = np.random.default_rng(SEED)
    ranges = [range(3, n - 3, 5) if n > 1 else [0] for n in grid.counts]
    x = np.array(list(itertools.product(*ranges))) + rng.random(
        (np.prod([len(r) for r in ranges]), 3)
    )
    x[:, grid.dimension :] = 0.0
    points, corners = surface_of(grid, x * grid.spacing, per_axis=per_axis)
    assert pieces(points, corners) == len(x)
    assert enclosed(points, corners) == pytest.approx(len(x) / per_axis**grid.dimension, rel=0.4)
    nearest = np.linalg.norm(points[:, None] - x[None], axis=2).min(axis=1)
    assert nearest.max() < 1.3 / per_axis


@pytest.mark.parametrize("smoothing", [1.2, 1.5])
def test_a_sheet_of_one_layer_has_no_holes(smoothing):
    rng = np.random.default_rng(SEED)
    a, b = np.meshgrid(np.arange(8, 48) / 2.0, np.arange(8, 48) / 2.0)
    x = np.stack([a.ravel(), np.full(a.size, 15.2), b.ravel()], axis=1) + 0.12 * (
        rng.random((a.size, 3)) - 0.5
    )
    points, corners = surface_of(DEEP, x * DX, smoothing=smoothing)
    assert pieces(points, corners) == 1
    # Euler characteristic of a sphere; each hole would take 2
    assert len(points) - len(corners) / 2 == 2
    assert enclosed(points, corners) == pytest.approx(len(x) / 8.0, rel=0.35)


@pytest.mark.parametrize("layers", [1, 2])
def test_an_uneven_sheet_keeps_its_volume_and_has_no_holes(layers):
    """Sheet of one or two layers whose particles lie up to a quarter of their distance astray."""
    rng = np.random.default_rng(SEED + layers)
    side = 0.5 * np.arange(8, 48)
    x = np.stack(np.meshgrid(side, 15.2 + 0.5 * np.arange(layers), side), axis=-1).reshape(-1, 3)
    x += 0.25 * (rng.random(x.shape) - 0.5)
    points, corners = surface_of(DEEP, x * DX)
    assert pieces(points, corners) == 1
    assert len(points) - len(corners) / 2 == 2
    assert enclosed(points, corners) == pytest.approx(len(x) / 8.0, rel=0.2)


def test_beads_and_flicker_of_irregular_particles_are_small():
    """Ball of particles at random places in cells, moved by parts of a cell.

    The radius has the noise of the particles. A move changes a fraction of it: beads do not
    depend on where the lattice is.
    """
    center, radius = np.array([14.1, 15.3, 14.6]), 9.0
    x = fill(DEEP, lambda p: np.linalg.norm(p - center, axis=1) < radius, jitter=0.5)
    first = None
    for move in np.outer(range(3), (0.37, 0.11, 0.21)):
        points, _ = surface_of(DEEP, x + move * DX)
        points -= move
        radii = np.linalg.norm(points - center, axis=1)
        assert radii.std() < 0.06
        assert radii.mean() == pytest.approx(radius, abs=0.08)
        if first is None:
            first = points
            continue
        nearest = cKDTree(points).query(first)[1]
        change = np.linalg.norm(first - center, axis=1) - radii[nearest]
        assert np.sqrt((change**2).mean()) < 0.015


def cylinder(x):
    """Return the distance [cells] to an upright cylinder, a disk in 2-D.

    No size is a multiple of a cell.
    """
    return np.hypot(x[..., 0] - 14.3, x[..., 2] - 14.7) - 6.2


@pytest.mark.parametrize("moves", [False, True])
def test_a_pool_ends_at_a_solid_that_cuts_cells(moves):
    """Pool at a solid that cuts cells.

    Since it meets the cylinder at a right angle, its height is the same there.
    """
    x = fill(DEEP, lambda p: (p[:, 1] < 14.0) & (cylinder(p) > 0.0))
    far = wp.full(DEEP.shape, 10.0, dtype=wp.float32, device="cpu")
    distance = far if moves else node_distances(DEEP, cylinder)
    obstacles = SurfaceObstacles(wp.array(base_of(DEEP), device="cpu"), distance, moves)
    mesher = SurfaceMesh(DEEP, per_axis=2, obstacles=obstacles)
    if moves:
        mesher.find(on_device(x))
        wp.copy(distance, node_distances(DEEP, cylinder))
    mesh = mesher.find(on_device(x))
    points, corners = mesh.points.numpy() / DX, mesh.corners.numpy()
    assert_closed(corners)
    area = 28.0 * 30.0 - np.pi * 6.2**2
    assert enclosed(points, corners) == pytest.approx(14.0 * area, rel=0.005)
    gap = cylinder(points)
    assert gap.min() > -0.06
    on_it = (gap < 0.06) & (points[:, 1] > 1.0) & (points[:, 1] < 13.0)
    around = (gap < 1.0) & (points[:, 1] > 1.0) & (points[:, 1] < 13.0)
    assert on_it.sum() == around.sum() > 500
    top = points[(gap > 0.6) & (gap < 2.0) & (points[:, 1] > 8.0), 1]
    assert np.abs(top - 14.0).max() < 0.1


def test_a_pool_ends_at_whole_solid_cells():
    base = base_of(FLAT)
    base[1, 1:11, 9:17] = SOLID  # cells (8..15, 0..9)
    x = fill(FLAT, lambda p: (p[:, 1] < 20.0) & ~((p[:, 0] >= 8) & (p[:, 0] < 16) & (p[:, 1] < 10)))
    points, corners = surface_of(
        FLAT, x, obstacles=SurfaceObstacles(wp.array(base, device="cpu"), None, False)
    )
    assert enclosed(points, corners) == pytest.approx(32.0 * 20.0 - 80.0, rel=0.003)
    beside = points[
        (points[:, 0] > 6.0) & (points[:, 0] < 12.0) & (points[:, 1] > 1.0) & (points[:, 1] < 9.0)
    ]
    assert beside[:, 0] == pytest.approx(8.0, abs=1e-4)


def test_a_solid_in_air_changes_nothing():
    x = fill(FLAT, lambda p: p[:, 1] < 8.0)
    high = node_distances(FLAT, lambda p: np.hypot(p[..., 0] - 16.0, p[..., 1] - 25.0) - 4.0)
    with_it = surface_of(
        FLAT, x, obstacles=SurfaceObstacles(wp.array(base_of(FLAT), device="cpu"), high, False)
    )
    without = surface_of(FLAT, x)
    assert with_it[0] == pytest.approx(without[0], abs=2e-4)
    assert np.array_equal(with_it[1], without[1])


def test_an_interior_without_particles_is_full():
    def deep(p):
        return 14.0 - p[:, 1]

    whole = fill(DEEP, lambda p: deep(p) > 0.0)
    band = fill(DEEP, lambda p: (deep(p) > 0.0) & (deep(p) < 4.0))
    depth = wp.array((14.5 - np.indices(DEEP.shape)[1]).clip(0.0).astype(np.float32), device="cpu")
    found = surface_of(
        DEEP, band, FilledInterior(depth, 2.0, wp.array(base_of(DEEP), device="cpu"))
    )
    expected = surface_of(DEEP, whole)
    assert enclosed(*found) == pytest.approx(enclosed(*expected), rel=1e-3)
    assert pieces(*found) == 1
    assert pieces(*surface_of(DEEP, band)) == 1
    assert enclosed(*surface_of(DEEP, band)) < 0.4 * enclosed(*expected)


@GRIDS
def test_resolution_refines_and_coarsens(grid):
    x = fill(grid, lambda p: ((p > 6.0) & (p < 18.0))[:, : grid.dimension].all(axis=1), jitter=0.0)
    counts = []
    for resolution, accuracy in ((1, 0.06), (2, 0.02), (4, 0.02)):
        points, corners = surface_of(grid, x, resolution=resolution)
        assert enclosed(points, corners) == pytest.approx(12.0**grid.dimension, rel=accuracy)
        counts.append(len(corners))
    assert [b / a for a, b in itertools.pairwise(counts)] == pytest.approx(
        [2.0 ** (grid.dimension - 1)] * 2, rel=0.15
    )


def test_no_particles_have_no_surface():
    points, corners = surface_of(DEEP, np.zeros((0, 3)))
    assert points.shape == (0, 3)
    assert corners.shape == (0, 3)


def test_the_same_particles_have_the_same_surface_again():
    x = on_device(fill(DEEP, lambda p: np.linalg.norm(p - 14.0, axis=1) < 9.0))
    mesher = SurfaceMesh(DEEP, per_axis=2)
    first = mesher.find(x)
    mesher.find(on_device(np.full((1, 3), 20.0 * DX)))
    again = mesher.find(x)
    assert np.array_equal(first.points.numpy(), again.points.numpy())
    assert np.array_equal(first.corners.numpy(), again.corners.numpy())


@GRIDS
def test_points_move_with_the_particles_around_them(grid):
    """Velocity of surface points by the particles around them.

    A turning flow with a gradient: the velocity at the surface is that of the flow there.
    """
    x = fill(grid, lambda p: np.linalg.norm((p - 14.0)[:, : grid.dimension], axis=1) < 8.0)

    def flow(at):
        v = np.stack([1.0 - 2.0 * at[:, 1], 2.0 * at[:, 0], 0.5 * at[:, 2]], axis=1)
        v[:, grid.dimension :] = 0.0
        return v

    mesh = SurfaceMesh(grid, per_axis=2).find(on_device(x))
    fields, weights = grid.faces(), grid.faces()
    faces_from_particles(grid, on_device(x), on_device(flow(x)), fields, weights)
    found = sample(grid, fields, mesh.points).numpy()
    error = np.linalg.norm(found - flow(mesh.points.numpy().astype(np.float64)), axis=1)
    assert error.max() < 2.0 * DX  # of a gradient of 2 / s, less than a cell away
    assert np.sqrt((error**2).mean()) < DX


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"per_axis": 0}, "per_axis"),
        ({"resolution": 0}, "resolution"),
        ({"smoothing": 0.4}, "smoothing"),
    ],
)
def test_wrong_arguments_are_named(settings, named):
    with pytest.raises(ValueError, match=named):
        SurfaceMesh(FLAT, **({"per_axis": 2} | settings))
