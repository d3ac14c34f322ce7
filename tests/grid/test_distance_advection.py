from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_lcp import AIR, SOLID
from warp_lcp.grid.advection import MARGIN, PUSH, advect, advect_with_distance, clearance, push_out
from warp_lcp.grid.staggered import StaggeredGrid

FLAT = StaggeredGrid((24, 20, 1), 0.1, 2)
SPACE = StaggeredGrid((18, 16, 14), 0.1, 3)
# Distances of points, shape (..., 3), both in cells from the domain's corner.
Distance = Callable[[np.ndarray], np.ndarray]


def box(grid: StaggeredGrid, x: np.ndarray) -> np.ndarray:
    """Return the distance to the domain's walls."""
    sides = [np.minimum(x[..., d], grid.counts[d] - x[..., d]) for d in range(grid.dimension)]
    return np.min(sides, axis=0)


def at_nodes(grid: StaggeredGrid, solid: Distance | None = None) -> wp.array:
    k, j, i = np.meshgrid(*(np.arange(n) - 1.0 for n in grid.shape), indexing="ij")
    x = np.stack([i, j, k * (grid.dimension == 3)], axis=-1)
    host = box(grid, x) if solid is None else np.minimum(box(grid, x), solid(x))
    return wp.array(host.astype(np.float32), dtype=wp.float32, device="cpu")


def between_nodes(grid: StaggeredGrid, distance: wp.array, points: np.ndarray) -> np.ndarray:
    """Interpolate the distance at points [m] in float64, by weights."""
    host = distance.numpy().astype(np.float64)
    x = points / grid.spacing + 1.0
    low = np.clip(np.floor(x).astype(int), 1, grid.counts)
    f = x - low
    total = np.zeros(len(x))
    for corner in np.ndindex((2,) * grid.dimension):
        c = np.array([*corner, 0][:3])
        axes = slice(grid.dimension)
        weight = np.where(c[axes], f[:, axes], 1 - f[:, axes]).prod(axis=1)
        node = low + c
        total += weight * host[node[:, 2] if grid.dimension == 3 else 1, node[:, 1], node[:, 0]]
    return total


def plane(point: tuple[float, float, float], normal: tuple[float, float, float]) -> Distance:
    n = np.array(normal) / np.linalg.norm(normal)
    return lambda x: (x - np.array(point)) @ n


def sphere(center: tuple[float, ...], radius: float) -> Distance:
    return lambda x: np.linalg.norm(x - np.array(center), axis=-1) - radius


def plate(x0: float, thickness: float) -> Distance:
    return lambda x: np.abs(x[..., 0] - x0) - thickness / 2


def velocities(grid: StaggeredGrid, velocity: tuple[float, ...]) -> list[wp.array]:
    fields = grid.faces()
    for field, value in zip(fields, velocity, strict=False):
        field.fill_(value)
    return fields


def move(
    grid: StaggeredGrid,
    fields: list[wp.array],
    distance: wp.array,
    dt: float,
    points: npt.ArrayLike,
) -> tuple[np.ndarray, int]:
    position = wp.array(np.asarray(points, dtype=np.float32), dtype=wp.vec3, device="cpu")
    stopped = wp.zeros(1, dtype=wp.int32, device="cpu")
    advect_with_distance(grid, fields, distance, dt, position, stopped)
    return position.numpy().astype(np.float64), int(stopped.numpy()[0])


def open_points(
    grid: StaggeredGrid,
    distance: wp.array,
    count: int,
    rng: np.random.Generator,
    least: float = MARGIN,
) -> np.ndarray:
    """Return points [m] between walls, a third of them as near as allowed."""
    x = rng.uniform(0, 1, (20 * count, 3)) * np.array(grid.counts) * grid.spacing
    x[:, 2] *= grid.dimension == 3
    s = between_nodes(grid, distance, x)
    near = np.argsort(np.where(s > least, s, np.inf))[: count // 3]
    far = np.flatnonzero(s > least)[: count - len(near)]
    return x[np.concatenate([near, far])]


def rotation(grid: StaggeredGrid) -> list[wp.array]:
    _, j, i = np.meshgrid(*(np.arange(n) - 1.0 for n in grid.shape), indexing="ij")
    x, y = (0.5 * n for n in grid.counts[:2])
    fields = grid.faces()
    fields[0].assign((-(j + 0.5 - y) * grid.spacing).astype(np.float32))
    fields[1].assign(((i + 0.5 - x) * grid.spacing).astype(np.float32))
    return fields


@pytest.mark.parametrize("grid", [FLAT, SPACE], ids=["2d", "3d"])
def test_away_from_walls_it_is_the_step_among_whole_cells(grid: StaggeredGrid) -> None:
    rng = np.random.default_rng(77)
    cells = np.full(grid.shape, SOLID, np.int8)
    cells[1:-1, 1:-1, 1:-1] = AIR
    room = clearance(grid, wp.array(cells, dtype=wp.int8, device="cpu"))
    fields = grid.faces()
    for field in fields:
        field.assign(rng.normal(size=grid.shape).astype(np.float32))
    start = (rng.uniform(5, np.maximum(grid.counts, 11) - 5, (500, 3)) * grid.spacing).astype(
        np.float32
    )
    found, stopped = move(grid, fields, at_nodes(grid), 0.8 * grid.spacing, start)
    expected = wp.array(start, dtype=wp.vec3, device="cpu")
    advect(
        grid, fields, room, 0.8 * grid.spacing, expected, wp.zeros(1, dtype=wp.int32, device="cpu")
    )
    assert stopped == 0
    assert np.abs(found - start)[:, 0].max() > grid.spacing
    assert np.abs(found - expected.numpy()).max() < 1e-6


def test_third_order_on_a_rotation() -> None:
    """Third order on a rotation.

    A rigid rotation is linear, so the grid interpolates it exactly; the error is that of the time
    step.
    """
    grid = StaggeredGrid((32, 32, 1), 1.0 / 32, 2)
    angle = np.linspace(0, 6, 40)
    start = np.stack([0.5 + 0.3 * np.cos(angle), 0.5 + 0.3 * np.sin(angle), 0 * angle], axis=1)
    turn = 2.0
    c, s = np.cos(turn), np.sin(turn)
    exact = (start - [0.5, 0.5, 0]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0.5, 0.5, 0]
    errors = []
    for steps in (4, 8):
        points = start
        for _ in range(steps):
            points, stopped = move(grid, rotation(grid), at_nodes(grid), turn / steps, points)
            assert stopped == 0
        errors.append(np.abs(points - exact).max())
    assert errors[0] < 5e-3
    assert 6.5 < errors[0] / errors[1] < 9.5


@pytest.mark.every_case
@pytest.mark.parametrize("cells", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (-0.5, 0.75**0.5, 0.0), (-0.3, 0.8, 0.5)])
def test_a_plane_stops_the_normal_part_and_lets_the_tangential_part_go(
    normal: tuple[float, float, float], cells: float
) -> None:
    """Inclined plane: the normal part stops, the tangential part continues.

    The end is start + way, less the normal part beyond the wall.
    """
    grid = FLAT if normal[2] == 0 else StaggeredGrid((24, 20, 24), 0.1, 3)
    n = np.array(normal) / np.linalg.norm(normal)
    tangent = np.array([n[1], -n[0], 0.0]) / np.hypot(n[0], n[1])
    at = np.array([12.0, 9.0, 12.0 * (grid.dimension == 3)])
    way = cells * (0.6 * tangent - 0.8 * n)
    start = at + np.outer([0.01, 0.1, 0.7], n) - 0.3 * cells * tangent
    points, stopped = move(
        grid,
        velocities(grid, tuple(way)),
        at_nodes(grid, plane(tuple(at), normal)),
        grid.spacing,
        start * grid.spacing,
    )
    end = points / grid.spacing
    height = np.maximum((start + way - at) @ n, MARGIN)
    touching = (start + way - at) @ n < MARGIN
    assert stopped == touching.sum() > 0
    expected = start + 0.6 * cells * tangent
    along = np.stack([tangent, np.cross(n, tangent)])
    assert (end - expected) @ along.T == pytest.approx(np.zeros((3, 2)), abs=2e-4)
    assert (end - at) @ n == pytest.approx(height, abs=2e-4)
    assert ((end - at) @ n)[touching] == pytest.approx(1.1 * MARGIN, abs=2e-5)


@pytest.mark.parametrize("grid", [FLAT, SPACE], ids=["2d", "3d"])
@settings(max_examples=40, deadline=None)
@given(random_seed=st.integers(0, 10**6), cells=st.sampled_from([0.1, 1.0, 3.0, 8.0, 1e5]))
def test_nobody_ends_inside_a_wall(grid: StaggeredGrid, random_seed: int, cells: float) -> None:
    rng = np.random.default_rng(random_seed)
    center = rng.uniform(5, np.maximum(grid.counts, 11) - 5) * [1, 1, grid.dimension == 3]
    kinds = [
        sphere(tuple(center), rng.uniform(1.5, 4)),
        plane(tuple(center), tuple(rng.normal(size=3) * [1, 1, grid.dimension == 3])),
        plate(float(center[0]), 1.2),
    ]
    distance = at_nodes(grid, kinds[random_seed % 3])
    start = open_points(grid, distance, 300, rng, least=1.05 * MARGIN)
    fields = grid.faces()
    for field in fields:
        field.assign((rng.normal() + rng.normal(size=grid.shape)).astype(np.float32))
    points, stopped = move(grid, fields, distance, 0.5 * cells * grid.spacing, start)
    assert stopped > 0
    assert (box(grid, points / grid.spacing) >= 0.99 * MARGIN).all()
    assert (between_nodes(grid, distance, points) >= 0.99 * MARGIN).all()


@pytest.mark.default_cases(8)
@pytest.mark.parametrize("grid", [FLAT, SPACE], ids=["2d", "3d"])
@pytest.mark.parametrize("thickness", [1.2, 2.5])
@pytest.mark.parametrize("x0", [9.37, 9.0, 8.61, 9.5])
@pytest.mark.parametrize("sine", [0.0, 0.4])
def test_a_thin_plate_is_not_tunnelled(
    grid: StaggeredGrid, thickness: float, x0: float, sine: float
) -> None:
    """Thin plate without tunnelling; at CFL 8 a particle would end far beyond."""
    rng = np.random.default_rng(616)
    distance = at_nodes(grid, plate(x0, thickness))
    start = open_points(grid, distance, 500, rng)
    start = start[start[:, 0] < x0 * grid.spacing]
    points, stopped = move(grid, velocities(grid, (8.0, 8.0 * sine)), distance, grid.spacing, start)
    assert stopped > 0.5 * len(start)
    # A node behind the middle measures to the far side.
    assert (points[:, 0] / grid.spacing < x0 - 0.5 * thickness + 0.05).all()
    free = (start[:, 0] / grid.spacing + 8.0 < x0 - thickness) & (
        start[:, 1] / grid.spacing + 8 * sine < grid.counts[1] - 1
    )
    assert points[free, 0] == pytest.approx(start[free, 0] + 0.8, abs=1e-5)


@pytest.mark.parametrize("grid", [FLAT, SPACE], ids=["2d", "3d"])
def test_a_sphere_is_flown_around(grid: StaggeredGrid) -> None:
    """Flow around a sphere.

    A uniform wind blows particles along a sphere to its equator, and away from it there.
    """
    center = np.array([10.0, 9.0, 7.0 * (grid.dimension == 3)])
    distance = at_nodes(grid, sphere(tuple(center), 3.0))
    rows = np.array([0.1, 0.5, 1.5, 2.5, 3.5])
    start = center + np.stack([np.full(5, -4.0), rows, np.zeros(5)], axis=1)
    points, hits = start * grid.spacing, 0
    for _ in range(22):
        points, stopped = move(
            grid, velocities(grid, (1.0, 0.0)), distance, 0.5 * grid.spacing, points
        )
        radius = np.linalg.norm(points / grid.spacing - center, axis=1)
        assert (radius > 2.9).all()  # between nodes a sphere is flatter
        hits += stopped
    end = points / grid.spacing
    assert hits > 20
    assert (end[1:, 0] > center[0] + 1.0).all()
    assert np.linalg.norm((end - center)[1:4, 1:], axis=1) == pytest.approx(3.0, abs=0.1)
    assert end[4] == pytest.approx(start[4] + [11.0, 0.0, 0.0], abs=1e-3)


def test_corners_of_the_domain_hold_particles() -> None:
    """Particles in corners of the domain.

    In the edge between walls the interpolated distance is a product, whose gradient vanishes.
    """
    for grid, way in ((FLAT, (3.0, -2.0)), (SPACE, (3.0, -2.0, 4.0))):
        sign = np.sign([*way, 0.0][:3])
        corner = np.where(sign > 0, grid.counts, 0.0) * [1, 1, grid.dimension == 3]
        rng = np.random.default_rng(9)
        points = (corner - sign * rng.uniform(0.15, 3, (200, 3))) * grid.spacing
        for _ in range(5):
            points, stopped = move(
                grid, velocities(grid, way), at_nodes(grid), grid.spacing, points
            )
        assert stopped == 200
        apart = np.abs(points / grid.spacing - corner)
        assert apart.max() < (0.2 if grid is FLAT else 0.7)
        assert (box(grid, points / grid.spacing) > 0.99 * MARGIN).all()


def test_a_wall_ahead_of_a_floor_does_not_send_particles_up() -> None:
    """Wall ahead of a floor: particles do not rise.

    A particle that slides along the floor into a wall of the domain stops there: the rounded edge
    is no ramp.
    """
    start = np.array([[20.3, 1.2 * MARGIN, 0.0], [21.7, 0.4, 0.0]]) * FLAT.spacing
    points, stopped = move(FLAT, velocities(FLAT, (5.0, -0.5)), at_nodes(FLAT), FLAT.spacing, start)
    assert stopped == 2
    assert (points[:, 0] / FLAT.spacing > 23.5).all()
    assert (points[:, 1] / FLAT.spacing < 0.25).all()


def test_a_ramp_on_the_floor_is_climbed() -> None:
    ramp = plane((12.0, 0.0, 0.0), (-0.5, 0.75**0.5, 0.0))
    points, stopped = move(
        FLAT, velocities(FLAT, (6.0, 0.0)), at_nodes(FLAT, ramp), FLAT.spacing, [[1.1, 0.02, 0.0]]
    )
    assert stopped == 1
    x, y, _ = points[0] / FLAT.spacing
    assert x - 11.0 == pytest.approx(1.0 + 5.0 * 0.75, abs=0.2)  # the ramp keeps cos^2 of the way
    assert y == pytest.approx((x - 12.0) * 3**-0.5, abs=0.01)


def test_a_particle_that_slid_over_a_ledge_continues_along_it() -> None:
    """Slide over a ledge.

    The part of the way that the wall has removed stays removed where the wall ends.
    """

    def ledge(x: np.ndarray) -> np.ndarray:
        out = np.stack([x[..., 0] - 12.0, x[..., 1] - 8.0], axis=-1)
        return np.linalg.norm(np.maximum(out, 0.0), axis=-1) + np.minimum(out.max(axis=-1), 0.0)

    start = np.array([[9.0, 8.3, 0.0]]) * FLAT.spacing
    points, stopped = move(
        FLAT, velocities(FLAT, (6.0, -3.0)), at_nodes(FLAT, ledge), FLAT.spacing, start
    )
    assert stopped == 1
    assert points[0] / FLAT.spacing == pytest.approx([15.0, 8.0 + 1.1 * MARGIN, 0.0], abs=2e-3)


def test_a_wedge_stops_particles() -> None:
    """Wedge between two walls.

    There is no direction to slide: the particle ends in the wedge, in the open.
    """

    def wedge(x: np.ndarray) -> np.ndarray:
        return np.minimum(
            plane((12.0, 5.0, 0.0), (-0.2, 1.0, 0.0))(x),
            plane((12.0, 5.0, 0.0), (-0.2, -1.0, 0.0))(x),
        )

    distance = at_nodes(FLAT, wedge)
    start = np.array([[6.0, 5.1, 0.0], [6.0, 4.5, 0.0], [9.0, 5.3, 0.0]]) * FLAT.spacing
    points, stopped = move(FLAT, velocities(FLAT, (8.0, 0.3)), distance, FLAT.spacing, start)
    assert stopped == 3
    assert (between_nodes(FLAT, distance, points) >= 0.99 * MARGIN).all()
    assert (points[:, 0] / FLAT.spacing < 12.0).all()
    assert (points[:, 0] / FLAT.spacing > 10.0).all()


def test_where_there_is_no_way_out_a_particle_stays() -> None:
    """Field without a gradient inside the wall: the particle stays.

    As of a distance that was cut off.
    """
    host = at_nodes(FLAT).numpy().copy()
    host[1, :, 12:] = -1.0
    host[1, :, 11] = 0.5
    distance = wp.array(host, dtype=wp.float32, device="cpu")
    start = np.array([[1.2, 1.0, 0.0]])
    moved, left = (wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(2))
    position = wp.array(start.astype(np.float32), dtype=wp.vec3, device="cpu")
    push_out(FLAT, distance, position, moved, left)
    assert (int(moved.numpy()[0]), int(left.numpy()[0])) == (0, 1)
    assert position.numpy()[0] == pytest.approx(start[0])
    points, stopped = move(FLAT, velocities(FLAT, (0.0, 1.0)), distance, 0.1 * FLAT.spacing, start)
    assert stopped == 1
    assert points[0] == pytest.approx(start[0])


def test_two_dimensions_ignore_z() -> None:
    points, stopped = move(
        FLAT,
        velocities(FLAT, (0.5, 0.5)),
        at_nodes(FLAT),
        0.1,
        [[0.3, 0.3, 5.0], [0.01, 0.01, -7.0]],
    )
    assert stopped == 0
    assert points == pytest.approx(np.array([[0.35, 0.35, 0.0], [0.06, 0.06, 0.0]]), abs=1e-6)


def test_velocities_that_are_not_finite_do_not_crash() -> None:
    for bad in (np.nan, np.inf, -np.inf, 1e38):
        points, _ = move(
            SPACE, velocities(SPACE, (bad, 0.1, bad)), at_nodes(SPACE), 0.1, [[0.3, 0.3, 0.2]]
        )
        assert points.shape == (1, 3)
        if not np.isfinite(bad):
            assert not np.isfinite(points).all()


@pytest.mark.parametrize("grid", [FLAT, SPACE], ids=["2d", "3d"])
@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (-0.5, 0.75**0.5, 0.0)])
def test_particles_are_pushed_out_along_the_normal(
    grid: StaggeredGrid, normal: tuple[float, float, float]
) -> None:
    """Push-out of particles along the normal.

    Out of a plane the way is known; beyond PUSH cells no particle moves.
    """
    n = np.array(normal)
    at = np.array([9.0, 8.0, 7.0 * (grid.dimension == 3)])
    depths = np.array([-2.0, -MARGIN, 0.0, 0.3, 1.7, 2.8, PUSH + 0.5])
    start = at - np.outer(depths, n)
    position = wp.array((start * grid.spacing).astype(np.float32), dtype=wp.vec3, device="cpu")
    moved, left = (wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(2))
    push_out(grid, at_nodes(grid, plane(tuple(at), normal)), position, moved, left)
    end = position.numpy() / grid.spacing
    # At MARGIN itself rounding decides.
    assert (int(moved.numpy()[0]), int(left.numpy()[0])) in ((4, 1), (5, 1))
    assert end[[0, 6]] == pytest.approx(start[[0, 6]], abs=1e-5)
    assert end[1:6] == pytest.approx(np.broadcast_to(at + 1.1 * MARGIN * n, (5, 3)), abs=1.5e-4)


@settings(max_examples=30, deadline=None)
@given(random_seed=st.integers(0, 10**6))
def test_a_sphere_that_moved_leaves_nobody_inside(random_seed: int) -> None:
    rng = np.random.default_rng(random_seed)
    center = rng.uniform(5.5, np.array(SPACE.counts) - 5.5)
    before = at_nodes(SPACE, sphere(tuple(center), 2.5))
    step = rng.normal(size=3)
    step *= rng.uniform(0, 2) / np.linalg.norm(step)
    after = at_nodes(SPACE, sphere(tuple(center + step), 2.5))
    start = open_points(SPACE, before, 500, rng)
    position = wp.array(start.astype(np.float32), dtype=wp.vec3, device="cpu")
    moved, left = (wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(2))
    push_out(SPACE, after, position, moved, left)
    end = position.numpy().astype(np.float64)
    inside = between_nodes(SPACE, after, start) < MARGIN
    assert int(left.numpy()[0]) == 0
    assert int(moved.numpy()[0]) == pytest.approx(inside.sum(), abs=1)
    assert (between_nodes(SPACE, after, end) >= 0.99 * MARGIN).all()
    away = between_nodes(SPACE, after, start) > 1.01 * MARGIN
    assert end[away] == pytest.approx(start[away], abs=1e-6)
    # Near its middle a sphere's gradient is inexact.
    assert np.linalg.norm(end - start, axis=1).max() < (2.0 + 0.5) * SPACE.spacing
