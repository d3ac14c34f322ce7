"""Sources and drains: amount, place and time of inflow and outflow."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from default_run import covering, slow
from small_liquids import advance, box, create, scene
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.material.sources import Sources, lattice_shear
from warp_lcp.operators.grid_poisson import FLUID, SOLID
from warp_lcp.run.stepping import take_step
from warp_lcp.simulation import SimulationFailed

TAP = box([0.0, 0.5], [0.125, 0.625], velocity=[1.0, 0.0])
BALL = {"shape": "sphere", "center": [0.8, 0.1], "radius": 0.1}


def tap(source: list[dict[str, Any]] | None = None, **tables: Any) -> LiquidSimulation:
    """Return a basin with a source."""
    return create(
        scene(
            size=[1.0, 1.0],
            resolution=32,
            liquid=tables.pop("liquid", []),
            source=source or [TAP],
            **tables,
        )
    )


def to_frame(simulation: LiquidSimulation, end: float) -> list[dict[str, Any]]:
    """Step to a time as a run does, and return the rows of the log."""
    rows = []
    while simulation.time < end - 1e-9:
        dt, _, row = take_step(simulation, simulation.stable_dt(), end, simulation.scene.time)
        rows.append({"dt": dt, **row})
    return rows


def emitted(rows: list[dict[str, Any]]) -> int:
    """Return the number of emitted particles."""
    return sum(row["emitted"] for row in rows)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("surface", ["ghost-fluid", "voxel"])
@pytest.mark.parametrize("solids", ["cut-cell", "voxel"])
def test_the_rate_is_area_times_velocity(solids: str, surface: str) -> None:
    """Rate of a source: area times velocity.

    No splash is near: it would be corrected, and the positions of the particles with it.
    """
    simulation = tap(
        solids=solids, solid=[BALL], pressure={"surface": surface}, density_correction={"every": 0}
    )
    start = simulation.particles.count
    assert start == 4 * 4 * 4  # the source itself is full
    rows = advance(simulation, 1.0)
    expected = 0.125 * 1.0 * 1.0 * 32**2 * 4
    assert emitted(rows) == pytest.approx(expected, rel=0.02)
    assert simulation.particles.count == start + emitted(rows)
    mass = simulation.particle_mass * simulation.particles.count
    assert rows[-1]["mass"] == pytest.approx(mass)
    x = simulation.particles.position.numpy()
    inside = (x[:, 0] < 0.125) & (x[:, 1] > 0.5) & (x[:, 1] < 0.625)
    assert inside.sum() == pytest.approx(start, rel=0.2)  # the seeding density stays
    np.testing.assert_allclose(
        simulation.particles.velocity.numpy()[inside & (x[:, 0] < 0.09)],
        [[1.0, 0.0, 0.0]] * (inside & (x[:, 0] < 0.09)).sum(),
        atol=0.05,
    )


def test_the_rate_in_three_dimensions() -> None:
    source = box([0.0, 0.25, 0.125], [0.125, 0.375, 0.25], velocity=[2.0, 0.0, 0.0])
    simulation = create(scene(size=[0.5, 0.5, 0.375], resolution=16, liquid=[], source=[source]))
    rows = advance(simulation, 0.2)
    assert emitted(rows) == pytest.approx(0.125**2 * 2.0 * 0.2 * 32**3 * 8, rel=0.02)
    kind = simulation.projection.kind.numpy()
    expected = np.zeros((12, 16, 16), dtype=bool)
    expected[4:8, 8:12, :4] = True
    # No pressure where velocities are given.
    np.testing.assert_array_equal(simulation.grid.interior(kind) == SOLID, expected)
    assert simulation.projection.counted() == (kind == FLUID).sum() > 0


@pytest.mark.parametrize("velocity", [[-1.0, 0.0], [0.0, 2.0], [0.7, -0.7]])
def test_any_direction_in_free_fall(velocity: list[float]) -> None:
    source = box([0.4375, 0.4375], [0.5625, 0.5625], velocity=velocity)
    rows = advance(tap([source], physics={"gravity": [0.0, 0.0]}), 0.15, 0.005)
    across = 0.125 * np.abs(velocity).sum()  # of the square's shadow, times the speed
    # Tolerance in particles: the places in the lattice where the way begins and ends.
    row = across / np.linalg.norm(velocity) * 32 * 2
    assert emitted(rows) == pytest.approx(across * 0.15 * 32**2 * 4, abs=0.5 * row)


def pour(
    draw: np.random.Generator, source: dict[str, Any], longest: float, stop: float
) -> LiquidSimulation:
    """Run a source in free fall, in random steps, until `stop`.

    The steps do not depend on the times of the source.
    """
    simulation = tap([source], physics={"gravity": [0.0, 0.0]}, particles={"seed": 20261})
    while simulation.time < stop:
        row = simulation.step(min(longest * draw.uniform(0.02, 1.0), stop - simulation.time))
    assert row["particles"] == simulation.particles.count
    return simulation


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("cells", [0.25, slow(1.0), 3.0])
# One cell thick, and four.
@pytest.mark.parametrize(
    ("low", "high"), [([0.25, 0.5], [0.28125, 0.625]), ([0.125, 0.5], [0.25, 0.59375])]
)
def test_inflow_is_exact_for_any_sequence_of_steps(
    low: list[float], high: list[float], cells: float
) -> None:
    """Exact inflow, whatever the time steps.

    Every place of the lattice that has passed the source is emitted once: area times velocity times
    time, to the particle.
    """
    draw = np.random.default_rng(int(1000 * cells))
    distance, speed = 1.0 / 64, 2.0
    start, rows = draw.uniform(0.0, 0.02), int(draw.integers(12, 20))
    source = box(
        low, high, velocity=[speed, 0.0], start=start, stop=start + rows * distance / speed
    )
    simulation = pour(draw, source, cells / 32 / speed, source["stop"] + 0.5 * cells / 32 / speed)
    places = simulation.particles.position.numpy()[:, :2] - [speed * (simulation.time - start), 0.0]
    emitted_places = np.floor(places / distance).astype(int)
    (left, bottom), (right, top) = np.round(np.array([low, high]) / distance).astype(int)
    expected = {(x, y) for x in range(left - rows, right) for y in range(bottom, top)}
    assert len(emitted_places) == len(expected)
    assert set(map(tuple, emitted_places.tolist())) == expected
    # A jet flies on.
    np.testing.assert_allclose(
        simulation.particles.velocity.numpy(), [[speed, 0.0, 0.0]] * len(emitted_places), atol=1e-4
    )


def test_oblique_inflow_does_not_depend_on_the_steps() -> None:
    source = box([0.3125, 0.3125], [0.4375, 0.375], velocity=[1.2, 0.7], start=0.013, stop=0.157)
    counts = {
        pour(np.random.default_rng(seed), source, longest, 0.17).particles.count
        for seed, longest in ((7, 0.008), (8, 0.02), (9, 0.06))
    }
    assert len(counts) == 1
    area = 0.125 * 0.7 + 0.0625 * 1.2
    row = area / np.hypot(1.2, 0.7) * 64
    assert counts.pop() == pytest.approx(8 * 4 + area * 0.144 * 64**2, abs=row)


@pytest.mark.parametrize("velocity", [[0.0, -2.0, 0.0], [1.3, 0.4, 0.0], [-0.6, 0.5, 0.7]])
@pytest.mark.parametrize("dimension", [2, 3])
def test_columns_of_a_source_pass_a_plane_across_the_flow_at_even_times(
    dimension: int, velocity: list[float]
) -> None:
    v = np.array(velocity) * (np.arange(3) < dimension)
    along, shear = lattice_shear(v, dimension)
    assert shear[along] == 0.0
    columns = np.stack(np.meshgrid(*[np.arange(7.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    columns = columns[(columns[:, along] == 0) & (columns[:, dimension:] == 0).all(axis=1)]
    points = columns + np.outer(columns @ shear, np.eye(3)[along])
    times = np.sort((points @ v / v[along]) % 1.0)
    gaps = np.diff(np.append(times, times[0] + 1.0)) * len(columns)
    assert len(columns) == 7 ** (dimension - 1)
    # Random times have a largest gap of about log n, 2 and 4.
    assert gaps.max() < (2.0 if dimension == 2 else 2.7)
    assert gaps.min() > (0.6 if dimension == 2 else 0.1)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("seed", [3, 4, slow(5), slow(6)])
def test_a_falling_jet_has_no_layers_across_the_flow(seed: int) -> None:
    """Jets of random speed, width, angle and Courant number, stretched by gravity.

    A particle's time since it left the source tells the density along the jet, whatever its
    stretch. In layers a distance d apart these times would be d / v apart, and |sum exp(2 pi i t v
    / d)|^2 / n as large as n; random times have 1.
    """
    draw = np.random.default_rng([20261130, seed])
    cells = int(draw.choice([48, 64, 96]))
    width, thick = int(draw.integers(2, 7)), int(draw.integers(1, 4))
    speed, angle = draw.uniform(0.5, 2.0), draw.uniform(-0.8, 0.8) * (seed % 2)
    dx, across, down = 1.0 / cells, speed * np.sin(angle), speed * np.cos(angle)
    corner = np.round(np.array([0.5, 0.9]) * cells) * dx
    far = corner + np.array([width, thick]) * dx
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=cells,
            liquid=[],
            source=[box(corner.tolist(), far.tolist(), velocity=[across, -down])],
            cfl=float(draw.choice([0.5, 1.0, 2.0, 4.0])),
            particles={"seed": seed},
        )
    )

    def fall(way: np.ndarray) -> np.ndarray:
        return 2.0 * way / (down + np.sqrt(down**2 + 2.0 * 9.81 * way))

    end, start = float(fall(np.array(0.85))), simulation.particles.count
    rows = to_frame(simulation, end)
    assert emitted(rows) == simulation.particles.count - start
    flow = (down * width + abs(across) * thick) * end * 4.0 / dx
    # An oblique box cuts columns at its sides, which is random to about 3 particles.
    assert emitted(rows) == pytest.approx(flow, rel=0.01, abs=1.0 if angle == 0.0 else 9.0)
    way = corner[1] - simulation.particles.position.numpy()[:, 1]
    times = fall(np.maximum(way, 0.0))
    distance = 0.5 * dx / down
    # Away from the ends: the front falls as one piece.
    times = times[(way > 2.0 * dx) & (times < end - 6.0 * thick * distance - 0.02)]
    assert len(times) > 40
    assert np.diff(np.sort(times)).max() < distance
    layers = np.abs(np.exp(2j * np.pi * times / distance).sum()) ** 2 / len(times)
    assert layers < 0.2 * len(times)


def mixed(word: np.ndarray) -> np.ndarray:
    """Return the finalizer of SplitMix64 of 64-bit words."""
    word = word + np.uint64(0x9E3779B97F4A7C15)
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))


def lattice_points(
    sources: Sources, number: int, low: np.ndarray, counts: np.ndarray
) -> np.ndarray:
    """Return jittered points of a source's lattice before it moves [m].

    They are in the order x fastest, with shape (n, 3).
    """
    k, j, i = np.meshgrid(*(np.arange(n) for n in counts[::-1]), indexing="ij")
    lattice = np.stack([i.ravel(), j.ravel(), k.ravel()], axis=1) + low
    with np.errstate(over="ignore"):
        state = np.full(
            len(lattice),
            ((sources.random_seed + number) * 0x9E3779B97F4A7C15 + 1) % 2**64,
            dtype=np.uint64,
        )
        for word in lattice.astype(np.int64).astype(np.uint64).T:
            state = mixed(state ^ word)
        drawn = [
            mixed(state + np.uint64((axis + 1) * 0x9E3779B97F4A7C15 % 2**64)) for axis in range(3)
        ]
    displaced = sources.jitter * (np.stack(drawn, axis=1).astype(np.float64) / 2.0**64 - 0.5)
    along, shear = lattice_shear(sources.sources[number].velocity, sources.grid.dimension)
    displaced[:, along] = (lattice @ shear) % 1.0 - 0.5
    return (lattice + 0.5 + displaced) * (sources.grid.spacing / sources.per_axis)


@pytest.mark.parametrize("seed", range(6))
def test_points_enter_cells_as_a_fine_look_along_their_way_tells(seed: int) -> None:
    """Cells that points enter, against dense samples of their way.

    The kernel's cells at both ends and its numbers of entries are those of 4000 positions along
    each point's way.
    """
    draw = np.random.default_rng([20261129, seed])
    dimension = 2 + seed % 2
    low = draw.integers(2, 6, dimension) / 16
    high = low + draw.integers(1, 4, dimension) / 16
    way = draw.normal(size=dimension)
    velocity = np.append(way / np.abs(way).max(), np.zeros(3 - dimension))
    source = box(list(low), list(high), velocity=velocity[:dimension].tolist())
    simulation = create(
        scene(
            size=[1.0] * dimension,
            resolution=16,
            liquid=[],
            source=[source],
            particles={"seed": seed},
        )
    )
    sources, since = simulation.sources, draw.uniform(0.0, 3.0)
    now = since + draw.uniform(0.01, 0.2)
    sources._entered(0, since, now, starts=False)
    count = int(sources._lattice.count.value)
    entries, slot, filled, points = (array[:count] for array in sources._found)
    span = sources._span.host
    first, sizes = span[9:12], np.append(span[12:14], count / span[12:14].prod()).astype(int)
    at_rest = lattice_points(sources, 0, first, sizes)

    def cells(time: float) -> np.ndarray:
        x = (at_rest + velocity * time) / sources.grid.spacing
        cell = np.clip(np.floor(x[:, ::-1]).astype(int) + 1, 0, np.array(sources.grid.shape) - 1)
        if dimension == 2:
            cell[:, 0] = 1
        return sources._slots[tuple(cell.T)]

    np.testing.assert_array_equal(filled, cells(since))
    looks = np.array([cells(time) for time in np.linspace(since, now, 4001)]) > 0
    came = (looks[1:] & ~looks[:-1]).sum(axis=0)
    assert (entries != came).mean() < 2e-3  # except those that graze a corner between two samples
    assert entries.sum() > 0
    last = cells(now)
    stays = (entries == 1) & (last > 0) & (came == 1)
    assert (slot[stays] > 0).all()
    inside = points[stays][:, :dimension]
    np.testing.assert_allclose(
        inside, (at_rest + velocity * now)[stays][:, :dimension], rtol=0, atol=1e-6
    )


@pytest.mark.parametrize(
    ("ends", "acts"),
    [((0.1, 0.11), True), ((0.09, 0.1), True), ((0.1004, 0.1008), True), ((0.05, 0.1), False)],
)
def test_a_drain_acts_when_it_has_been_open_in_a_part_of_a_step(
    ends: tuple[float, float], acts: bool
) -> None:
    drain = {**box([0.0, 0.0], [0.25, 0.125]), "start": ends[0], "stop": ends[1]}
    simulation = create(
        scene(size=[1.0, 1.0], resolution=16, liquid=[box([0.0, 0.0], [1.0, 0.25])], drain=[drain])
    )
    simulation.time = 0.095 if ends[0] < 0.1 and acts else 0.1
    assert (simulation.step(0.01)["drained"] > 0) == acts


def test_a_source_in_a_pool_pushes_its_volume_in_and_draws_nothing_from_behind() -> None:
    # If the source's upstream faces were open to the pool, its liquid would circulate and the pool
    # would not rise.
    source = box([0.4375, 0.1875], [0.5625, 0.25], velocity=[0.0, 0.25])
    simulation = tap([source], liquid=[box([0.0, 0.0], [1.0, 0.5])], density_correction={})
    rows = advance(simulation, 1.0)
    assert emitted(rows) == pytest.approx(0.125 * 0.25 * 32**2 * 4, rel=0.1)
    assert rows[-1]["volume"] - rows[0]["volume"] == pytest.approx(0.125 * 0.25, rel=0.35)


def test_a_source_runs_between_its_times_only() -> None:
    simulation = tap([{**TAP, "start": 0.1, "stop": 0.3}], liquid=[box([0.0, 0.0], [1.0, 0.1])])
    start = simulation.particles.count
    rows = [row for end in (0.2, 0.4, 0.5) for row in to_frame(simulation, end)]
    times = np.cumsum([row["dt"] for row in rows])
    came = np.array([row["emitted"] for row in rows])
    assert not came[times < 0.1 - 1e-6].any()
    assert not came[times > 0.3 + 1e-6].any()
    assert np.isclose(times[:, None], [0.1, 0.3], atol=1e-6).any(axis=0).all()  # steps end there
    expected = 64 + 0.125 * 1.0 * 0.2 * 32**2 * 4
    assert came.sum() == simulation.particles.count - start == pytest.approx(expected, rel=0.02)


def test_cells_that_are_full_already_are_not_filled() -> None:
    assert tap(liquid=[box([0.0, 0.0], [1.0, 0.75])]).particles.count == 4 * 32 * 24


@pytest.mark.parametrize(("present", "comes"), [(1, 4), (2, 0), (3, 0)])
def test_cells_less_than_half_full_are_filled(present: int, comes: int) -> None:
    source = box([0.5, 0.5], [0.53125, 0.53125], velocity=[1.0, 0.0], start=0.01)
    simulation = tap([source], physics={"gravity": [0.0, 0.0]})
    simulation.particles.append(
        np.full((present, 3), [0.51, 0.51, 0.0], np.float32), np.zeros((present, 3), np.float32)
    )
    assert simulation.step(0.011)["emitted"] == comes


def test_a_box_that_is_full_ends_the_run_with_a_reason() -> None:
    simulation = tap(liquid=[box([0.0, 0.0], [1.0, 1.0])])
    with pytest.raises(SimulationFailed, match="or sources"):
        simulation.step(0.01)


def test_a_drain_takes_what_is_in_it() -> None:
    drain = box([0.0, 0.0], [0.25, 0.125])
    simulation = create(
        scene(
            size=[1.0, 1.0],
            resolution=32,
            liquid=[box([0.0, 0.0], [1.0, 0.25])],
            drain=[{**drain, "start": 0.1, "stop": 0.4}],
        )
    )
    start = simulation.particles.count
    rows = advance(simulation, 0.6)
    times = np.cumsum([row["dt"] for row in rows])
    gone = np.array([row["drained"] for row in rows])
    assert not gone[times < 0.1 - 1e-6].any()
    assert not gone[times > 0.4 + rows[-1]["dt"]].any()
    assert gone.sum() == start - simulation.particles.count == start - rows[-1]["particles"]
    assert gone[times < 0.1 + 1e-6].sum() == pytest.approx(4 * 8 * 4, rel=0.2)
    assert gone.sum() > 1.5 * 4 * 8 * 4  # the rest flows in
    assert "emitted" not in simulation.columns()


@pytest.mark.parametrize(
    ("tables", "particles"),
    covering(
        [{}, {"solid": [BALL]}, {"pressure": {"model": "unilateral"}}], [{}, {"transfer": "flip"}]
    ),
)
def test_an_interrupted_run_goes_on_bit_for_bit(
    tables: dict[str, Any], particles: dict[str, Any]
) -> None:
    drain = [box([0.5, 0.0], [0.625, 0.125])]
    through, resumed = (tap(particles=particles, drain=drain, **tables) for _ in range(2))
    advance(through, 0.4)
    saved = through.state()
    assert len(saved["position"]) != resumed.particles.count
    resumed.restore(saved)
    for _ in range(12):
        dt = through.stable_dt()
        assert resumed.stable_dt() == dt
        assert through.step(dt) == resumed.step(dt)
    a, b = through.state(), resumed.state()
    assert all(np.array_equal(a[name], b[name]) for name in a)


def test_arrays_of_different_lengths_are_refused() -> None:
    simulation = tap()
    state = simulation.state()
    with pytest.raises(ValueError, match="velocity"):
        simulation.restore({**state, "position": state["position"][:-1]})


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"source": [box([0.0, 0.0], [0.1, 0.1], velocity=[0.0, 0.0])]}, "nothing would come out"),
        ({"source": [box([0.0, 0.0], [0.1, 0.1], velocity=[1.0, 0.0, 0.0])]}, "2 entries"),
        ({"source": [box([0.0, 0.0], [0.1, 0.1])]}, "required"),
        ({"source": [{**TAP, "start": 1.0, "stop": 0.5}]}, "later than start = 1"),
        ({"source": [box([2.0, 0.0], [3.0, 0.1], velocity=[1.0, 0.0])]}, "outside the domain"),
        ({"drain": [{**box([0.0, 0.0], [0.1, 0.1]), "velocity": [1.0, 0.0]}]}, "not permitted"),
        ({"liquid": []}, r"no \[\[source\]\] either"),
    ],
)
def test_invalid_sources_are_refused(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        scene(
            size=[1.0, 1.0],
            resolution=32,
            liquid=tables.pop("liquid", [box([0.0, 0.0], [0.5, 0.5])]),
            **tables,
        )


def test_a_source_without_a_cell_is_refused() -> None:
    with pytest.raises(ValueError, match=r"source\[0\] \(box\) holds no open cell's center"):
        tap([box([0.0, 0.5], [0.01, 0.51], velocity=[1.0, 0.0])])


def test_capsules_have_ends_and_times() -> None:
    capsule = {
        "shape": "capsule",
        "from": [0.2, 0.5],
        "to": [0.4, 0.5],
        "radius": 0.1,
        "velocity": [0.0, 1.0],
        "start": 0.5,
    }
    model = scene(size=[1.0, 1.0], resolution=32, liquid=[], source=[capsule])
    assert (model.source[0].start, model.source[0].end, model.source[0].begin) == (
        [0.2, 0.5],
        [0.4, 0.5],
        0.5,
    )
    assert create(model).particles.count == 0
