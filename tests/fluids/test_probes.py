"""Probes: pressure, velocity and level at points, and their table beside the log."""

import csv
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from small_liquids import GRAVITY, advance, box, create, scene
from small_runs import run_into
from warp_lcp.fluids import LiquidScene, LiquidSimulation
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.simulation import HasTables, SimulationFailed

DX = 0.04
WATER = 1000.0 * GRAVITY


def probe(name: str, position: list[float], quantity: str = "pressure") -> dict[str, Any]:
    return {"name": name, "position": position, "quantity": quantity}


def tank(dimension: int, probes: list[dict[str, Any]], **tables: Any) -> LiquidSimulation:
    """Return liquid of ten cells depth at rest, in a tank of 20 x 20 (x 5) cells."""
    size, top = [0.8, 0.8, 0.2][:dimension], [0.8, 0.4, 0.2][:dimension]
    return create(
        scene(
            size=size, resolution=20, liquid=[box([0.0] * dimension, top)], probe=probes, **tables
        )
    )


def last(simulation: LiquidSimulation, until: float) -> dict[str, Any]:
    """Step to a time and return the last row of the probes.

    Its columns must be the announced ones.
    """
    advance(simulation, until)
    row = simulation.measured["probes"]
    assert tuple(row) == simulation.tables()["probes"]
    assert row["step"] == simulation.step_count
    return dict(row)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("surface", "bias"), [("ghost-fluid", 0.0), ("voxel", 0.5)])
def test_a_tank_at_rest_has_pressures_and_levels_of_its_depth(
    dimension: int, surface: str, bias: float
) -> None:
    """Pressures and levels of a tank at rest.

    The probes are at walls, in corners, at cell centers and between. Whole cells put the surface
    half a cell too high (`test_rest`).
    """
    rng = np.random.default_rng(71)
    points = rng.uniform([0.0, 0.0, 0.0], [0.8, 0.4 - DX, 0.2], (20, 3))
    points = np.concatenate(
        (points, [[0, 0, 0], [0.8, 0, 0.2], [0.4, 0, 0.1], [0.02, 0.02, 0.02], [0.4, 0.36, 0.1]])
    )[:, :dimension]
    named = [(f"p{n}", point) for n, point in enumerate(points.tolist())]
    probes = [
        probe(name, point, quantity) for name, point in named for quantity in ("pressure", "level")
    ]
    row = last(tank(dimension, probes, pressure={"surface": surface}), 0.2)
    depths = 0.4 - points[:, 1]
    pressures, levels = (
        np.array([row[f"{name}_{what}"] for name, _ in named]) for what in ("pressure", "level")
    )
    assert np.abs(pressures / (WATER * DX) - depths / DX - bias).max() < 0.06
    assert np.abs(levels / DX - depths / DX).max() < 0.1


def test_air_and_solids_have_no_pressure_no_level_and_no_velocity() -> None:
    points = {"above": [0.4, 0.6], "inside": [0.3, 0.2], "under": [0.3, 0.05]}
    probes = [
        probe(name, point, quantity)
        for name, point in points.items()
        for quantity in ("pressure", "velocity", "level")
    ]
    row = last(tank(2, probes, solid=[box([0.2, 0.12], [0.4, 0.28])]), 0.1)
    for name in ("above", "inside"):
        assert row[f"{name}_pressure"] == row[f"{name}_level"] == 0.0
        assert np.isnan([row[f"{name}_vx"], row[f"{name}_vy"]]).all()
    assert row["under_level"] == pytest.approx(0.07, abs=0.25 * DX), "a solid ends it"
    assert row["under_pressure"] == pytest.approx(0.35 * WATER, rel=0.02), "what lies above counts"


def test_a_full_box_ends_levels() -> None:
    simulation = create(
        scene(
            size=[0.8, 0.8],
            resolution=20,
            liquid=[box([0, 0], [0.8, 0.8])],
            probe=[probe("a", [0.41, 0.31], "level")],
        )
    )
    assert last(simulation, 0.05)["a_level"] == pytest.approx(0.49, rel=1e-5)


@pytest.mark.parametrize("dimension", [2, 3])
def test_liquid_in_flight_has_its_velocity_and_no_pressure(dimension: int) -> None:
    """Velocity and pressure of liquid in free fall.

    The velocity is that of the step's middle; `time` is the begin of the step.
    """
    velocity, middle = [0.3, 0.5, -0.2][:dimension], [0.4, 0.45, 0.2][:dimension]
    low, high = [0.2, 0.2, 0.1][:dimension], [0.6, 0.7, 0.3][:dimension]
    probes = [probe("a", middle, "velocity"), probe("a", middle)]
    liquid = [box(low, high, velocity=velocity)]
    simulation = create(
        scene(size=[0.8, 0.8, 0.4][:dimension], resolution=20, liquid=liquid, probe=probes)
    )
    row = last(simulation, 0.05)
    expected = (
        np.array(velocity)
        - [0.0, GRAVITY * (row["time"] + 0.5 * simulation.last_dt), 0.0][:dimension]
    )
    assert np.abs([row[f"a_{c}"] for c in ("vx", "vy", "vz")[:dimension]] - expected).max() < 1e-4
    assert abs(row["a_pressure"]) < 1e-3 * WATER * DX


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("gravity", [0.0, -1e-6, -1e-170])
def test_without_gravity_liquid_keeps_its_velocity_and_has_no_pressure(
    dimension: int, gravity: float
) -> None:
    """Velocity without gravity, and no pressure.

    Without a vertical direction, or with gravity whose square is 0, the search for the surface
    still ends.
    """
    velocity, middle = [0.3, -0.2, 0.1][:dimension], [0.4, 0.45, 0.2][:dimension]
    liquid = [box([0.2, 0.2, 0.1][:dimension], [0.6, 0.7, 0.3][:dimension], velocity=velocity)]
    probes = [
        probe("a", middle, quantity)
        for quantity in (("pressure", "velocity", "level") if gravity else ("pressure", "velocity"))
    ]
    physics = {"gravity": [0.0, gravity, 0.0][:dimension]}
    row = last(
        create(
            scene(
                size=[0.8, 0.8, 0.4][:dimension],
                resolution=20,
                liquid=liquid,
                probe=probes,
                physics=physics,
            )
        ),
        0.05,
    )
    assert (
        np.abs([row[f"a_{c}"] for c in ("vx", "vy", "vz")[:dimension]] - np.array(velocity)).max()
        < 1e-4
    )
    assert abs(row["a_pressure"]) < 1e-3 * WATER * DX
    if gravity:
        assert row["a_level"] == pytest.approx(0.25, abs=0.5 * DX)


def test_a_container_that_moves() -> None:
    """Container that moves.

    A tank whose walls move at a steady speed carries its liquid past a fixed probe. Walls are a
    solid, the domain is wider.
    """
    walls = [
        box([0.2, 0.1], [0.28, 0.6], motion={"kind": "translation", "velocity": [0.4, 0.0]}),
        box([0.72, 0.1], [0.8, 0.6], motion={"kind": "translation", "velocity": [0.4, 0.0]}),
        box([0.2, 0.0], [0.8, 0.1], motion={"kind": "translation", "velocity": [0.4, 0.0]}),
    ]
    probes = [probe("a", [0.51, 0.2], quantity) for quantity in ("pressure", "velocity", "level")]
    liquid = [box([0.28, 0.1], [0.72, 0.4], velocity=[0.4, 0.0])]
    row = last(
        create(scene(size=[1.2, 0.8], resolution=30, liquid=liquid, solid=walls, probe=probes)), 0.3
    )
    assert row["a_pressure"] == pytest.approx(0.2 * WATER, rel=0.05)
    assert row["a_level"] == pytest.approx(0.2, abs=0.4 * DX)
    assert row["a_vx"] == pytest.approx(0.4, rel=0.02)
    assert abs(row["a_vy"]) < 0.02


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("dimension", [2, 3])
def test_grids_that_follow_the_liquid_measure_the_same(dimension: int) -> None:
    """Measurements on grids that follow the liquid.

    A box of liquid crosses a wide domain. Whichever part of it the grid covers, the probe detects
    it.
    """
    size = [64.0, 32.0] if dimension == 2 else [16.0, 16.0, 8.0]
    resolution, middle = (1024, 30.1) if dimension == 2 else (128, 8.1)
    liquid = [
        box(
            [middle - 1.0, 1.0, 1.0][:dimension],
            [middle, 2.0, 2.0][:dimension],
            velocity=[12.0, 4.0, 0.0][:dimension],
        )
    ]
    probes = [
        probe("a", [middle + 0.4, 1.8, 1.5][:dimension], quantity)
        for quantity in ("pressure", "velocity", "level")
    ]
    tables = {"liquid": liquid, "probe": probes, "size": size, "resolution": resolution}
    rows: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
    for follow, found in rows.items():
        domain = {"size": size, "resolution": resolution, "follow": follow}
        simulation = create(scene(**tables, domain=domain))
        assert (simulation.grid.whole is not None) == follow
        for _ in range(6):
            simulation.step(0.02)
            found.append(dict(simulation.measured["probes"]))
    assert np.isnan(rows[True][0]["a_vx"])
    assert rows[True][-1]["a_vx"] == pytest.approx(12.0, rel=1e-3)
    for a, b in zip(*rows.values(), strict=True):
        assert list(a.values()) == pytest.approx(list(b.values()), rel=1e-4, abs=1e-3, nan_ok=True)


@pytest.mark.parametrize("model", ["incompressible", "unilateral"])
def test_probes_change_nothing(model: str) -> None:
    probes = [probe("a", [0.3, 0.1], quantity) for quantity in ("pressure", "velocity", "level")]
    states = []
    for given in ([], probes):
        simulation = tank(2, given, pressure={"model": model})
        assert isinstance(simulation, HasTables)
        assert bool(simulation.tables()) == bool(given)
        advance(simulation, 0.1)
        states.append(simulation.state())
    assert all(np.array_equal(states[0][name], states[1][name]) for name in states[0])


def dam(folder: Path, duration: float = 0.4) -> LiquidScene:
    """Return a dam break with two probes, read from a file."""
    file = folder / "dam.toml"
    file.write_text(f"""
        scene.simulator = "fluids"
        time.duration = {duration}
        domain = {{ size = [1.6, 0.8], resolution = 24 }}
        output.checkpoint_every = 5
        [[liquid]]
        shape = "box"
        min = [0.0, 0.0]
        max = [0.4, 0.4]
        [[probe]]
        name = "a"
        position = [0.1, 0.1]
        quantity = "pressure"
        [[probe]]
        name = "b"
        position = [1.0, 0.02]
        quantity = "velocity"
    """)
    model = load_scene(file)
    assert isinstance(model, LiquidScene)
    return model


def test_an_interrupted_run_writes_the_same_table(tmp_path: Path) -> None:
    scene, asked = dam(tmp_path), itertools.count(1)
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    assert run_into(scene, uninterrupted).status == "finished"
    assert run_into(scene, parts, stop=lambda: next(asked) >= 7).status == "stopped"
    with open(parts / "probes.csv", "a") as file:
        file.write("8,0.2,1.0,0.0,0.0\n9,0.")  # a killed process wrote only this part
    assert run_into(scene, parts, resume=True).status == "finished"
    assert (parts / "probes.csv").read_bytes() == (uninterrupted / "probes.csv").read_bytes()
    with (
        open(uninterrupted / "probes.csv", newline="") as table,
        open(uninterrupted / "log.csv", newline="") as log,
    ):
        rows, steps = list(csv.DictReader(table)), list(csv.DictReader(log))
    assert list(rows[0]) == ["step", "time", "a_pressure", "b_vx", "b_vy"]
    assert [row["step"] for row in rows] == [row["step"] for row in steps]
    assert [row["time"] for row in rows[1:]] == [row["time"] for row in steps[:-1]]
    assert rows[0]["b_vx"] == "", "no velocity in air"
    (uninterrupted / "probes.csv").write_text(
        "\n".join((uninterrupted / "probes.csv").read_text().split("\n")[:3]) + "\n"
    )
    again = run_into(dam(tmp_path, 0.5), uninterrupted, resume=True)
    assert any(warning.startswith("probes.csv: rows of steps") for warning in again.warnings)


def test_a_run_that_fails_keeps_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = LiquidSimulation.step

    def failing(self: LiquidSimulation, dt: float) -> Any:
        if self.step_count == 3:
            raise SimulationFailed("enough")
        return step(self, dt)

    monkeypatch.setattr(LiquidSimulation, "step", failing)
    assert run_into(dam(tmp_path), tmp_path / "out").status == "failed"
    assert len((tmp_path / "out" / "probes.csv").read_text().splitlines()) == 4


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"position": [0.1, 0.1, 0.1]}, "must have 2 entries"),
        ({"position": [0.1, 0.9]}, "lies outside the domain"),
        ({"position": [0.1, float("nan")]}, "finite"),
        ({"name": "a b"}, "must consist of letters"),
        ({"name": ""}, "must consist of letters"),
        ({"name": "b"}, "is also the name of another probe of the pressure"),
        ({"quantity": "speed"}, "'pressure', 'velocity' or 'level'"),
        ({"quantity": "level", "gravity": [0.0, 0.0]}, "needs gravity"),
    ],
)
def test_wrong_probes_are_refused(wrong: dict[str, Any], said: str) -> None:
    physics = {"gravity": wrong.pop("gravity", [0.0, -9.81])}
    with pytest.raises(ValidationError, match=said):
        tank(2, [probe("b", [0.1, 0.1]), probe("a", [0.1, 0.1]) | wrong], physics=physics)
