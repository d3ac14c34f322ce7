import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_lcp as wl
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.particle_seeding import lattice, seed
from warp_lcp.grid.particles import SORT_EVERY, Particles, _rows_of_sort
from warp_lcp.grid.radix_sort import sort_keys
from warp_lcp.grid.staggered import StaggeredGrid

FLAT = StaggeredGrid((7, 5, 1), 0.2, 2)
SOLID = StaggeredGrid((7, 5, 4), 0.2, 3)


def random_particles(
    grid: StaggeredGrid, n: int, random_seed: int, *, affine: bool = True
) -> Particles:
    rng = np.random.default_rng(random_seed)
    position = rng.random((n, 3)) * np.array(grid.counts) * grid.spacing
    position[:, grid.dimension :] = 0.0
    particles = Particles(grid, position, rng.normal(size=(n, 3)), affine=affine)
    for gradient in particles.affine:
        gradient.assign(rng.normal(size=(n, 3)).astype(np.float32))
    return particles


@pytest.mark.parametrize("grid", [FLAT, SOLID], ids=["2d", "3d"])
@settings(max_examples=20, deadline=None)
@given(n=st.integers(1, 3000), random_seed=st.integers(0, 10**6))
def test_sort_orders_by_cell_and_keeps_particles_whole(
    grid: StaggeredGrid, n: int, random_seed: int
) -> None:
    particles = random_particles(grid, n, random_seed)
    before = {name: array.numpy().copy() for name, array in particles.arrays().items()}
    particles.sort()
    cells = particles.cells_of(before["position"])
    key = (
        ((cells[:, 2] + 1) * (grid.counts[1] + 2) + cells[:, 1] + 1) * (grid.counts[0] + 2)
        + cells[:, 0]
        + 1
    )
    order = np.argsort(key, kind="stable")
    assert (particles.key.numpy()[:n] == key[order]).all()
    assert set(before) == {"position", "velocity"} | {f"affine_{c}" for c in range(grid.dimension)}
    for name, array in particles.arrays().items():
        assert (array.numpy() == before[name][order]).all()


@pytest.mark.parametrize(
    ("count", "bits"), [(1, 4), (50, 1), (999, 9), (3000, 18), (1000, 22), (1000, 23), (500, 31)]
)
def test_keys_are_sorted_as_numpy_sorts_them(
    count: int, bits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sorted keys against NumPy.

    In parts of 100 keys, on any number of threads; memory beyond the keys is scratch.
    """
    monkeypatch.setattr("warp_lcp.grid.particles.CPU_GRAIN", 100)
    monkeypatch.setattr("warp_lcp.kernels.thread_pool.CELLS", 1)
    rng, before = np.random.default_rng([count, bits]), wl.get_threads()
    keys = np.where(rng.random(count) < 0.1, 2**bits - 1, rng.integers(0, 2**bits, count))
    expected = np.argsort(keys, kind="stable")
    try:
        for threads in (1, 2, 3, 7):
            wl.set_threads(threads)
            key = wp.array(np.append(keys, rng.integers(0, 9, count)), dtype=wp.int32, device="cpu")
            order = wp.full(2 * count, -7, dtype=wp.int32, device="cpu")
            rows, counts = (
                _rows_of_sort(count, key.device),
                wp.zeros(32 * (2048 + 16), dtype=wp.int32, device="cpu"),
            )
            sort_keys(
                (key[:count], key[count:]),
                (order[:count], order[count:]),
                counts,
                rows,
                rows.places,
                bits,
            )
            np.testing.assert_array_equal(order.numpy()[:count], expected)
            np.testing.assert_array_equal(key.numpy()[:count], keys[expected])
    finally:
        wl.set_threads(before)


def test_sorting_twice_changes_nothing() -> None:
    particles = random_particles(SOLID, 2000, 77)
    particles.sort()
    once = {name: array.numpy().copy() for name, array in particles.arrays().items()}
    particles.sort()
    for name, array in particles.arrays().items():
        assert (array.numpy() == once[name]).all()


def keys(particles: Particles) -> np.ndarray:
    return particles.key.numpy()[: particles.count].copy()


@pytest.mark.parametrize("grid", [FLAT, SOLID], ids=["2d", "3d"])
def test_numbers_are_the_cells_whatever_the_order(grid: StaggeredGrid) -> None:
    particles = random_particles(grid, 3000, 27)
    before = particles.position.numpy().copy()
    particles.number()
    cells = particles.cells_of(before)
    assert (
        keys(particles)
        == ((cells[:, 2] + 1) * (grid.counts[1] + 2) + cells[:, 1] + 1) * (grid.counts[0] + 2)
        + cells[:, 0]
        + 1
    ).all()
    assert (particles.position.numpy() == before).all()


def test_the_order_is_restored_every_few_steps_or_in_each() -> None:
    for indexed in (False, True):
        particles = random_particles(SOLID, 500, 41)
        particles = Particles(
            SOLID,
            particles.position.numpy(),
            particles.velocity.numpy(),
            affine=False,
            indexed=indexed,
        )
        for step in range(2 * SORT_EVERY + 1):
            particles.position.assign(
                np.random.default_rng(step).permutation(particles.position.numpy())
            )
            particles.arrange(step)
            in_order = (np.diff(keys(particles)) >= 0).all()
            assert in_order == (indexed or step % SORT_EVERY == 0)


@pytest.mark.parametrize("grid", [FLAT, SOLID], ids=["2d", "3d"])
def test_offsets_tell_where_the_particles_of_a_cell_begin(grid: StaggeredGrid) -> None:
    position = np.random.default_rng(99).random((60, 3)) * np.array(grid.counts) * grid.spacing
    particles = Particles(grid, position, np.zeros((60, 3)), affine=False, indexed=True)
    particles.sort()
    counts = np.bincount(keys(particles), minlength=grid.size)
    assert (particles.offsets.numpy() == np.concatenate([[0], np.cumsum(counts)])).all()


def test_appended_particles_come_behind_and_storage_grows_geometrically() -> None:
    rng = np.random.default_rng(3001)
    particles = random_particles(SOLID, 100, 12)
    rest = {name: array.numpy().copy() for name, array in particles.arrays().items()}
    capacities = [particles.capacity]
    for _ in range(200):
        more = rng.random((7, 3)).astype(np.float32)
        particles.append(more, -more)
        rest = {
            n: np.concatenate([a, {"position": more, "velocity": -more}.get(n, np.zeros((7, 3)))])
            for n, a in rest.items()
        }
        capacities.append(particles.capacity)
    assert particles.count == 1500
    for name, array in particles.arrays().items():
        assert array.shape == (1500,)
        assert (array.numpy() == rest[name]).all()
    grown = np.unique(capacities)
    assert len(grown) < 10
    assert (grown[1:] >= 1.5 * grown[:-1] - 1).all()
    particles.sort()
    particles.append(np.ones((1, 3)), np.ones((1, 3)))
    particles.append(np.ones((0, 3)), np.ones((0, 3)))
    assert particles.totals().count == 1501
    assert all((gradient.numpy()[-1] == 0.0).all() for gradient in particles.affine)
    with pytest.raises(ValueError, match="velocity"):
        particles.append(np.ones((1, 3)), np.ones((2, 3)))


def test_totals_are_the_sums_and_repeatable() -> None:
    particles = random_particles(SOLID, 5000, 901, affine=False)
    x, v = (
        particles.position.numpy().astype(np.float64),
        particles.velocity.numpy().astype(np.float64),
    )
    totals = particles.totals()
    assert totals.mean_square_speed == pytest.approx((v**2).sum(axis=1).mean(), rel=1e-6)
    assert totals.center == pytest.approx(x.mean(axis=0), rel=1e-6)
    assert totals.low == pytest.approx(x.min(axis=0))
    assert totals.high == pytest.approx(x.max(axis=0))
    assert totals.max_speed == pytest.approx(np.linalg.norm(v, axis=1).max(), rel=1e-6)
    assert totals.finite
    again = particles.totals()
    assert again.mean_square_speed == totals.mean_square_speed
    assert (again.center == totals.center).all()


def test_values_that_are_not_finite_are_counted() -> None:
    particles = random_particles(FLAT, 700, 15)
    x, v = particles.position.numpy().copy(), particles.velocity.numpy().copy()
    x[[3, 400], 1] = np.nan, np.inf
    v[[5, 6, 690], 0] = np.nan, np.inf, -np.inf
    particles.position.assign(x)
    particles.velocity.assign(v)
    totals = particles.totals()
    assert (totals.bad_positions, totals.bad_velocities) == (2, 3)
    assert not totals.finite


def test_values_as_large_as_can_be_are_finite() -> None:
    particles = random_particles(FLAT, 40, 16)
    x = particles.position.numpy().copy()
    x[7] = 3e38, -3e38, 3e38
    particles.position.assign(x)
    assert particles.totals().finite
    assert particles.totals().high[0] == pytest.approx(3e38)


@pytest.mark.parametrize("keep", [0.0, 0.3, 1.0])
def test_removing_keeps_the_others_in_order_and_in_place(keep: float) -> None:
    particles = random_particles(FLAT, 500, 31)
    position, velocity = particles.position.numpy().copy(), particles.velocity.numpy().copy()
    gone = np.random.default_rng(12).random(500) >= keep
    storage, memory = (
        particles.capacity,
        {
            particles.key.ptr,
            *(a.ptr for a in particles.arrays().values()),
            particles._spare.store.ptr,
        },
    )
    marks = particles.marks
    marks.assign(gone.astype(np.int32))
    assert particles.remove(marks) == gone.sum()
    assert particles.count == len(particles.position) == (~gone).sum()
    np.testing.assert_array_equal(particles.position.numpy(), position[~gone])
    np.testing.assert_array_equal(particles.velocity.numpy(), velocity[~gone])
    assert particles.capacity == storage
    assert {
        particles.key.ptr,
        *(a.ptr for a in particles.arrays().values()),
        particles._spare.store.ptr,
    } == memory
    particles.arrange(0)
    assert particles.totals().count == (~gone).sum()
    particles.append(position[:3], velocity[:3])
    np.testing.assert_array_equal(particles.position.numpy()[-3:], position[:3])


@pytest.mark.parametrize("seed", range(3))
def test_removed_particles_are_counted_by_their_marks(seed: int) -> None:
    draw = np.random.default_rng([99, seed])
    particles = random_particles(FLAT, 300, seed)
    for _ in range(3):
        marks, position = (
            draw.choice([0, 0, 0, 1, 2, 7], particles.count),
            particles.position.numpy().copy(),
        )
        particles.marks.assign(marks.astype(np.int32))
        particles.launch_removal(particles.marks)
        assert particles.finish_removal(particles.marks) == ((marks == 1).sum(), (marks > 1).sum())
        np.testing.assert_array_equal(particles.position.numpy(), position[marks == 0])


def test_there_may_be_no_particles() -> None:
    particles = Particles(FLAT, np.zeros((0, 3)), np.zeros((0, 3)), affine=True, indexed=True)
    particles.arrange(0)
    assert particles.remove(particles.marks) == 0
    totals = particles.totals()
    assert totals.finite
    assert (totals.count, totals.max_speed) == (0, 0.0)
    particles.append(np.full((2, 3), 0.1), np.ones((2, 3)))
    particles.arrange(1)
    assert particles.totals().count == 2


def test_mismatched_particles_are_refused() -> None:
    with pytest.raises(ValueError, match="velocity"):
        Particles(FLAT, np.zeros((2, 3)), np.zeros((2, 2)), affine=True)
    with pytest.raises(ValueError, match="position"):
        Particles(FLAT, np.zeros(3), np.zeros(3), affine=True)


@pytest.mark.parametrize("grid", [FLAT, SOLID], ids=["2d", "3d"])
@pytest.mark.parametrize("per_axis", [1, 2, 3])
def test_the_lattice_fills_every_cell_alike(grid: StaggeredGrid, per_axis: int) -> None:
    points = lattice(grid, per_axis, 0.25, 6, 0)
    ideal = lattice(grid, per_axis, 0.0, 6, 0)
    spacing = grid.spacing / per_axis
    counts = np.zeros(grid.counts[:2], int)
    cells = (points / grid.spacing).astype(int)
    np.add.at(counts, (cells[:, 0], cells[:, 1]), 1)
    assert (counts == per_axis**grid.dimension).all()
    assert np.abs(points - ideal).max() <= 0.125 * spacing
    assert np.abs(points - ideal)[:, : grid.dimension].max(axis=0).min() > 0.1 * spacing
    if grid.dimension == 2:
        assert (points[:, 2] == 0.0).all()


@pytest.mark.parametrize("grid", [FLAT, SOLID], ids=["2d", "3d"])
def test_seeds_stay_out_of_solids_and_are_not_doubled(grid: StaggeredGrid) -> None:
    nx, ny, nz = grid.counts
    open_cells = np.random.default_rng(31).random((nz, ny, nx)) < 0.7
    regions = [lambda p: p[:, 0] < 0.7, lambda p: p[:, 0] < 1.0]
    position, owner = seed(grid, regions, open_cells, per_axis=2, jitter=0.25, random_seed=8)
    cells = (position / grid.spacing).astype(int)
    assert open_cells[cells[:, 2], cells[:, 1], cells[:, 0]].all()
    assert (owner == (position[:, 0] >= 0.7)).all()
    assert len(position) == np.unique(position, axis=0).shape[0]
    assert open_cells[:, :, :5].sum() * 2**grid.dimension == len(position)
    again, _ = seed(grid, regions, open_cells, per_axis=2, jitter=0.25, random_seed=8)
    other, _ = seed(grid, regions, open_cells, per_axis=2, jitter=0.25, random_seed=9)
    assert (again == position).all()
    assert not np.array_equal(other, position)


def test_the_widest_jitter_leaves_no_particle_on_the_edge() -> None:
    position, _ = seed(
        FLAT,
        [lambda p: p[:, 0] >= 0],
        np.ones((1, 5, 7), bool),
        per_axis=4,
        jitter=1.0,
        random_seed=5,
    )
    size = np.array(FLAT.counts) * FLAT.spacing
    assert position[:, :2].min() > 0.5 * MARGIN * FLAT.spacing
    assert (position[:, :2].max(axis=0) < size[:2] - 0.5 * MARGIN * FLAT.spacing).all()


def test_bad_seeding_is_refused() -> None:
    open_cells = np.ones((1, 5, 7), bool)
    with pytest.raises(ValueError, match="jitter"):
        seed(FLAT, [], open_cells, per_axis=2, jitter=1.5, random_seed=3)
    with pytest.raises(ValueError, match="per_axis"):
        seed(FLAT, [], open_cells, per_axis=0, jitter=0.5, random_seed=3)
