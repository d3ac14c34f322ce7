"""Thin solids as exact shapes: no leaks, and sliding along their surface."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation as Rotation3

from default_run import few
from warp_lcp.grid import thin_walls_kernels as kernels
from warp_lcp.grid.motion import Rotation, Sinusoid
from warp_lcp.grid.signed_distance import (
    Box,
    Capsule,
    Placement,
    Plane,
    Sphere,
    TriangleMesh,
    Union,
)
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.thin_walls import ThinWalls, fills_cells, is_thin
from warp_lcp.grid.triangle_mesh import close_surface
from warp_lcp.grid.voxelize import PlacedSolid

CELL = 1.0 / 32
LOW, HIGH = 0.3, 0.7  # ends of the inside of a closed box


def grid(dimension):
    return StaggeredGrid((32, 32, 32 if dimension == 3 else 1), CELL, dimension)


def sheet(low, high):
    """Return a closed mesh of a box."""
    low, high = np.asarray(low), np.asarray(high)
    vertices = (
        np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]) * (high - low) + low
    )
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return TriangleMesh(surface=close_surface(vertices, np.array(triangles), "sheet"))


def walls_around(dimension, thickness, kind=Box):
    """Return the walls of a closed box, outside of LOW to HIGH along each axis."""
    shapes = []
    for axis in range(dimension):
        for side in range(2):
            low, high = np.full(dimension, LOW - thickness), np.full(dimension, HIGH + thickness)
            (high if side == 0 else low)[axis] = LOW if side == 0 else HIGH
            if kind is TriangleMesh:
                shapes.append(sheet([*low, -1.0][:3], [*high, 1.0][:3]))
            else:
                shapes.append(Box(lower=tuple(low), upper=tuple(high)))
    return shapes


def thin_walls(g, shapes, motion=None):
    solids = [
        PlacedSolid(geometry=shape, separating=True, name="wall", motion=motion) for shape in shapes
    ]
    return ThinWalls(g, solids, [True] * len(solids), 0)


def flung(walls, points, ways, *, still=True, between=lambda: None):
    """Return the ends of particles that move by some ways, float64, shape (n, 3)."""
    position = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    walls.store_positions(position)
    position.assign((points + ways).astype(np.float32))
    between()
    walls.stop(position, still=still)
    return position.numpy().astype(np.float64)


def distance_of(shape, points):
    """Return the signed distance [m] of points from a shape, shape (n,)."""
    out = wp.empty(len(points), dtype=wp.float32, device="cpu")
    shape.signed_distance(wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu"), out)
    return out.numpy()


def inside_points(dimension, count, rng, margin=2e-3 * CELL):
    points = np.zeros((count, 3))
    points[:, :dimension] = rng.uniform(LOW + margin, HIGH - margin, (count, dimension))
    ways = np.zeros((count, 3))
    ways[:, :dimension] = rng.normal(0.0, 0.3, (count, dimension))
    return points, ways


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("kind", [Box, TriangleMesh])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("thickness", [0.05, 0.5, 1.28])
def test_nothing_leaves_a_closed_box(dimension, thickness, kind):
    rng = np.random.default_rng(7193)
    walls = thin_walls(grid(dimension), walls_around(dimension, thickness * CELL, kind))
    points, ways = inside_points(dimension, 3000, rng)
    ends = flung(walls, points, ways)[:, :dimension]
    assert (ends > LOW).all() and (ends < HIGH).all()
    free = ((points + ways)[:, :dimension] > LOW + CELL).all(axis=1) & (
        (points + ways)[:, :dimension] < HIGH - CELL
    ).all(axis=1)
    # No wall was in their way.
    assert free.sum() > 100 and np.allclose(
        ends[free], (points + ways)[free, :dimension], atol=1e-6
    )


@wp.kernel(enable_backward=False)
def first_hits(
    shapes: kernels.SHAPES,
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    place: wp.array(dtype=wp.float64),
):
    """Find the first place on each path where it meets the first shape, from 0 to 1."""
    i = wp.tid()
    at, _n, _which = kernels.first_hit(shapes, 0, 1, start[i], end[i], -1)
    place[i] = at


def places_of_hits(walls: ThinWalls, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the first place on each path where it meets the first shape, from 0 to 1."""
    place = wp.zeros(len(start), dtype=wp.float64, device="cpu")
    ends = [wp.array(x, dtype=wp.vec3d, device="cpu") for x in (start, end)]
    wp.launch(first_hits, len(start), [walls.shapes, *ends, place], device="cpu")
    return place.numpy()


def drawn_mesh_box(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, ThinWalls]:
    """Return the corners of a random box [m], and its mesh as a thin wall."""
    low = rng.uniform(0.1, 0.3, 3)
    high = low + rng.uniform(0.3, 0.6, 3)
    return low, high, thin_walls(grid(3), [sheet(low, high)])


@pytest.mark.parametrize("seed", range(3))
def test_no_path_slips_through_the_edges_and_corners_of_a_mesh(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 20000
    low, high, walls = drawn_mesh_box(rng)
    # Points on edges and corners: two or three coordinates are those of sides.
    upper, free = rng.random((count, 3)) < 0.5, np.zeros((count, 3), dtype=bool)
    edges = rng.random(count) < 0.7
    free[edges, rng.integers(0, 3, count)[edges]] = True
    on_edge = np.where(free, rng.uniform(low, high, (count, 3)), np.where(upper, high, low))
    start = rng.uniform(low + 0.02 * (high - low), high - 0.02 * (high - low), (count, 3))
    end = 2.0 * on_edge - start
    place = places_of_hits(walls, start, end)
    # All paths leave the box halfway. Vertices are rounded to float32, which shifts the place by
    # about 1e-7 / 0.02.
    np.testing.assert_allclose(place, 0.5, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("seed", range(3))
def test_paths_meet_a_mesh_where_they_meet_its_box(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 5000
    low, high, walls = drawn_mesh_box(rng)
    start, end = rng.uniform(0.0, 1.0, (2, count, 3))
    place = places_of_hits(walls, start, end)
    # Exact slabs: the path is in the box between the last entry and the first exit.
    sides = np.stack([low, high])[:, None] - start
    crossed = np.sort(sides / (end - start), axis=0)
    enter, leave = crossed[0].max(axis=1), crossed[1].min(axis=1)
    first = np.where(enter >= 0.0, enter, leave)
    hits = (enter <= leave) & (first >= 0.0) & (first <= 1.0)
    clear = (np.abs(leave - enter) > 1e-4) & (np.abs(first) > 1e-4) & (np.abs(first - 1.0) > 1e-4)
    assert hits.sum() > count / 4 and clear.sum() > 0.95 * count
    np.testing.assert_array_equal((place <= 1.0)[clear], hits[clear])
    np.testing.assert_allclose(place[clear & hits], first[clear & hits], atol=1e-4)


def leaning_shape(kind, rng):
    """Return a thin shape in any position, which often meets the floor or a side of the domain."""
    turn, place = Rotation3.random(rng=rng).as_matrix(), rng.uniform(0.0, 1.0, 3)
    half = np.array([rng.uniform(0.05, 0.3), rng.uniform(0.05, 0.3), rng.uniform(0.1, 1.2) * CELL])
    if kind is Capsule:
        return Capsule(
            start=tuple(place - turn[0] * 0.2), end=tuple(place + turn[0] * 0.2), radius=half[2]
        )
    shape = (
        sheet(-half, half) if kind is TriangleMesh else Box(lower=tuple(-half), upper=tuple(half))
    )
    if kind is TriangleMesh and rng.random() < 0.7:  # two plates that cross, with folds
        other = sheet(-half[[0, 2, 1]], half[[0, 2, 1]]).surface
        one = shape.surface
        both = (
            np.concatenate(
                [one.vertices, other.vertices + np.array([0.0, 0.0, 3.0 * half[2] + half[1]])]
            ),
            np.concatenate([one.triangles, other.triangles + len(one.vertices)]),
        )
        shape = TriangleMesh(surface=close_surface(*both, "folded"))
    return replace(shape, placement=Placement(rotation=turn, translation=place))


@pytest.mark.parametrize("kind", [Box, Capsule, TriangleMesh])
@pytest.mark.parametrize("seed", few(range(8)))
def test_nothing_enters_between_a_solid_and_a_side_of_the_domain(seed, kind):
    rng = np.random.default_rng([5022, seed])
    shapes = [leaning_shape(kind, rng) for _ in range(3)]
    walls = thin_walls(grid(3), shapes)
    points = rng.uniform(0.002 * CELL, 1.0 - 0.002 * CELL, (6000, 3))
    points = points[walls.admits(points)]
    for _step in range(6):
        # Towards the nearest solid and the nearest side, where wedges are.
        ways = rng.normal(0.0, 0.5 * CELL, points.shape) + 0.3 * CELL * np.sign(points - 0.5)
        aims = np.clip(points + ways, 0.001 * CELL, 1.0 - 0.001 * CELL)
        points = flung(walls, points, aims - points)
        assert (points > 0.0).all() and (points < 1.0).all()
        for shape in shapes:
            assert (distance_of(shape, points) > -1e-6 * CELL).all()


@pytest.mark.parametrize(
    "motion", [Sinusoid(period=0.4, amplitude=(0.2, 0.05)), Rotation(rate=700.0, center=(0.5, 0.5))]
)
@pytest.mark.parametrize("dimension", [2, 3])
def test_nothing_leaves_a_closed_box_that_moves(dimension, motion):
    rng = np.random.default_rng(418)
    walls = thin_walls(grid(dimension), walls_around(dimension, 0.3 * CELL), motion)
    points, ways = inside_points(dimension, 2000, rng)
    for step in range(1, 9):  # of up to 5 cells; particles do not follow by themselves
        points = flung(
            walls, points, 0.1 * ways, still=False, between=lambda at=step: walls.place(0.05 * at)
        )
        pose = motion.pose(0.05 * step)
        own = ((points - pose.translation) @ pose.rotation)[:, :dimension]
        assert (own > LOW).all() and (own < HIGH).all()


@pytest.mark.parametrize(
    "shape",
    [
        Box(lower=(0.2, 0.5), upper=(0.8, 0.505)),
        Sphere(center=(0.5, 0.5), radius=0.02),
        Capsule(start=(0.3, 0.4), end=(0.7, 0.6), radius=0.01),
    ],
)
def test_particles_slide_along_the_true_surface(shape):
    """Sliding along the true surface.

    A particle that meets a surface keeps the part of its way along it, at a thousandth of a cell
    from it.
    """
    rng = np.random.default_rng(52)
    walls = thin_walls(grid(2), [shape])
    points = np.zeros((4000, 3))
    points[:, :2] = rng.uniform(0.25, 0.75, (4000, 2))
    points = points[walls.admits(points)]
    ways = np.zeros_like(points)
    ways[:, :2] = rng.normal(0.0, 0.1, (len(points), 2))
    ends = flung(walls, points, ways)
    distance = wp.zeros(len(ends), dtype=wp.float32, device="cpu")
    shape.signed_distance(wp.array(ends.astype(np.float32), dtype=wp.vec3, device="cpu"), distance)
    assert distance.numpy().min() > 0.9e-3 * CELL
    stopped = np.abs(ends - points - ways).max(axis=1) > 1e-5
    assert 20 < stopped.sum() < len(ends) // 2
    assert (
        np.linalg.norm(ends - points, axis=1) <= np.linalg.norm(ways, axis=1) + 3e-3 * CELL
    ).all()
    if isinstance(shape, Box):
        above = (
            stopped
            & (points[:, 1] > 0.51)
            & (np.abs(points[:, 0] - 0.5) < 0.2)
            & (np.abs((points + ways)[:, 0] - 0.5) < 0.2)
        )
        assert above.any() and np.allclose(ends[above, 0], (points + ways)[above, 0], atol=1e-6)


def test_a_moving_wall_carries_particles_that_it_hits():
    walls = thin_walls(
        grid(2),
        [Box(lower=(0.2, 0.0), upper=(0.202, 1.0))],
        Sinusoid(period=4.0, amplitude=(0.4, 0.0)),
    )
    points = np.array([[0.25, 0.4, 0.0], [0.19, 0.4, 0.0]])
    ends = flung(walls, points, np.zeros((2, 3)), still=False, between=lambda: walls.place(0.5))
    at = 0.4 * np.sin(np.pi / 4)
    assert ends[0, 0] > 0.202 + at and ends[0, 0] < 0.202 + at + 2e-3 * CELL
    assert np.allclose(ends[1], points[1], atol=1e-6)


def test_particles_that_start_inside_are_moved_outside():
    walls = thin_walls(grid(2), [Box(lower=(0.2, 0.5), upper=(0.8, 0.51))])
    ends = flung(walls, np.array([[0.5, 0.508, 0.0], [0.5, 0.502, 0.0]]), np.zeros((2, 3)))
    assert ends[0, 1] > 0.51 and ends[1, 1] < 0.5


def test_points_near_thin_walls_are_not_admitted():
    shapes = [Box(lower=(0.2, 0.5), upper=(0.8, 0.51)), sheet([0.2, 0.7, -1.0], [0.8, 0.71, 1.0])]
    walls = thin_walls(grid(2), shapes)
    points = np.array(
        [
            [0.5, y, 0.0]
            for y in (0.505, 0.51 + 0.5e-3 * CELL, 0.51 + 2e-3 * CELL, 0.705, 0.71 + 2e-3 * CELL)
        ]
    )
    assert walls.admits(points).tolist() == [False, False, True, False, True]


def test_thin_solids_are_recognized():
    device = wp.get_device("cpu")
    thin = Box(lower=(0.0, 0.0), upper=(1.0, 0.04))
    assert is_thin(thin, 0.05, device) and not is_thin(thin, 0.04, device)
    assert is_thin(Capsule(start=(0, 0), end=(1, 0), radius=0.02), 0.05, device) and not is_thin(
        Sphere(center=(0, 0), radius=1), 0.05, device
    )
    assert not is_thin(Plane(point=(0, 0), normal=(0, 1)), 1.0, device)
    assert not is_thin(Sphere(center=(0, 0), radius=0.01, invert=True), 0.05, device)
    assert is_thin(Union(parts=(Sphere(center=(0, 0), radius=1), thin)), 0.05, device)
    assert is_thin(sheet([0, 0, 0], [1, 1, 0.04]), 0.05, device) and not is_thin(
        sheet([0, 0, 0], [1, 1, 1]), 0.05, device
    )
    assert fills_cells(Box(lower=(0.0, 2 * CELL), upper=(1.0, 3 * CELL)), grid(2), 1e-2)
    assert not fills_cells(thin, grid(2), 1e-2)


def relative_speed(motion, x, v, time, dt, bounds, reach):
    """Return the largest speed of points relative to a solid within `reach` of a box around it."""
    before, after = motion.pose(time), motion.pose(time + dt)
    most = 0.0
    corners = np.array(np.meshgrid(*np.asarray(bounds).T)).reshape(3, -1).T
    placed = corners @ before.rotation.T + before.translation
    low, high = placed.min(axis=0) - reach, placed.max(axis=0) + reach
    for point, speed in zip(x, v, strict=True):
        if (point >= low).all() and (point <= high).all():
            own = before.rotation.T @ (point - before.translation)
            moved = after.rotation @ own + after.translation
            most = max(most, float(np.linalg.norm(speed - (moved - point) / dt)))
    return most


@pytest.mark.parametrize("seed", range(4))
def test_material_goes_at_most_a_cell_in_the_frame_of_moving_solids(seed: int) -> None:
    """A step is halved, or shortened in proportion, until it fits; step by step in NumPy."""
    rng = np.random.default_rng(seed)
    g = grid(3)
    shape = Box(lower=(0.3, 0.4, 0.45), upper=(0.7, 0.41, 0.55))
    motion = (
        Sinusoid(period=0.1, amplitude=(0.1, 0.05, 0.0), center=(0.5, 0.5, 0.5), angle=20.0)
        if seed % 2
        else Rotation(rate=2000.0, center=(0.5, 0.4, 0.5), axis=(0.0, 0.0, 1.0))
    )
    walls, time, longest, reach = thin_walls(g, [shape], motion), 0.013, 0.02, 3.0 * CELL
    walls.place(time)
    x, v = rng.uniform(0.2, 0.8, (200, 3)), rng.normal(0.0, 3.0, (200, 3))
    x, v = x.astype(np.float32), v.astype(np.float32)
    position, velocity = (wp.array(a, dtype=wp.vec3, device="cpu") for a in (x, v))
    skin = 1e-4 * CELL
    bounds = shape.bounds() + np.array([[-skin], [skin]])
    dt = longest
    while True:
        way = dt * relative_speed(motion, x.astype(float), v.astype(float), time, dt, bounds, reach)
        if way <= CELL * 1.001:
            break
        dt *= max(CELL / way, 0.5)
    assert dt < 0.5 * longest
    step = walls.longest_step(position, velocity, time, longest, reach)
    assert step == pytest.approx(dt, rel=1e-9)
    # No limit where the step is short enough, where nothing is near, and where nothing moves.
    assert walls.longest_step(position, velocity, time, 0.5 * step, reach) == np.inf
    far = wp.array(np.full((2, 3), 0.95, dtype=np.float32), dtype=wp.vec3, device="cpu")
    assert walls.longest_step(far, velocity[:2], time, longest, 0.0) == np.inf
    assert walls.longest_step(position[:0], velocity[:0], time, longest, reach) == np.inf


def test_material_that_moves_with_the_solids_does_not_shorten_the_step() -> None:
    motion = Rotation(rate=2000.0, center=(0.5, 0.5), axis=(0.0, 0.0, 1.0))
    walls = thin_walls(grid(2), [Box(lower=(0.3, 0.4), upper=(0.7, 0.41))], motion)
    rng = np.random.default_rng(5)
    x = np.zeros((50, 3), dtype=np.float32)
    x[:, :2] = rng.uniform(0.3, 0.7, (50, 2))
    dt = 0.01
    pose, later = motion.pose(0.0), motion.pose(dt)
    moved = (x - pose.translation) @ pose.rotation @ later.rotation.T + later.translation
    v = ((moved - x) / dt).astype(np.float32)
    position, velocity = (wp.array(a, dtype=wp.vec3, device="cpu") for a in (x, v))
    assert walls.longest_step(position, velocity, 0.0, dt, CELL) == np.inf
    velocity.assign(np.zeros_like(v))
    assert walls.longest_step(position, velocity, 0.0, dt, CELL) < 0.5 * dt
