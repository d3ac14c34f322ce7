import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from grid_fields import uniform_velocity
from warp_lcp import AIR, FLUID, SOLID
from warp_lcp.grid.advection import MAX_CLEARANCE, advect, clearance
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid

FLAT = StaggeredGrid((8, 6, 1), 0.1, 2)
SPACE = StaggeredGrid((8, 6, 5), 0.1, 3)


def cells_of(grid: StaggeredGrid, solid: np.ndarray | None = None) -> wp.array:
    """Return cell types with a SOLID ring; `solid` is bool (nz, ny, nx)."""
    host = np.full(grid.shape, SOLID, np.int8)
    host[1:-1, 1:-1, 1:-1] = AIR if solid is None else np.where(solid, SOLID, FLUID)
    return wp.array(host, dtype=wp.int8, device="cpu")


def move(
    grid: StaggeredGrid, fields: list[wp.array], cells: wp.array, dt: float, points: np.ndarray
) -> tuple[np.ndarray, int]:
    position = wp.array(np.asarray(points, dtype=np.float32), dtype=wp.vec3, device="cpu")
    stopped = wp.zeros(1, dtype=wp.int32, device="cpu")
    advect(grid, fields, clearance(grid, cells), dt, position, stopped)
    return position.numpy(), int(stopped.numpy()[0])


def test_third_order_on_a_rotating_blob() -> None:
    """Third order on a rotating blob.

    A rigid rotation is linear, so the grid interpolates it exactly; the error is that of the time
    step.
    """
    grid = StaggeredGrid((32, 32, 1), 1.0 / 32, 2)
    j, i = np.meshgrid(np.arange(34), np.arange(34), indexing="ij")
    fields = grid.faces()
    fields[0].assign(np.broadcast_to(-((j - 0.5) / 32 - 0.5), grid.shape).astype(np.float32))
    fields[1].assign(np.broadcast_to((i - 0.5) / 32 - 0.5, grid.shape).astype(np.float32))
    angle = np.linspace(0, 6, 40)
    start = np.stack([0.5 + 0.3 * np.cos(angle), 0.5 + 0.3 * np.sin(angle), 0 * angle], axis=1)
    turn = 2.0
    c, s = np.cos(turn), np.sin(turn)
    exact = (start - [0.5, 0.5, 0]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0.5, 0.5, 0]
    errors = []
    for steps in (4, 8):
        points = start
        for _ in range(steps):
            points, stopped = move(grid, fields, cells_of(grid), turn / steps, points)
            assert stopped == 0
        errors.append(np.abs(points - exact).max())
    assert errors[0] < 5e-3
    assert 6.5 < errors[0] / errors[1] < 9.5


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("grid", [FLAT, SPACE], ids=["2d", "3d"])
@settings(max_examples=60, deadline=None)
@given(random_seed=st.integers(0, 10**6), speed=st.sampled_from([0.1, 1.0, 10.0, 1e4]))
def test_no_velocity_carries_a_particle_into_a_solid(
    grid: StaggeredGrid, random_seed: int, speed: float
) -> None:
    rng = np.random.default_rng(random_seed)
    nx, ny, nz = grid.counts
    solid = rng.random((nz, ny, nx)) < rng.choice([0.1, 0.5, 0.8])
    solid[0, 0, 0] = False
    free = np.argwhere(~solid)[:, ::-1]
    cells = free[rng.integers(len(free), size=200)]
    offset = (
        rng.choice([MARGIN, 0.5, 1 - MARGIN], size=(200, 3))
        if random_seed % 2
        else rng.uniform(MARGIN, 1 - MARGIN, (200, 3))
    )
    points = (cells + offset) * grid.spacing
    points[:, grid.dimension :] = 0.0
    fields = grid.faces()
    for field in fields:
        field.assign((speed * rng.normal(size=grid.shape)).astype(np.float32))
    for _ in range(3):
        points, _ = move(grid, fields, cells_of(grid, solid), 0.1, points)
        at = np.floor(points.astype(np.float64) / grid.spacing).astype(int)
        assert (at >= 0).all()
        assert (at < grid.counts).all()
        assert not solid[at[:, 2], at[:, 1], at[:, 0]].any()
        away = points.astype(np.float64) / grid.spacing - at
        for axis in range(grid.dimension):  # off the closed faces too
            for side, gap in ((-1, away[:, axis]), (1, 1 - away[:, axis])):
                beyond = at.copy()
                beyond[:, axis] += side
                outside = (beyond < 0).any(axis=1) | (beyond >= grid.counts).any(axis=1)
                inside = np.clip(beyond, 0, np.array(grid.counts) - 1)
                closed = outside | solid[inside[:, 2], inside[:, 1], inside[:, 0]]
                assert (gap[closed] > 0.9 * MARGIN).all()


def test_a_wall_stops_one_component_and_lets_the_other_slide() -> None:
    points, stopped = move(
        FLAT, uniform_velocity(FLAT, (1.0, 0.3)), cells_of(FLAT), 0.2, [[0.65, 0.25, 0.0]]
    )
    assert stopped == 1
    assert points[0] == pytest.approx([0.8 - MARGIN * 0.1, 0.31, 0.0], abs=1e-6)


def test_a_thin_wall_is_not_jumped() -> None:
    solid = np.zeros((1, 6, 8), bool)
    solid[0, :, 4] = True
    points, stopped = move(
        FLAT, uniform_velocity(FLAT, (5.0, 0.0)), cells_of(FLAT, solid), 0.1, [[0.05, 0.25, 0.0]]
    )
    assert stopped == 1
    assert points[0, 0] == pytest.approx(0.4 - MARGIN * 0.1, abs=1e-6)


def test_a_diagonal_gap_is_closed() -> None:
    """Closed diagonal gap.

    Two solids that touch at an edge let nothing through, whichever face a particle meets first.
    """
    solid = np.zeros((1, 6, 8), bool)
    solid[0, 2, 4] = solid[0, 3, 3] = True
    starts = [[0.33, 0.22, 0.0], [0.31, 0.24, 0.0], [0.35, 0.25, 0.0]]
    points, stopped = move(
        FLAT, uniform_velocity(FLAT, (1.0, 1.0)), cells_of(FLAT, solid), 0.15, starts
    )
    assert stopped == 3
    assert (points[:, 0] < 0.4).all()
    assert (points[:, 1] < 0.3).all()


def test_two_dimensions_ignore_z() -> None:
    points, stopped = move(
        FLAT, uniform_velocity(FLAT, (0.5, 0.5)), cells_of(FLAT), 0.1, [[0.3, 0.3, 5.0]]
    )
    assert stopped == 0
    assert points[0] == pytest.approx([0.35, 0.35, 0.0], abs=1e-6)


def test_velocities_that_are_not_finite_do_not_crash() -> None:
    for bad in (np.nan, np.inf, -np.inf, 1e38):
        points, _ = move(
            SPACE, uniform_velocity(SPACE, (bad, 0.1, bad)), cells_of(SPACE), 0.1, [[0.3, 0.3, 0.2]]
        )
        assert points.shape == (1, 3)
        if not np.isfinite(bad):
            assert not np.isfinite(points).all()


@pytest.mark.parametrize("grid", [FLAT, StaggeredGrid((20, 9, 11), 0.1, 3)], ids=["2d", "3d"])
def test_clearance_is_the_distance_to_the_nearest_solid(grid: StaggeredGrid) -> None:
    nx, ny, nz = grid.counts
    solid = np.random.default_rng(88).random((nz, ny, nx)) < 0.01
    cells = cells_of(grid, solid)
    room = clearance(grid, cells).numpy()
    # In 2-D cells beyond the plane do not count.
    planes = slice(1, 2) if grid.dimension == 2 else slice(None)
    at = np.argwhere(cells.numpy()[planes] == SOLID)
    everywhere = np.argwhere(np.ones(cells.numpy()[planes].shape))
    distance = np.abs(everywhere[:, None] - at[None]).max(axis=2).min(axis=1)
    assert (room[planes].ravel() == np.minimum(distance, MAX_CLEARANCE)).all()


@pytest.mark.parametrize("grid", [FLAT, StaggeredGrid((20, 9, 11), 0.1, 3)], ids=["2d", "3d"])
@pytest.mark.parametrize("reach", [0.4, 3.0, 20.0])
def test_particles_far_from_solids_need_not_walk(grid: StaggeredGrid, reach: float) -> None:
    """Advection of particles far from solids without walking through cells.

    With a clearance of 1 everywhere each particle that leaves its cell walks; both ways have the
    same result.
    """
    rng = np.random.default_rng(505)
    nx, ny, nz = grid.counts
    cells = cells_of(grid, rng.random((nz, ny, nx)) < 0.03)
    room = clearance(grid, cells)
    careful = wp.array(np.minimum(room.numpy(), 1), dtype=wp.int8, device="cpu")
    free = np.argwhere(grid.interior(cells.numpy()) != SOLID)[:, ::-1]
    start = (
        free[rng.integers(len(free), size=3000)] + rng.uniform(MARGIN, 1 - MARGIN, (3000, 3))
    ) * grid.spacing
    fields = grid.faces()
    for field in fields:
        field.assign(rng.normal(size=grid.shape).astype(np.float32))
    found = []
    for clear in (room, careful):
        position = wp.array(start.astype(np.float32), dtype=wp.vec3, device="cpu")
        stopped = wp.zeros(1, dtype=wp.int32, device="cpu")
        advect(grid, fields, clear, reach * grid.spacing / 2, position, stopped)
        found.append((position.numpy(), int(stopped.numpy()[0])))
    # Where rounding puts the end of a stage on the other side of a face, a particle may go
    # elsewhere.
    apart = np.abs(found[0][0] - found[1][0]).max(axis=1) > 1e-4 * grid.spacing
    assert apart.mean() < 2e-3
    assert found[0][1] == pytest.approx(found[1][1], abs=5)
    assert found[0][1] > 0
