"""Density correction: its problem, the displacements, and conservation.

The problem is compared with a dense one.
"""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from small_liquids import advance, box, create, dam, scene
from warp_lcp.benchmarks.validation.signals import enclosed_cells
from warp_lcp.grid.particles import Particles
from warp_lcp.kernels import launch_graph as program
from warp_lcp.kernels.kernel_variant import KernelVariant
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.boundary_kernels import HELD, RELEASED
from warp_lcp.material.density_correction import LONGEST, DensityCorrection
from warp_lcp.material.particle_redistribution import SEVERE

BALL = {"shape": "sphere", "center": [0.5, 0.5], "radius": 0.23}


def tank(dimension: int = 2, resolution: int = 12, **tables: Any) -> tuple[Any, Boundary]:
    """Return grid and boundary of a unit box."""
    simulation = create(
        scene(
            size=[1.0] * dimension,
            resolution=resolution,
            liquid=[box([0.0] * dimension, [1.0] * dimension)],
            **tables,
        )
    )
    return simulation.grid, simulation.boundary


def lattice(grid: Any, boundary: Boundary, per_axis: int = 2) -> np.ndarray:
    """Return the points of a lattice that fills the open part [m], shape (n, 3)."""
    axes = [
        (np.arange(n * per_axis) + 0.5) * grid.spacing / per_axis
        for n in grid.counts[: grid.dimension]
    ]
    points = np.stack([c.ravel() for c in np.meshgrid(*axes, indexing="ij")], axis=1)
    points = np.pad(points, ((0, 0), (0, 3 - grid.dimension)))
    return points[boundary.admits(points)]


def correction(grid: Any, boundary: Boundary, **settings: Any) -> DensityCorrection:
    """Return a correction of particles, 2 along each axis of a cell."""
    return DensityCorrection(
        grid,
        boundary,
        wl.ProjectedMultigrid(precision="double"),
        particles_a_cell=2**grid.dimension,
        **({"max_density": 1.05} | settings),
    )


def particles_of(grid: Any, points: np.ndarray, indexed: bool = False) -> Particles:
    """Return particles with individual velocities."""
    velocity = np.random.default_rng(77).standard_normal((len(points), 3)).astype(np.float32)
    return Particles(grid, points.astype(np.float32), velocity, affine=True, indexed=indexed)


def spline(d: np.ndarray) -> np.ndarray:
    """Return the quadratic B-spline."""
    d = np.abs(d)
    return np.where(d < 0.5, 0.75 - d * d, np.where(d < 1.5, 0.5 * (1.5 - d) ** 2, 0.0))


def density_of(grid: Any, points: np.ndarray) -> np.ndarray:
    """Return the density of points at cell centers, in the stored shape.

    By a sum over all pairs of cells and particles.
    """
    result = np.zeros(grid.shape)
    dimension = grid.dimension
    for cell in itertools.product(*(range(1, n + 1) for n in grid.counts)):
        center = np.array(cell) + 0.5
        weight = spline(grid.to_grid(points)[:, :dimension] - center[:dimension]).prod(axis=1)
        result[cell[2], cell[1], cell[0]] = weight.sum() / 2**dimension
    return result


def dense_solution(
    boundary: Boundary, density: np.ndarray, most: float, sweeps: int = 20000
) -> np.ndarray:
    """Return x >= 0 of the correction's complementarity problem, by sweeps.

    x is complementary to sum a_f (x_i - x_nb) + most capacity - density, in the stored shape. A
    face of whole cells is open where no cell beside it is SOLID; x is 0 where there is no density.
    """
    base, capacity = boundary.base.numpy(), boundary.capacity.numpy().astype(float)
    wet = (base != wl.SOLID) & (density > 0)
    number = np.full(base.shape, -1)
    number[wet] = np.arange(wet.sum())
    A = np.zeros((wet.sum(), wet.sum()))
    for cell in np.argwhere(base != wl.SOLID):
        for axis in range(3):
            below = cell.copy()
            below[2 - axis] -= 1
            here, there = tuple(cell), tuple(below)
            if base[there] == wl.SOLID:
                continue
            open_ = float(boundary.open[axis].numpy()[here]) if boundary.open else 1.0
            for one, other in ((number[here], number[there]), (number[there], number[here])):
                if one >= 0:
                    A[one, one] += open_
                if one >= 0 and other >= 0:
                    A[one, other] -= open_
    b = most * capacity[wet] - density[wet]
    x = np.zeros(len(b))
    for _ in range(sweeps):
        before = x.copy()
        for i in range(len(b)):
            if A[i, i] > 0:
                x[i] = max(0.0, x[i] - (A[i] @ x + b[i]) / A[i, i])
        if np.abs(x - before).max() < 1e-12:
            break
    field = np.zeros(base.shape)
    field[wet] = x
    return field


@pytest.mark.parametrize("solid", [[], [box([0.25, 0.25], [0.5, 0.5])], [BALL]])
def test_the_solution_is_that_of_a_dense_problem(solid: list[dict[str, Any]]) -> None:
    """Solution against that of a dense problem.

    Density, capacity beside walls, open fractions and signs all affect x.
    """
    grid, boundary = tank(resolution=8, solid=solid)
    points = lattice(grid, boundary)
    points = points[points[:, 1] < 0.8]
    points[:, 1] *= 0.87  # squeezed onto the floor
    points = points[boundary.admits(points)]
    corrected = correction(grid, boundary, tolerance=1e-8, max_iterations=60)
    done = corrected.apply(particles_of(grid, points), grid.everywhere)
    density = density_of(grid, points.astype(np.float32))
    expected = dense_solution(boundary, density, 1.05)
    assert expected.max() > 0.2
    np.testing.assert_allclose(corrected.x.numpy(), expected, atol=0.01 if boundary.open else 1e-4)
    open_cells = boundary.base.numpy() != wl.SOLID
    assert done.max_density == pytest.approx(
        1 + (density - boundary.capacity.numpy())[open_cells & (density > 0)].max(), abs=1e-4
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("indexed", [False, True])
def test_an_over_full_cell_pushes_its_neighbors_outward(dimension: int, indexed: bool) -> None:
    """Over-full cell: it pushes its neighbors outward.

    With the sign of [Book] eq. (1.116) they would be drawn in, and the density would rise.
    """
    grid, boundary = tank(dimension, 9)
    points = lattice(grid, boundary)
    points = points[points[:, 1] < 7.0 / 9.0]
    center = np.array([0.5, 0.5, 0.5 if dimension == 3 else 0.0])
    more = np.random.default_rng(31).uniform(-0.5, 0.5, (2 * 2**dimension, 3)) * grid.spacing
    more[:, dimension:] = 0.0
    particles = particles_of(grid, np.concatenate([points, center + more]), indexed)
    if indexed:
        particles.sort()
    corrected, last = correction(grid, boundary), math.inf
    for turn in range(12):
        before, speeds = particles.position.numpy().copy(), particles.velocity.numpy().copy()
        done = corrected.apply(particles, grid.everywhere)
        assert done.max_density < last
        last = done.max_density
        if done.result is None:
            break
        assert done.result
        if turn == 0 and not indexed:
            away = before - center
            distance = np.linalg.norm(away, axis=1)
            outward = ((particles.position.numpy().copy() - before) * away).sum(
                axis=1
            ) / np.maximum(distance, 1e-9)
            ring = (distance > 0.6 * grid.spacing) & (distance < 1.6 * grid.spacing)
            assert (outward[ring] > 0.01 * grid.spacing).all()
            assert np.array_equal(particles.velocity.numpy().copy(), speeds)
    assert last < 1.15
    assert particles.count == len(points) + len(more)


@pytest.mark.parametrize("solid", [[], [BALL]])
def test_no_particle_moves_more_than_half_a_cell_or_into_a_wall(
    solid: list[dict[str, Any]],
) -> None:
    """Displacements of at most half a cell, and not into a wall.

    There are ten times too many particles on the floor and around a ball.
    """
    grid, boundary = tank(resolution=16, solid=solid)
    points = np.random.default_rng(5).uniform(0.001, 0.999, (9000, 3)) * [1.0, 0.3, 0.0]
    points = points[boundary.admits(points)]
    particles = particles_of(grid, points)
    corrected = correction(grid, boundary)
    for _ in range(5):
        before = particles.position.numpy().astype(float)
        assert corrected.apply(particles, grid.everywhere).result is not None
        after = particles.position.numpy().astype(float)
        moved = np.linalg.norm(after - before, axis=1).max() / grid.spacing
        assert 0.3 < moved <= LONGEST + 2e-3  # plus the displacement by a wall
        assert (after[:, :2] >= 0).all()
        assert (after[:, :2] <= 1).all()
        if solid:
            assert np.linalg.norm(after[:, :2] - 0.5, axis=1).min() > 0.23 - 0.05 * grid.spacing


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_lattice_at_rest_is_left_alone(dimension: int) -> None:
    """Lattice at rest: unchanged.

    Also beside walls, where a cell's kernel holds less: there is no solve, and no bit changes.
    """
    grid, boundary = tank(dimension, 8)
    particles = particles_of(grid, lattice(grid, boundary))
    before = particles.position.numpy().copy()
    done = correction(grid, boundary).apply(particles, grid.everywhere)
    assert done.result is None
    assert done.max_density == pytest.approx(1.0, abs=0.03)
    assert np.array_equal(particles.position.numpy().copy(), before)


def test_a_layer_squeezed_against_a_wall_counts_although_half_of_its_kernel_is_wall() -> None:
    """Layer squeezed against a wall, where half of the kernel is in the wall.

    A cell at the floor holds 5/6: without the capacity 1.2 times that would count as rest.
    """
    grid, boundary = tank(resolution=8)
    points = lattice(grid, boundary)
    points = points[points[:, 1] < 1.0 / 8.0]
    lifted = points + np.array([0.0, 1.0 / 8.0, 0.0])
    squeezed = np.concatenate([points, points * [1.0, 0.8, 1.0] + np.array([1e-3, 0.0, 0.0])])[
        : int(1.2 * len(points))
    ]
    done = correction(grid, boundary).apply(
        particles_of(grid, np.concatenate([squeezed, lifted])), grid.everywhere
    )
    assert density_of(grid, np.concatenate([squeezed, lifted])).max() < 1.3
    assert done.over_full > 0
    assert done.result is not None


def test_a_closed_room_that_is_too_full_is_left_alone() -> None:
    """Closed room that is too full: unchanged.

    Whole cells without a way out: no exception, no motion, and a note in the log.
    """
    grid, boundary = tank(resolution=8)
    points = np.repeat(lattice(grid, boundary), 2, axis=0)
    particles = particles_of(grid, points)
    before = particles.position.numpy().copy()
    done = correction(grid, boundary).apply(particles, grid.everywhere)
    assert done.result is not None
    assert done.result.status is wl.SolveStatus.INFEASIBLE
    assert np.array_equal(particles.position.numpy().copy(), before)


def test_an_overfull_closed_pocket_does_not_stop_the_correction_elsewhere() -> None:
    """Closed pocket that is too full, without effect on others.

    Where solids cut cells the problem of a pocket without a way out is solvable too.
    """
    walls = [box([0.3, 0.3], [0.7, 0.4], rotate=3.0), box([0.3, 0.6], [0.7, 0.7], rotate=3.0)]
    walls += [box([0.3, 0.3], [0.4, 0.7], rotate=3.0), box([0.6, 0.3], [0.7, 0.7], rotate=3.0)]
    grid, boundary = tank(resolution=24, solid=walls)
    random = np.random.default_rng(8)
    inside = np.pad(random.uniform(0.42, 0.58, (400, 2)), ((0, 0), (0, 1)))
    below = np.pad(random.uniform(0.01, 0.2, (400, 2)), ((0, 0), (0, 1)))
    particles = particles_of(
        grid, np.concatenate([inside, below])[boundary.admits(np.concatenate([inside, below]))]
    )
    before = particles.position.numpy().copy()
    done = correction(grid, boundary).apply(particles, grid.everywhere)
    assert done.result is not None
    assert done.result.status is not wl.SolveStatus.INFEASIBLE
    outside = before[:, 1] < 0.25
    assert (
        np.linalg.norm(particles.position.numpy().copy() - before, axis=1)[outside].max()
        > 0.1 * grid.spacing
    )


def pool(**tables: Any) -> Any:
    """Return water at rest, 8 cells deep."""
    return create(
        scene(size=[1.0, 0.5], resolution=24, liquid=[box([0.0, 0.0], [1.0, 1.0 / 3.0])], **tables)
    )


def test_the_automatic_correction_acts_only_in_overfull_cells() -> None:
    """Default correction only where particles are too dense.

    A collapsing column needs it. A pool at rest does not and keeps its bits: no solve, no field, no
    filled column.
    """
    quiet, off = pool(), pool(density_correction={"every": 0})
    rows = advance(quiet, 0.6)
    advance(off, 0.6)
    assert {row["density_status"] for row in rows} == {None}
    assert 1.0 < max(row["max_density"] for row in rows) < 1.2
    assert quiet.rearrangement.correction is None
    assert off.rearrangement.density_monitor is None
    assert not any("density" in name for name in (*off.columns(), *off.state(), *quiet.state()))
    for name, array in off.state().items():
        assert np.array_equal(quiet.state()[name], array), name
    crowded = dam()
    rows = advance(crowded, 1.0)
    acted = [row["density_status"] is not None for row in rows]
    assert not any(acted[:3])
    assert sum(acted) > len(acted) // 2
    assert {row["density_status"] for row in rows} <= {None, "CONVERGED", "NOTHING_TO_DO"}
    assert "density_correction" in crowded.state()


def test_the_automatic_correction_is_proportional_to_the_step() -> None:
    """Displacement by default: in proportion to the step.

    A tenth of the step gives a tenth of the way, at most all of it. With a table the scene decides
    when, and a step removes all excess.
    """

    def lift(dt: float, **tables: Any) -> float:
        squeezed = pool(**tables)
        position = squeezed.particles.position.numpy() * np.array([1.0, 0.9, 1.0], dtype=np.float32)
        squeezed.particles.position.assign(position)
        squeezed.particles.sort()
        assert squeezed.step(dt)["density_status"] == "CONVERGED"
        return float(squeezed.particles.totals().center[1] - position[:, 1].mean())

    asked = lift(1e-3, density_correction={})
    assert lift(1e-3) == pytest.approx(10.0 * lift(1e-4), rel=0.05)
    assert 0.0 < lift(1e-3) < 0.1 * asked


@pytest.mark.parametrize("moves", [True, False])
def test_a_step_repeats_the_correction_of_severe_excess_beside_moving_solids(moves: bool) -> None:
    """Excess after a step of a pool of which each particle has 3/4 of its height.

    Its surface must rise by two cells, and a correction moves particles by half a cell at most.
    """
    plate = box([0.4, 0.42], [0.6, 0.46])
    if moves:
        plate["motion"] = {"kind": "translation", "velocity": [0.01, 0.0]}
    squeezed = pool(solid=[plate])
    position = squeezed.particles.position.numpy() * np.array([1.0, 0.75, 1.0], dtype=np.float32)
    squeezed.particles.position.assign(position)
    squeezed.particles.sort()
    squeezed.step(1e-4)
    squeezed.particles.sort()
    monitor = squeezed.rearrangement.density_monitor
    assert monitor is not None
    monitor.measure(None, squeezed.particles, squeezed.window(squeezed.particles.totals()))
    excess, _ = monitor.read_densities()
    assert excess <= SEVERE if moves else excess > 4.0 * SEVERE
    # The center of mass has gone up by nearly all of the way to its place at rest.
    way = float(squeezed.particles.totals().center[1] - position[:, 1].mean())
    assert way < 0.5 * 0.25 / 3.0
    assert (way > 0.8 * 0.5 * 0.25 / 3.0) == moves


def test_a_correction_is_repeated_by_the_density_where_particles_are_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Excess that decides on a repetition, with a moving plate thinner than a cell.

    Particles then stand in a list for each cell. A correction moves them to other cells, and the
    density must not be that of the lists before.
    """
    plate = box([0.4, 0.42], [0.6, 0.435])
    plate["motion"] = {"kind": "translation", "velocity": [0.01, 0.0]}
    squeezed = pool(solid=[plate])
    particles = squeezed.particles
    assert particles.offsets is not None
    position = particles.position.numpy() * np.array([1.0, 0.75, 1.0], dtype=np.float32)
    particles.position.assign(position)
    particles.sort()
    monitor = squeezed.rearrangement.density_monitor
    assert monitor is not None
    measure, pairs = monitor.measure, []

    def measured_twice(density: wp.array | None, particles: Particles, window: Any) -> None:
        measure(density, particles, window)
        if density is None:
            found = monitor.read_densities()
            particles.sort()
            measure(None, particles, window)
            pairs.append((found, monitor.read_densities()))

    monkeypatch.setattr(monitor, "measure", measured_twice)
    squeezed.step(1e-4)
    assert len(pairs) > 2
    for found, expected in pairs:
        assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("table", [{}, {"density_correction": {"every": 0}}])
def test_a_collapsed_column_has_the_volume_that_it_had(table: dict[str, Any]) -> None:
    """Volume of a collapsed column.

    The volume is that of an independent oracle, from particles alone. Without the correction it
    shrinks by a tenth.
    """
    simulation = dam(**table)
    counts = tuple(simulation.grid.counts[:2])

    def volume() -> float:
        return enclosed_cells(
            simulation.particles.position.numpy()[:, :2] / simulation.grid.spacing, counts, 0.25
        )

    before = volume()
    advance(simulation, 2.5)
    late = []
    for _ in range(10):
        simulation.step(min(simulation.stable_dt(), 0.02))
        late.append(volume() / before)
    if table:
        assert np.mean(late) < 0.95
    else:
        assert np.mean(late) == pytest.approx(1.0, abs=0.02)


def test_resuming_across_its_first_step_gives_the_same_bits() -> None:
    """Resumed runs across the first correction: the same bits.

    The state before it has no data of it, the one after has its solution; both continue as the run
    did.
    """
    straight = dam()
    states = []
    while len(states) < 30:
        states.append(straight.state())
        straight.step(min(straight.stable_dt(), 0.02))
    has = ["density_correction" in state for state in states]
    first = has.index(True)
    assert 0 < first < 25
    used = dam()
    # The last one discards the simulation's own default.
    for start in (first - 1, first + 3, first - 2):
        used.restore(states[start])
        for _ in range(start, len(states)):
            used.step(min(used.stable_dt(), 0.02))
        for name, array in straight.state().items():
            assert np.array_equal(used.state()[name], array), name


def void(grid: Any, points: np.ndarray) -> np.ndarray:
    """Return points without a third of those around the middle."""
    near = np.linalg.norm(points[:, :2] - 0.5, axis=1) < 2.0 * grid.spacing
    return points[~(near & (np.arange(len(points)) % 3 == 0))]


@pytest.mark.parametrize("even", [True, False])
def test_voids_inside_close_where_the_material_keeps_its_volume(even: bool) -> None:
    """Voids inside close, with constant volume.

    Their liquid comes from the surface, and nothing is drawn to a separating wall.
    """
    grid, boundary = tank(resolution=16)
    points = lattice(grid, boundary)
    particles = particles_of(grid, void(grid, points[points[:, 1] < 0.9]))
    middle = grid.counts[1] // 2 + 1
    before = density_of(grid, particles.position.numpy())[
        1, middle - 1 : middle + 1, middle - 1 : middle + 1
    ].mean()
    corrected = correction(grid, boundary, even=even)
    for _ in range(6):
        corrected.apply(particles, grid.everywhere)
    after = density_of(grid, particles.position.numpy())[
        1, middle - 1 : middle + 1, middle - 1 : middle + 1
    ].mean()
    assert before < 0.8
    assert after > 0.9 if even else after == pytest.approx(before, abs=0.01)


@pytest.mark.parametrize("walls_separate", [True, False])
def test_liquid_that_separates_from_a_wall_is_not_drawn_back(walls_separate: bool) -> None:
    """Liquid that separates from a wall is not drawn back.

    A gap of 0.3 cells under a ceiling: a holding wall has a void there, a separating one a surface.
    """
    grid, boundary = tank(resolution=16)
    points = lattice(grid, boundary)
    points = points[points[:, 1] > 0.4] - [0.0, 0.3 * grid.spacing, 0.0]
    particles = particles_of(grid, points)
    contact = wp.full(
        grid.shape, RELEASED if walls_separate else HELD, dtype=wp.uint8, device=grid.device
    )
    corrected = correction(grid, boundary, even=True)
    for _ in range(4):
        corrected.apply(particles, grid.everywhere, contact=contact)
    risen = (particles.position.numpy()[:, 1].max() - points[:, 1].max()) / grid.spacing
    assert risen < 0.01 if walls_separate else risen > 0.05


@pytest.mark.parametrize(
    "tables",
    [{"density_correction": {"every": 0}}, {"density_correction": {}, "particles": {"reseed": {}}}],
)
def test_a_scene_without_it_launches_none_of_its_kernels(
    tables: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scene without the correction: no launches of its kernels.

    It does not allocate either: fields are made with the simulation.
    """
    launched, launch, entry, prepared = set(), wp.launch, KernelVariant.entry, program.prepared

    def note(kernel: wp.Kernel, *arguments: Any, **named: Any) -> Any:
        launched.add(kernel.module.name)
        return launch(kernel, *arguments, **named)

    def note_entry(self: KernelVariant, *arguments: Any) -> Any:
        launched.add(self.kernel.module.name)
        return entry(self, *arguments)

    def note_prepared(kernel: wp.Kernel, *arguments: Any) -> Any:
        launched.add(kernel.module.name)
        return prepared(kernel, *arguments)

    monkeypatch.setattr(wp, "launch", note)
    monkeypatch.setattr(KernelVariant, "entry", note_entry)
    monkeypatch.setattr(program, "prepared", note_prepared)
    simulation = dam(**tables)
    advance(simulation, 0.2)
    own_launches = {
        name
        for name in launched
        if name.startswith(("warp_lcp.material.density_correction", "warp_lcp.material.reseeding"))
    }
    assert any(name.startswith("warp_lcp.grid.density") for name in launched)
    assert own_launches == (
        {"warp_lcp.material.density_correction", "warp_lcp.material.reseeding"}
        if "particles" in tables
        else set()
    )


def test_every_third_step() -> None:
    simulation = dam(density_correction={"every": 3})
    rows = advance(simulation, 0.3)
    assert [row["max_density"] is not None for row in rows] == [
        step % 3 == 0 for step in range(len(rows))
    ]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "tables", [{}, {"solid": [box([0.5, 0.0], [0.7, 0.11], rotate=20)]}, {"dimension": 3}]
)
def test_a_liquid_that_has_splashed_keeps_its_density(tables: dict[str, Any]) -> None:
    """Density of liquid after a splash.

    Without the correction cells at the floor fill up beyond 1.5.
    """
    plain, corrected = (
        dam(density_correction={"every": 0}, **tables),
        dam(density_correction={}, **tables),
    )
    largest = []
    for simulation in (plain, corrected):
        advance(simulation, 1.0)
        density = wp.zeros_like(simulation.surface.phi)
        wp.copy(density, simulation.surface.level_set.density)
        largest.append(
            float(
                (density.numpy() - simulation.boundary.capacity.numpy())[
                    simulation.boundary.base.numpy() != wl.SOLID
                ].max()
            )
        )
    assert largest[1] < 0.8 * largest[0]
