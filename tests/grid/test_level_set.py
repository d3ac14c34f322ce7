"""Level set of particles.

Against planes, balls and walls with a density integral in closed form, and against plain sums.
"""

import itertools

import numpy as np
import pytest
import warp as wp

from warp_lcp.grid.level_set import LevelSet, whole_cell_capacity
from warp_lcp.grid.particle_seeding import lattice
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window

AIR, SOLID = 0, 2
FLAT, DEEP = StaggeredGrid((14, 16, 1), 0.1, 2), StaggeredGrid((10, 14, 9), 0.1, 3)
GRIDS = pytest.mark.parametrize("grid", [FLAT, DEEP], ids=["2d", "3d"])


def box_of(grid: StaggeredGrid) -> np.ndarray:
    """Return the cells of a domain without solids."""
    base = np.full(grid.shape, SOLID, np.int8)
    base[1:-1, 1:-1, 1:-1] = AIR
    return base


def on_device(host: np.ndarray) -> wp.array:
    return wp.array(host, device="cpu")


def fill(grid: StaggeredGrid, low: list[float], high: list[float], per_cell: int) -> np.ndarray:
    """Return points at the centers of parts of a box [cells].

    The size of the parts is the nearest to 1 / per_cell that divides the box.
    """
    axes = []
    for axis in range(3):
        n = round((high[axis] - low[axis]) * per_cell) if axis < grid.dimension else 1
        axes.append(
            low[axis] + (np.arange(n) + 0.5) * (high[axis] - low[axis]) / n
            if axis < grid.dimension
            else np.zeros(1)
        )
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def level_set(
    grid: StaggeredGrid,
    points: np.ndarray,
    a_cell: int,
    *,
    capacity: np.ndarray | None = None,
    base: np.ndarray | None = None,
    smoothing: int = 0,
    indexed: bool = False,
) -> LevelSet:
    """Return the level set of points in cells, with `a_cell` of them at rest.

    By default the capacity is that of whole cells.
    """
    cells = on_device(box_of(grid) if base is None else base)
    particles = Particles(
        grid, points * grid.spacing, np.zeros_like(points), affine=False, indexed=indexed
    )
    if indexed:
        particles.sort()
    room = grid.field()
    whole_cell_capacity(grid, cells, room)
    if capacity is not None:
        room.assign(capacity.astype(np.float32))
    made = LevelSet(grid, particles_a_cell=a_cell, smoothing=smoothing)
    made.update(particles, grid.everywhere, room, cells)
    return made


def centers(grid: StaggeredGrid, axis: int) -> np.ndarray:
    """Return the coordinate [cells] of interior cell centers, for broadcasting."""
    shape = [1, 1, 1]
    shape[2 - axis] = -1
    return (np.arange(grid.counts[axis]) + 0.5).reshape(shape)


def share_below(s: np.ndarray) -> np.ndarray:
    """Return the share of the quadratic B-spline below s.

    Its definition, a convolution of three boxes, is integrated numerically.
    """
    n = 400
    box = np.full(n, 1.0 / n)
    kernel = np.convolve(np.convolve(box, box), box)
    edges = (np.arange(len(kernel) + 1) - len(kernel) / 2) / n
    return np.interp(s, edges, np.concatenate([[0.0], np.cumsum(kernel)]))


@GRIDS
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_phi_is_the_distance_to_a_plane_wherever_it_lies_in_a_cell(
    grid: StaggeredGrid, axis: int, side: int
) -> None:
    """Distance to a plane, wherever it lies in a cell.

    At this density (16 or 10 points along an axis) a lattice is a continuum to 5e-3 cells; the
    domain's walls have no effect. A wrong sign, a center off by half a cell or a capacity without
    the walls are errors of a tenth of a cell or more.
    """
    if axis >= grid.dimension:
        pytest.skip("no such axis")
    per_cell = 16 if grid.dimension == 2 else 10
    rng = np.random.default_rng(90125 + axis)
    for surface in 4.0 + rng.random(4):
        low, high = [0.0] * 3, [float(n) for n in grid.counts]
        if side > 0:
            high[axis] = surface
        else:
            low[axis] = surface
        # Whole layers from the surface on, so that the density is right there; the remainder is at
        # the far wall.
        layers = int((high[axis] - low[axis]) * per_cell) / per_cell
        if side > 0:
            low[axis] = high[axis] - layers
        else:
            high[axis] = low[axis] + layers
        surface_level = level_set(grid, fill(grid, low, high, per_cell), per_cell**grid.dimension)
        expected = np.broadcast_to(
            side * (centers(grid, axis) - surface), grid.interior(surface_level.phi.numpy()).shape
        )
        near = np.abs(expected) < 0.9
        assert near.any()
        assert grid.interior(surface_level.phi.numpy())[near] == pytest.approx(
            expected[near], abs=1e-2
        )
        assert (grid.interior(surface_level.phi.numpy())[expected > 1.6] == 1.5).all()


@GRIDS
def test_particles_as_a_liquid_has_them_put_the_surface_within_a_tenth_of_a_cell(
    grid: StaggeredGrid,
) -> None:
    """Surface of a scene's particles, within a tenth of a cell.

    A scene has 2 particles along an axis of a cell, moved by a quarter of their spacing. The test
    measures mean and scatter of phi in cells beside the surface.
    """
    points = (
        np.concatenate([lattice(grid, 2, 0.25, 515, plane) for plane in range(grid.counts[2])])
        / grid.spacing
    )
    points = points[points[:, 1] < 7.0]
    made = level_set(grid, points, 2**grid.dimension)
    errors = np.stack(
        [grid.interior(made.phi.numpy())[:, row] - (row + 0.5 - 7.0) for row in (6, 7)]
    )
    assert abs(errors.mean()) < 0.03
    assert errors.std() < 0.06


def test_a_cell_with_little_room_has_the_distance_of_its_neighbors() -> None:
    """Full liquid around a hole of 3 x 3 cells without particles, whose capacity is what is left.

    The kernel of the cell in the middle lies in the hole: without its neighbors it would be air.
    """
    grid, hole = FLAT, (7, 8)
    points = fill(grid, [0.0, 0.0, 0.0], [14.0, 16.0, 1.0], 4)
    center = np.array([hole[0] + 0.5, hole[1] + 0.5])
    points = points[(np.abs(points[:, :2] - center) > 1.5).any(axis=1)]
    base, capacity = box_of(grid), grid.field()
    whole_cell_capacity(grid, on_device(base), capacity)
    share = [0.0, 1 / 6, 5 / 6, 1.0, 5 / 6, 1 / 6]  # of kernels within 1.5 cells of the middle
    room = capacity.numpy().copy()
    for row in range(-2, 3):
        for column in range(-2, 3):
            place = 1, hole[1] + 1 + row, hole[0] + 1 + column
            room[place] -= share[row + 3] * share[column + 3]
    phi = grid.interior(level_set(grid, points, 16, capacity=room).phi.numpy())
    assert room.min() < 0.2
    assert (phi < 0).all()


@GRIDS
def test_a_surface_that_meets_cut_walls_at_right_angles_is_not_biased(grid: StaggeredGrid) -> None:
    """Surface that meets cut walls at right angles, without bias.

    Solid where x < 2.3 and x > 8.6 cells: the capacity is a product of half-space distributions in
    closed form.
    """
    low_wall, high_wall, surface = 2.3, 8.6, 6.37
    per_cell = 20 if grid.dimension == 2 else 10
    top = [high_wall, surface, float(grid.counts[2])]
    points = fill(grid, [low_wall, 0.0, 0.0], top, per_cell)
    volume = np.prod([top[0] - low_wall, *top[1 : grid.dimension]])
    x = np.arange(grid.shape[2]) - 0.5
    open_x = np.minimum(share_below(x - low_wall), share_below(high_wall - x))
    along = [
        np.interp(np.arange(n + 2) - 0.5, [-0.5, 0.5, 1.5], [1 / 6, 5 / 6, 1]) for n in grid.counts
    ]
    along = [np.minimum(a, a[::-1]) for a in along]
    capacity = (
        open_x * along[1][:, None] * (along[2][:, None, None] if grid.dimension == 3 else 1.0)
    )
    capacity = np.broadcast_to(capacity, grid.shape)
    base = box_of(grid)
    base[..., : int(low_wall) + 1] = SOLID
    base[..., int(high_wall) + 2 :] = SOLID
    weight = len(points) / volume  # not a power: the box holds no whole number of parts
    made = level_set(grid, points, round(weight), capacity=capacity, base=base)
    phi = grid.interior(made.phi.numpy())
    y = centers(grid, 1)[0, :, 0]
    rows = np.abs(y - surface) < 0.9
    columns = slice(int(low_wall), int(high_wall) + 1)
    expected = np.broadcast_to((y - surface)[None, rows, None], phi[:, rows, columns].shape)
    assert phi[:, rows, columns] == pytest.approx(expected, abs=1e-2)
    plain = grid.interior(level_set(grid, points, round(weight), base=base).phi.numpy())[
        :, rows, columns
    ]
    assert np.abs(plain - expected).max() > 0.1  # with the capacity of whole cells it is biased


@GRIDS
@pytest.mark.parametrize("indexed", [False, True], ids=["scatter", "gather"])
def test_the_density_is_the_sum_of_the_particles_kernels(
    grid: StaggeredGrid, indexed: bool
) -> None:
    """Density as the sum of the particles' kernels.

    The sum is over every pair of cell and particle in float64, each kernel evaluated from its
    distance.
    """
    rng = np.random.default_rng(31415)
    points = rng.random((400, 3)) * np.array(grid.counts)
    points[0] = 1e-3  # a corner
    points[1] = np.array(grid.counts) - 1e-3
    points[:, grid.dimension :] = 0.0
    surface_level = level_set(grid, points, 4, indexed=indexed)
    expected = np.ones((len(points), *grid.shape))
    for axis in range(grid.dimension):
        shape = [1, 1, 1, 1]
        shape[3 - axis] = -1
        d = np.abs(
            points[:, axis].reshape(-1, 1, 1, 1)
            - (np.arange(grid.shape[2 - axis]) - 0.5).reshape(shape)
        )
        expected = expected * np.where(
            d < 0.5, 0.75 - d**2, np.where(d < 1.5, 0.5 * (1.5 - d) ** 2, 0.0)
        )
    expected = expected.sum(axis=0) / 4
    if grid.dimension == 2:
        expected[[0, 2]] = 0.0
    assert surface_level.density.numpy() == pytest.approx(expected, abs=2e-5)


@GRIDS
def test_gathered_and_scattered_surfaces_agree(grid: StaggeredGrid) -> None:
    rng = np.random.default_rng(2718)
    points = fill(grid, [0.0, 0.0, 0.0], [6.0, 5.0, float(grid.counts[2])], 2)
    points[:, : grid.dimension] += 0.2 * (rng.random((len(points), grid.dimension)) - 0.5)
    fields = [
        level_set(grid, points, 2**grid.dimension, indexed=indexed).phi.numpy()
        for indexed in (False, True)
    ]
    # The cube root near 1.5 magnifies rounding.
    assert fields[0] == pytest.approx(fields[1], abs=2e-2)
    near = np.abs(fields[0]) < 1.0
    assert fields[0][near] == pytest.approx(fields[1][near], abs=1e-5)


@GRIDS
def test_a_lone_particle_is_spray(grid: StaggeredGrid) -> None:
    """Lone particle as spray.

    It is no liquid anywhere, wherever it is in its cell, and encloses nothing.
    """
    for shift in (0.0, 0.25, 0.5):
        point = np.array([[5.0 + shift, 5.0 + shift, 0.0 if grid.dimension == 2 else 5.0 + shift]])
        made = level_set(grid, point, 2**grid.dimension)
        assert made.phi.numpy().min() > 0.0
        assert made.volume(None, grid.everywhere) == 0.0


@GRIDS
def test_nothing_stays_behind_when_the_window_moves(grid: StaggeredGrid) -> None:
    """Moved window without remains of the last one.

    It is equal bit for bit to a fresh level set, smoothed or not.
    """
    base = on_device(box_of(grid))
    room = grid.field()
    whole_cell_capacity(grid, base, room)
    depth = float(grid.counts[2])
    first = fill(grid, [0.0, 0.0, 0.0], [4.0, 4.0, depth], 2) * grid.spacing
    then = fill(grid, [6.0, 7.0, 0.0], [9.0, 10.0, depth], 2) * grid.spacing
    for smoothing in (0, 2):
        used, fresh = (LevelSet(grid, particles_a_cell=4, smoothing=smoothing) for _ in range(2))
        for points, low, high in ((first, (1, 1, 1), (4, 4, 9)), (then, (7, 8, 1), (9, 10, 9))):
            particles = Particles(grid, points, np.zeros_like(points), affine=False)
            window = grid.window(low, high, grow=2 + smoothing)
            used.update(particles, window, room, base)
        fresh.update(particles, window, room, base)
        assert np.array_equal(used.phi.numpy(), fresh.phi.numpy())
        assert np.array_equal(used.density.numpy(), fresh.density.numpy())
        assert used.volume(None, window) == fresh.volume(None, window)
        outside = np.ones(grid.shape, bool)
        outside[tuple(slice(a, b) for a, b in zip(window.low, window.high, strict=True))] = False
        assert (used.phi.numpy()[outside] == np.float32(used.limit)).all()


@GRIDS
def test_solid_cells_take_the_mean_of_their_neighbors_a_layer_at_a_time(
    grid: StaggeredGrid,
) -> None:
    """Solid cells take the mean of their neighbors, layer by layer.

    Compared with an independent Jacobi sweep; a sweep does not use its own results.
    """
    rng = np.random.default_rng(1618)
    base = box_of(grid)
    base[rng.random(grid.shape) < 0.4] = SOLID
    points = fill(grid, [0.0, 0.0, 0.0], [9.0, 6.6, float(grid.counts[2])], 2)
    made = level_set(grid, points, 2**grid.dimension, base=base)
    phi = made.phi.numpy().astype(np.float64)
    known = base != SOLID
    if grid.dimension == 2:
        known[[0, 2]] = False
    expected = np.where(known, phi, 1.5)
    for _ in range(2):
        total, count = np.zeros(grid.shape), np.zeros(grid.shape)
        for axis, step in itertools.product(range(3 - grid.dimension, 3), (-1, 1)):
            source = np.roll(np.pad(known, 1), step, axis)[1:-1, 1:-1, 1:-1]
            total += np.where(
                source, np.roll(np.pad(expected, 1), step, axis)[1:-1, 1:-1, 1:-1], 0.0
            )
            count += source
        new = ~known & (count > 0)
        if grid.dimension == 2:
            new[[0, 2]] = False
        expected[new] = total[new] / count[new]
        known |= new
    assert phi == pytest.approx(expected, abs=1e-5)


@pytest.mark.default_cases(1)
@GRIDS
def test_the_capacity_of_whole_cells_is_what_a_continuum_in_the_open_ones_weighs(
    grid: StaggeredGrid,
) -> None:
    """Capacity of whole cells: the weight of a continuum in the open ones.

    With 12 particles along an axis in every open cell, the density is the midpoint rule of the
    kernel's integral.
    """
    rng = np.random.default_rng(6283)
    base = box_of(grid)
    base[rng.random(grid.shape) < 0.3] = SOLID
    room = grid.field()
    whole_cell_capacity(grid, on_device(base), room)
    per_cell = 12
    points = fill(grid, [0.0, 0.0, 0.0], [float(n) for n in grid.counts], per_cell)
    index = np.minimum(points.astype(int), np.array(grid.counts) - 1) + 1
    points = points[base[index[:, 2], index[:, 1], index[:, 0]] != SOLID]
    density = level_set(grid, points, per_cell**grid.dimension, base=base).density.numpy()
    used = slice(1, 2) if grid.dimension == 2 else slice(None)
    assert room.numpy()[used] == pytest.approx(density[used], abs=3e-3)


def ball(
    grid: StaggeredGrid, center: list[float], radius: float, per_axis: int, random_seed: int
) -> np.ndarray:
    """Return the points of a jittered lattice in a disc or a ball [cells]."""
    points = (
        np.concatenate(
            [lattice(grid, per_axis, 0.25, random_seed, plane) for plane in range(grid.counts[2])]
        )
        / grid.spacing
    )
    middle = np.array([*center, 0.0][:3])
    return points[((points - middle) ** 2)[:, : grid.dimension].sum(axis=1) < radius**2]


@pytest.mark.parametrize("smoothing", [0, 2])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_ball_of_twelve_cells_has_its_volume(dimension: int, smoothing: int) -> None:
    """Volume of a ball of twelve cells, within 1 %.

    The kernel's width makes a ball of radius R smaller by (dimension - 1)/(8 R) cells, and more
    when smoothed.
    """
    grid = StaggeredGrid((36, 36, 1 if dimension == 2 else 36), 0.05, dimension)
    radius, center = 12.0, [18.2, 17.9, 18.1][:dimension]  # out of the walls' reach
    surface_level = level_set(
        grid, ball(grid, center, radius, 2, 99), 2**dimension, smoothing=smoothing
    )
    exact = (
        np.pi * radius**2 if dimension == 2 else 4 / 3 * np.pi * radius**3
    ) * grid.spacing**dimension
    lost = dimension * (dimension - 1) * (0.25 + 0.5 * smoothing) / (2 * radius**2)
    assert surface_level.volume(None, grid.everywhere) / exact == pytest.approx(
        1.0 - lost, abs=4e-3
    )
    assert smoothing or surface_level.volume(None, grid.everywhere) / exact == pytest.approx(
        1.0, abs=1e-2
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_volume_ends_at_a_wall_that_cuts_cells(dimension: int) -> None:
    """Volume up to a wall that cuts cells.

    All cells are full and the wall is a plane: the result is half of the domain, whatever phi is
    within the solid.
    """
    nx, ny, nz = 16, 20, 1 if dimension == 2 else 14
    grid = StaggeredGrid((nx, ny, nz), 0.125, dimension)
    points = fill(grid, [0.0] * 3, [float(c) for c in grid.counts], 2)
    surface_level = level_set(grid, points, 2**dimension)
    k, j, i = np.meshgrid(*(np.arange(m) - 1.0 for m in grid.shape), indexing="ij")
    walls = np.minimum(np.minimum(i, nx - i), np.minimum(j, ny - j))
    if dimension == 3:
        walls = np.minimum(walls, np.minimum(k, nz - k))
    slope = np.array([0.6, 0.8, 0.0])
    cut = slope[0] * (i - nx / 2) + slope[1] * (j - ny / 2)
    distance = on_device(np.minimum(walls, cut).astype(np.float32))
    whole = nx * ny * nz * grid.cell_volume
    assert surface_level.volume(None, grid.everywhere) == pytest.approx(whole, rel=1e-6)
    assert surface_level.volume(
        on_device(walls.astype(np.float32)), grid.everywhere
    ) == pytest.approx(whole, rel=1e-6)
    # Some is lost where the plane meets the domain's walls: there the distance is not linear
    # between the nodes.
    assert surface_level.volume(distance, grid.everywhere) == pytest.approx(whole / 2, rel=6e-3)
    # Only the contents of the window.
    assert surface_level.volume(distance, grid.window((1, 1, 1), (8, 20, 14))) < whole / 2
    assert surface_level.volume(None, Window((0, 0, 0), (1, 1, 1), grid.device)) == 0.0


def test_smoothing_quiets_a_surface_and_keeps_its_place() -> None:
    """Smoothed surface with less noise in the same place.

    Particles are uniformly random: phi scatters less after two passes, and a plane stays in place.
    """
    rng = np.random.default_rng(77)
    surface = 7.4
    points = rng.random((round(16 * 14 * surface), 3)) * [14.0, surface, 0.0]
    scatter = [
        FLAT.interior(level_set(FLAT, points, 16, smoothing=n).phi.numpy())[0, 6:8].std(axis=1)
        for n in (0, 2)
    ]
    assert (scatter[1] < 0.8 * scatter[0]).all()
    dense = fill(FLAT, [0.0, 0.0, 0.0], [14.0, surface, 1.0], 20)
    made = level_set(FLAT, dense, 400, smoothing=2)
    expected = np.arange(16) + 0.5 - surface
    near = np.abs(expected) < 1.0
    # The kernel is not quite normal.
    assert FLAT.interior(made.phi.numpy())[0, near, 3] == pytest.approx(expected[near], abs=0.04)


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="particles_a_cell = 0"):
        LevelSet(FLAT, particles_a_cell=0)
    with pytest.raises(ValueError, match="smoothing = -1"):
        LevelSet(FLAT, particles_a_cell=4, smoothing=-1)


@pytest.mark.cuda
@GRIDS
def test_cuda_agrees_with_the_cpu(grid: StaggeredGrid) -> None:
    points = fill(grid, [0.0, 0.0, 0.0], [6.0, 5.4, float(grid.counts[2])], 2)
    found = []
    for device in ("cpu", "cuda:0"):
        here = StaggeredGrid(grid.counts, grid.spacing, grid.dimension, device)
        particles = Particles(here, points * here.spacing, np.zeros_like(points), affine=False)
        particles.sort()
        base, room = wp.array(box_of(grid), device=device), here.field()
        whole_cell_capacity(here, base, room)
        made = LevelSet(here, particles_a_cell=2**grid.dimension)
        made.update(particles, here.everywhere, room, base)
        found.append((made.phi.numpy(), made.volume(None, here.everywhere)))
    assert found[0][0] == pytest.approx(found[1][0], abs=2e-2)
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-4)
