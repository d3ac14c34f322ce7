"""Ids and ages of particles: unique and lasting, at no cost without `output.ids`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import small_sands
from particle_tracks import TrackCheck
from small_liquids import box, create, dam, scene
from warp_lcp.grid import particle_ids
from warp_lcp.grid.particle_ids import NO_ID, ParticleIds, pack_ids, unpack_ids
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material import domain_window
from warp_lcp.material.particle_pieces import IDENTITY, piece_of, state_of
from warp_lcp.material.particle_simulation import ParticleSimulation

IDS = {"output": {"ids": True}}
FLAT = {"size": [1.0, 0.5], "resolution": 24, "liquid": [box([0.0, 0.0], [0.5, 0.4])]}
OPEN = {"size": FLAT["size"], "resolution": 24, "wall": "separating", "open": ["right"]}
RIVER = {
    "domain": OPEN,
    "source": [
        box([0.0, 0.2], [0.1, 0.4], velocity=[1.5, 0.2], stop=0.08),
        box([0.6, 0.3], [0.7, 0.4], velocity=[0.0, -1.0], start=0.03),
    ],
    "drain": [box([0.4, 0.0], [0.6, 0.1], start=0.02)],
}
HEAP = {"size": [1.0, 0.5], "resolution": 24, "sand": [box([0.3, 0.0], [1.0, 0.4])]}
FAR = [box([0.0, 0.0], [1.0, 0.5]), box([2.5, 1.5], [2.52, 1.52], velocity=[1.0, 3.0])]
SCENES: dict[str, dict[str, Any]] = {
    "flat": FLAT,
    "thick": {
        "size": [0.6, 0.4, 0.3],
        "resolution": 12,
        "liquid": [box([0.0, 0.0, 0.0], [0.3, 0.3, 0.3])],
        "particles": {"transfer": "flip"},
    },
    "river": FLAT | RIVER,
    "banded": {
        "size": [1.0, 0.5],
        "resolution": 32,
        "liquid": [box([0.0, 0.0], [0.7, 0.45])],
        "particles": {"narrow_band": {"width": 3.0}, "transfer": "flip"},
    },
    "layers": FLAT
    | {
        "liquid": [box([0.0, 0.0], [0.5, 0.2]), box([0.0, 0.2], [0.5, 0.4], viscosity=10.0)],
        "viscosity": {"value": 1.0},
    },
    "reseeded": FLAT | {"particles": {"reseed": {"min": 4, "max": 4}}},
    "sand": HEAP | {"drain": [box([0.4, 0.0], [0.6, 0.1], start=0.01)]},
    "endless sand": HEAP
    | {
        "periodic": [True, False],
        "physics": {"gravity": [4.0, -8.0]},
        "density_correction": {"every": 0},
    },
}


def simulation_of(tables: dict[str, Any], *, ids: bool = True) -> ParticleSimulation:
    """Return a simulation with ids, of liquid or sand."""
    tables = tables | {"output": tables.get("output", {}) | {"ids": ids}}
    if "sand" in tables:
        return small_sands.create(small_sands.scene(**tables))
    return create(scene(**tables))


def steps(*simulations: ParticleSimulation, count: int) -> list[float]:
    """Step all with the same lengths, and return these [s]."""
    lengths = [min(simulations[0].stable_dt(), 0.01)]
    for number in range(count):
        for simulation in simulations:
            simulation.step(lengths[number])
        lengths.append(min(simulations[0].stable_dt(), 0.01))
    return lengths[:count]


def same_bits(one: ParticleSimulation, other: ParticleSimulation) -> None:
    """Assert that two states are equal in bits but for the ids."""
    states = [
        {name: array for name, array in s.state().items() if name not in IDENTITY}
        for s in (one, other)
    ]
    assert states[0].keys() == states[1].keys()
    for name, array in states[0].items():
        assert array.tobytes() == states[1][name].tobytes(), name


def test_any_bits_survive_in_a_column() -> None:
    quiet_nan, signaling_nan, denormal = 0x7FC00001, 0x7F800001, 5
    words = [quiet_nan, signaling_nan, denormal, 2**32 - 1]
    ids = np.array([low + (high << 32) for low in words for high in (*words[:3], 0)])
    ids = np.append(ids, [NO_ID, 0, 2**63 - 1])
    np.testing.assert_array_equal(unpack_ids(pack_ids(ids)), ids)
    grid = StaggeredGrid((8, 4, 1), 0.125, 2, "cpu")
    rng = np.random.default_rng(71)
    position = np.zeros((len(ids), 3), dtype=np.float32)
    position[:, 0] = rng.permutation(len(ids)) / len(ids)
    velocity = np.zeros_like(position)
    velocity[:, 0] = np.arange(len(ids))  # the particle
    particles = Particles(grid, position, velocity, affine=True, ids=True)
    assert particles.ids is not None
    assert (particles.ids == NO_ID).all()
    particles.set_ids(0, ids)
    particles.sort()
    particles.append(position[:3], velocity[:3], ids=ids[:3])
    marks = particles.marks
    marks.assign((np.arange(particles.count) % 5 == 0).astype(np.int32))
    particles.remove(marks)
    particles.gather_rows(np.arange(particles.count)[::-1].copy())
    particles.sort()
    np.testing.assert_array_equal(particles.ids, ids[particles.velocity.numpy()[:, 0].astype(int)])


def test_ids_are_given_in_the_order_of_cells_and_ages_are_exact() -> None:
    grid = StaggeredGrid((4, 4, 1), 0.25, 2, "cpu")
    places = np.array([[0.9, 0.1, 0.0], [0.1, 0.9, 0.0], [0.1, 0.1, 0.0]])
    particles = Particles(grid, places, np.zeros((3, 3)), affine=False, ids=True)
    births = ParticleIds()
    births.give(particles, 0, grid.part, 0.0, particle_ids.cell_numbers(grid, places))
    assert particles.ids is not None
    assert particles.ids.tolist() == [1, 2, 0]
    births.give(particles, 3, grid.part, 0.25)  # nothing came
    particles.append(places[:2], np.zeros((2, 3)))
    births.give(particles, 3, grid.part, 1.5)
    assert particles.ids.tolist() == [1, 2, 0, 3, 4]
    assert births.ages(particles.ids, 2.0).tolist() == [2.0, 2.0, 2.0, 0.5, 0.5]
    assert (births.first, births.times, births.next) == ([0, 3], [0.0, 1.5], 5)
    again = ParticleIds()
    again.restore(births.state(), [particles.ids])
    assert vars(again) == vars(births)
    assert births.ages(np.zeros(0, dtype=np.int64), 2.0).shape == (0,)
    assert ParticleIds().ages(np.zeros(0, dtype=np.int64), 2.0).shape == (0,)


def test_the_age_of_a_particle_without_an_id_is_not_a_number() -> None:
    births = ParticleIds()
    assert np.isnan(births.ages(np.array([NO_ID]), 1.0)).all()
    births.first, births.times, births.next = [0, 5], [0.25, 0.5], 8
    found = births.ages(np.array([NO_ID, 0, 4, 5, 7]), 1.0)
    np.testing.assert_array_equal(found, np.array([np.nan, 0.75, 0.75, 0.5, 0.5], np.float32))


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.every_case
def test_ids_follow_particles_and_change_no_bit(name: str) -> None:
    one, other = simulation_of(SCENES[name]), simulation_of(SCENES[name], ids=False)
    model = one.scene
    check = TrackCheck(model.domain.size, model.spacing, model.endless)
    check.add(one.points(), 0.0, 0.0)
    count = one.particles.count
    assert check.born == count - 1
    # A reseeding moves particles by up to two cells along each axis.
    most = model.time.cfl + 1.0 + (3.0 if model.particles.reseed is not None else 0.0)
    for _ in range(16):
        (dt,) = steps(one, other, count=1)
        check.add(one.points(), dt, most)
    same_bits(one, other)
    births = one.births
    assert births is not None
    assert check.longest > 0.05
    assert births.next - check.gone >= one.particles.count == len(one.ids)
    if name == "river":
        assert births.next > count + 100
        assert check.gone > 50
    elif name == "banded":
        assert births.next > count + 500
    elif name != "sand":
        assert (births.next, check.gone) == (count, 0)
    assert other.ids is None
    assert other.ages is None
    plain, identified = other.points().fields, one.points().fields
    assert identified.keys() - plain.keys() == {"id", "age"}
    assert (identified["id"].dtype, identified["age"].dtype) == (np.int64, np.float32)
    for field, values in plain.items():
        assert values.tobytes() == identified[field].tobytes()


@pytest.mark.parametrize("name", ["river", "banded", "sand"])
@pytest.mark.every_case
def test_a_resumed_run_has_the_same_ids(name: str) -> None:
    whole = simulation_of(SCENES[name])
    steps(whole, count=7)
    middle = whole.state()
    resumed = simulation_of(SCENES[name])
    resumed.restore(middle)
    steps(whole, resumed, count=6)
    found, expected = resumed.state(), whole.state()
    assert found.keys() == expected.keys()
    for array, values in expected.items():
        assert found[array].tobytes() == values.tobytes(), array
    np.testing.assert_array_equal(resumed.points().fields["age"], whole.points().fields["age"])


def test_a_state_without_ids_gets_new_ones_and_one_with_ids_may_lose_them() -> None:
    plain, identified = simulation_of(FLAT | RIVER, ids=False), simulation_of(FLAT | RIVER)
    steps(plain, identified, count=6)
    resumed = simulation_of(FLAT | RIVER)
    resumed.restore(plain.state())
    ids = resumed.ids
    assert ids is not None
    assert np.sort(ids).tolist() == list(range(len(ids)))
    assert (resumed.ages == 0.0).all()
    without = simulation_of(FLAT | RIVER, ids=False)
    without.restore(identified.state())
    steps(plain, identified, resumed, without, count=5)
    for other in (identified, resumed, without):
        same_bits(plain, other)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": np.zeros(3, dtype=np.int64)}, r"id is int64\(3,\)"),
        ({"id": np.zeros(384)}, "id is float64"),
        ({"birth_ids": np.array([0, 3, 2])}, "no table of births"),
        ({"birth_ids": np.array([0, 5])}, "not been given"),
        ({"birth_times": np.array([np.nan])}, "no table of births"),
    ],
)
@pytest.mark.every_case
def test_damaged_ids_are_refused(change: dict[str, np.ndarray], message: str) -> None:
    simulation = simulation_of(SCENES["flat"])
    state = simulation.state() | change
    if "id" in change and len(change["id"]) == 384:
        state["id"] = np.zeros(simulation.particles.count)
    with pytest.raises(ValueError, match=message):
        simulation_of(SCENES["flat"]).restore(state)


def test_particles_of_a_program_and_of_another_resolution_are_new() -> None:
    simulation = simulation_of(FLAT)
    count = simulation.particles.count
    steps(simulation, count=3)
    simulation.add(np.array([[0.8, 0.3, 0.0], [0.7, 0.3, 0.0]]), np.zeros((2, 3)))
    assert np.sort(simulation.ids).tolist() == list(range(count + 2))
    assert np.count_nonzero(simulation.ages == 0.0) == 2
    newest = simulation.ids >= count
    order = np.argsort(simulation.ids[newest])
    assert simulation.particles.position.numpy()[newest][order][:, 0] == pytest.approx([0.7, 0.8])
    finer = simulation_of(FLAT | {"resolution": 32})
    finer.resample(simulation.state())
    assert finer.ids.min() == count + 2
    assert len(np.unique(finer.ids)) == finer.particles.count
    assert (finer.ages == 0.0).all()
    steps(finer, count=2)
    assert finer.ages == pytest.approx(np.full(finer.particles.count, finer.time - simulation.time))


def test_ids_last_in_spray_and_on_moving_grids(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domain_window, "LEAST_CELLS", 0)
    tables = {"size": [6.0, 3.0], "resolution": 120, "liquid": FAR}
    simulation = simulation_of(tables)
    check = TrackCheck([6.0, 3.0], simulation.grid.spacing)
    check.add(simulation.points(), 0.0, 0.0)
    grids = {(simulation.grid.origin, simulation.grid.counts)}
    for step in range(24):
        (dt,) = steps(simulation, count=1)
        check.add(simulation.points(), dt, 3.0)
        grids.add((simulation.grid.origin, simulation.grid.counts))
        if step == 12:
            assert simulation.spray.particles.count > 0
            state = simulation.state()
            simulation = simulation_of(tables)
            simulation.restore(state)
            assert simulation.spray.particles.count > 0
    assert len(grids) > 1
    assert check.gone == 0


def test_pieces_of_ranks_keep_ids() -> None:
    simulation = simulation_of(FLAT | RIVER)
    steps(simulation, count=4)
    state = simulation.state()
    halves = []
    for part in range(2):
        piece = piece_of(state)
        own = np.arange(len(state["id"])) % 2 == part
        for name in (*simulation.particles.arrays(), "id", "place"):
            if name in piece:
                piece[name] = piece[name][own]
        nx, split = int(piece["counts"][0]), 10
        piece["box"][:, 0] = [0, split] if part == 0 else [split, nx]
        for name, values in piece.items():
            if values.ndim >= 3:
                piece[name] = values[..., slice(*piece["box"][:, 0])]
        halves.append(piece)
    joined = state_of(halves, simulation_of(FLAT | RIVER).state())
    for name in ("id", "birth_ids", "birth_times", "position"):
        np.testing.assert_array_equal(joined[name], state[name])
    for piece in halves:
        del piece["id"]
    assert "id" not in state_of(halves, simulation_of(FLAT | RIVER).state())


def test_without_the_key_nothing_is_numbered_or_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("ids are off")

    for name in ("give", "ages", "state"):
        monkeypatch.setattr(ParticleIds, name, refuse)
    simulation = simulation_of(FLAT | RIVER, ids=False)
    steps(simulation, count=3)
    simulation.frame()
    assert simulation.births is None
    assert "identity" not in simulation.particles.arrays()
    assert not simulation.state().keys() & set(IDENTITY)
    with pytest.raises(AssertionError, match="ids are off"):
        dam(**IDS)


def test_scenes_without_particles_refuse_the_key(tmp_path: Path) -> None:
    from warp_lcp.scene.scene_file import load_scene
    from warp_lcp.scene.table import SceneError

    with pytest.raises(SceneError, match=r"output\.ids.*must be false"):
        load_scene("snake", ["output.ids=true"])
    with pytest.raises(SceneError, match=r"output\.ids"):
        load_scene("dam-break", ["output.ids=7"])
