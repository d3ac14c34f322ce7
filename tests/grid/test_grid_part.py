"""Part of a grid: the bits of the whole grid, except near its sides."""

import numpy as np
import pytest
import warp as wp

from warp_lcp.grid.advection import advect, advect_with_distance, clearance
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.domain_sides import side_bits
from warp_lcp.grid.level_set import particle_density
from warp_lcp.grid.particle_seeding import seed
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.signed_distance import Sphere
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.transfer import faces_to_particles, particles_to_faces
from warp_lcp.grid.voxelize import PlacedSolid, voxelize

SPACING = 0.0137
WHOLE = StaggeredGrid((70, 9, 19), SPACING, 3, "cpu")
PART = StaggeredGrid((23, 9, 12), SPACING, 3, "cpu", origin=(41, 0, 4), whole=WHOLE.counts)
FLAT = StaggeredGrid((70, 12, 1), SPACING, 2, "cpu")
FLAT_PART = StaggeredGrid((23, 12, 1), SPACING, 2, "cpu", origin=(41, 0, 0), whole=FLAT.counts)
PAIRS = [(WHOLE, PART), (FLAT, FLAT_PART)]


def stored(part: StaggeredGrid) -> tuple[slice, ...]:
    """Return the position of a part's stored cells in those of the whole grid."""
    return tuple(
        slice(low, low + n) for low, n in zip(reversed(part.origin), part.shape, strict=True)
    )


def away(part: StaggeredGrid, layers: int) -> tuple[slice, ...]:
    """Return the stored cells of a part some layers away from cut ends."""
    cut = [n != m for n, m in zip(reversed(part.counts), reversed(part.whole), strict=True)]
    return tuple(
        slice(layers, n - layers) if c else slice(None)
        for c, n in zip(cut, part.shape, strict=True)
    )


def points(part: StaggeredGrid, margin: float, n: int = 4000) -> np.ndarray:
    """Return points in a part, some cells away from its sides at cuts."""
    rng = np.random.default_rng(271)
    low, high = (
        np.array(part.origin, dtype=float),
        np.array(part.origin) + np.array(part.counts, dtype=float),
    )
    cut = np.array([a != b for a, b in zip(part.counts, part.whole, strict=True)])
    low, high = low + np.where(cut, margin, 0.01), high - np.where(cut, margin, 0.01)
    found = rng.uniform(low, high, (n, 3)) * part.spacing
    if part.dimension == 2:
        found[:, 2] = 0.0
    return found.astype(np.float32)


def fields(whole: StaggeredGrid, part: StaggeredGrid) -> tuple[list[wp.array], list[wp.array]]:
    """Return velocities of both grids."""
    rng = np.random.default_rng(31)
    hosts = [rng.normal(size=whole.shape).astype(np.float32) for _ in range(whole.dimension)]
    return [wp.array(h, device="cpu") for h in hosts], [
        wp.array(np.ascontiguousarray(h[stored(part)]), device="cpu") for h in hosts
    ]


@pytest.mark.parametrize(("whole", "part"), PAIRS)
@pytest.mark.parametrize("indexed", [False, True])
def test_particles_have_the_same_cells_and_give_faces_and_cells_the_same(whole, part, indexed):
    position = points(part, 1.0)
    velocity = np.random.default_rng(5).normal(size=position.shape)
    results = []
    for grid in (whole, part):
        particles = Particles(grid, position, velocity, affine=True, indexed=indexed)
        for gradient in particles.affine:
            gradient.assign(velocity)
        particles.sort()
        faces, weights, density = grid.faces(), grid.faces(), grid.field()
        particles_to_faces(
            grid,
            particles.position,
            particles.velocity,
            particles.affine,
            faces,
            weights,
            offsets=particles.offsets,
        )
        particle_density(grid, particles, grid.everywhere, 8, density)
        key = np.stack(
            np.unravel_index(particles.key.numpy()[: particles.count], grid.shape), axis=1
        )
        results.append(
            (
                key + grid.origin[::-1],
                particles.position.numpy(),
                [f.numpy() for f in (*faces, *weights, density)],
            )
        )
    (keys, order, given), (part_keys, part_order, part_given) = results
    np.testing.assert_array_equal(part_keys, keys)
    np.testing.assert_array_equal(part_order, order)
    for field, of_part in zip(given, part_given, strict=True):
        np.testing.assert_array_equal(of_part, field[stored(part)])
        assert np.count_nonzero(of_part) > 100


@pytest.mark.parametrize(("whole", "part"), PAIRS)
def test_faces_give_particles_the_same(whole, part):
    position, results = points(part, 1.0), []
    for grid, faces in zip((whole, part), fields(whole, part), strict=True):
        particles = Particles(grid, position, np.zeros_like(position), affine=True)
        faces_to_particles(grid, faces, particles.position, particles.velocity, particles.affine)
        results.append(
            [particles.velocity.numpy(), *(gradient.numpy() for gradient in particles.affine)]
        )
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("whole", "part"), PAIRS)
@pytest.mark.parametrize("walls", ["cells", "distance"])
def test_particles_move_alike_among_walls(whole, part, walls):
    rng = np.random.default_rng(17)
    position, results, stops = points(part, 4.0), [], []
    cells = np.where(rng.random(whole.shape) < 0.02, 2, 0).astype(np.int8)
    cells[:, 0], cells[:, -1] = 2, 2
    if whole.dimension == 3:
        cells[0], cells[-1] = 2, 2
    cells[:, :, 0], cells[:, :, -1] = 2, 2
    place = np.indices(whole.shape)[::-1] * 1.0
    distance = (np.hypot(place[0] - 52.3, place[1] - 4.4) - 2.2).astype(np.float32)
    k, j, i = (np.floor(position / whole.spacing).astype(int) + 1).T[::-1]
    k[:] = k if whole.dimension == 3 else 1
    position = (
        position[cells[k, j, i] == 0] if walls == "cells" else position[distance[k, j, i] > 2.0]
    )
    for grid, faces in zip((whole, part), fields(whole, part), strict=True):
        where, stopped = (
            wp.array(position, dtype=wp.vec3, device="cpu"),
            wp.zeros(1, dtype=wp.int32, device="cpu"),
        )
        box = (slice(None),) * 3 if grid is whole else stored(part)
        if walls == "cells":
            room = clearance(
                grid, wp.array(np.ascontiguousarray(cells[box]), dtype=wp.int8, device="cpu")
            )
            advect(grid, faces, room, 0.6 * SPACING, where, stopped)
        else:
            near, cuts = (
                wp.array(np.ascontiguousarray(distance[box]), device="cpu"),
                side_bits(("left", "right", "back", "front")),
            )
            open_sides = (
                0
                if grid is whole
                else cuts
                if grid.dimension == 3
                else side_bits(("left", "right"))
            )
            advect_with_distance(
                grid, faces, near, 0.6 * SPACING, where, stopped, open_sides=open_sides
            )
        results.append(where.numpy())
        stops.append(int(stopped.numpy()[0]))
    np.testing.assert_array_equal(*results)
    assert stops[0] == stops[1] > 20
    assert np.abs(results[0] - position).max() > SPACING


@pytest.mark.parametrize(("whole", "part"), PAIRS)
@pytest.mark.parametrize("jitter", [0.0, 0.7])
def test_parts_are_seeded_as_the_whole_is(whole, part, jitter):
    regions = [lambda p: p[:, 0] + p[:, 1] < 0.8, lambda p: p[:, 0] > 0.75]
    results = []
    for grid in (whole, part):
        results.append(
            seed(
                grid,
                regions,
                np.ones(grid.counts[::-1], dtype=bool),
                per_axis=2,
                jitter=jitter,
                random_seed=99,
            )
        )
    (position, owner), (part_position, part_owner) = results
    cell = np.floor(position.astype(np.float64) / SPACING).astype(int) - part.origin
    cell[:, 2] = cell[:, 2] if whole.dimension == 3 else 0
    inside = ((cell >= 0) & (cell < part.counts)).all(axis=1)
    np.testing.assert_array_equal(part_position, position[inside])
    np.testing.assert_array_equal(part_owner, owner[inside])
    assert set(owner[inside]) == {0, 1}


def ball(grid: StaggeredGrid) -> PlacedSolid:
    """Return a solid in the middle of the part."""
    center = np.array([52.3, 4.7, 9.6][: grid.dimension]) * SPACING
    return PlacedSolid(
        geometry=Sphere(center=center.tolist(), radius=2.4 * SPACING), separating=True, name="ball"
    )


@pytest.mark.parametrize(("whole", "part"), PAIRS)
def test_solids_cut_the_same_cells(whole, part):
    solids = [ball(whole)]
    cuts = side_bits(
        ("left", "right", "back", "front") if whole.dimension == 3 else ("left", "right")
    )
    of_whole = CutCells(whole, solids, wall_separating=True)
    of_part = CutCells(part, solids, wall_separating=True, open_sides=cuts, remarks=False)
    inner = away(part, 2)
    pairs = [
        (of_whole.base, of_part.base),
        (of_whole.capacity, of_part.capacity),
        (of_whole.distance, of_part.distance),
    ]
    for a, b in [
        *pairs,
        *zip(of_whole.open, of_part.open, strict=True),
        *zip(of_whole.wall, of_part.wall, strict=True),
    ]:
        np.testing.assert_array_equal(b.numpy()[inner], a.numpy()[stored(part)][inner])
    assert not of_part.whole_cells
    voxels = [voxelize(g, solids, wall_separating=True, remarks=g is whole) for g in (whole, part)]
    inner = away(part, 1)
    np.testing.assert_array_equal(
        voxels[1].index.numpy()[inner], voxels[0].index.numpy()[stored(part)][inner]
    )
    assert voxels[0].covered == voxels[1].covered > (10,)


def test_a_window_beyond_a_part_has_a_layer():
    assert PART.window((60, 1, 1), (70, 3, 3)).low[2] == 24
    beyond = PART.window((-30, 1, 1), (-9, 3, 3))
    assert (beyond.low[2], beyond.high[2]) == (0, 1)
