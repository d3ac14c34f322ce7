"""Steps of every built-in scene in CUDA's form against the CPU's.

Only with the plug-in `emulated_cuda`, see there.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warp_lcp.fluids import coupling
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.scene.scene_file import built_in_scenes, load_scene
from warp_lcp.scene.simulator import simulators

CELLS = {
    "hourglass": 20,
    "jet": 128,
    "river": 256,
    "mesh-obstacle": 30,
    "retracting-wall": 50,
    "stirred-tank": 24,
    "water-labyrinth": 48,
    "wave-maker": 60,
}
STEPS, DT = 3, 0.004
PLAIN = """
import json, sys
from test_as_on_cuda import stepped
for line in sys.stdin:
    print(json.dumps(stepped(line.strip())), flush=True)
"""


def made(name: str, cells: int = 32, *changes: str) -> Any:
    """Return the simulation of a small built-in scene with other keys changed."""
    scene = load_scene(name, [f"domain.resolution={CELLS.get(name, cells)}", *changes])
    return simulators()[scene.scene.simulator].create(scene, device="cpu", folder=Path.cwd())


def stepped(name: str) -> dict[str, list[float]]:
    """Return number, positions and velocities after some steps.

    They are the mean over particles or bodies, and the spread around it.
    """
    simulation = made(name)
    for _ in range(STEPS):
        simulation.step(min(simulation.stable_dt(), DT))
    found = {}
    for key, value in simulation.state().items():
        rows = np.asarray(value)
        if rows.ndim == 2 and rows.dtype.kind == "f" and len(rows):
            found[key] = [
                float(len(rows)),
                *rows.mean(axis=0, dtype=np.float64),
                *rows.std(axis=0, dtype=np.float64),
            ]
    return {key: [float(v) for v in values] for key, values in found.items()}


@pytest.fixture(scope="module")
def on_the_cpu() -> Iterator[Callable[[str], dict[str, list[float]]]]:
    """Return a function that steps a scene in a process without the plug-in."""
    keep = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[1])])
    command = [sys.executable, "-c", PLAIN]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**keep, "PYTHONPATH": paths},
    )
    asked, replies = process.stdin, process.stdout
    assert asked is not None
    assert replies is not None

    def ask(name: str) -> dict[str, list[float]]:
        print(name, file=asked, flush=True)
        line = next((line for line in replies if line.startswith("{")), "")
        assert line, f"the process without the plugin ended with {process.wait()}"
        return json.loads(line)

    with process:
        yield ask


# Differences of velocities [m/s] and their gradients [1/s]: stresses solved to 1e-3 leave them
# uncertain in sand that begins to move.
SMALL = 1e-2
# Every table, side, method and kind of solid of the built-in scenes, in 2-D and 3-D where kernels
# differ; the others launch the same kernels: they are slow ones, half a minute each.
CHOSEN = (
    "carried-box-2d",
    "crown-splash",
    "floating-bodies",
    "gear-pyramid",
    "honey-coil",
    "hourglass",
    "incline",
    "reach",
    "sliding-drop",
    "snake",
    "splash-unilateral",
    "stirred-tank",
    "tap-and-drain",
    "whitewater",
)
EMULATED = pytest.mark.skipif(
    "emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there"
)


# which decide what is launched
SETTINGS = {"domain": ("solids", "wall"), "pressure": ("model", "surface"), "solver": ("method",)}
APART = {"granular source"}  # of pouring-pile, a minute


def features(name: str) -> set[str]:
    """Return the properties of a built-in scene that determine its kernels.

    They are its tables, some of them by dimension, its shapes, joints and settings.
    """
    scene = load_scene(name)
    kind, data = scene.scene.simulator, scene.model_dump(exclude_unset=True)
    found = {f"{kind} {table}" for table in data.keys() - {"camera", "output", "solver"}}
    found |= {
        f"{kind} {scene.dimension}-D {table}"
        for table in ("liquid", "sand", "solid", "surface_tension")
        if table in data
    }
    found |= {
        f"{table}.{key} = {data[table][key]}"
        for table, keys in SETTINGS.items()
        for key in keys
        if key in data.get(table, {})
    }
    return (
        found
        | {f"solid {solid['shape']}" for solid in data.get("solid", [])}
        | {f"joint {joint['kind']}" for joint in data.get("joint", [])}
    )


def test_chosen_scenes_have_all_that_built_in_scenes_have() -> None:
    everywhere, chosen = (
        set().union(*map(features, names)) for names in (built_in_scenes(), CHOSEN)
    )
    assert everywhere - chosen == APART


@EMULATED
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in CHOSEN else pytest.mark.slow)
        for name in built_in_scenes()
    ],
)
def test_a_scene_goes_as_on_the_cpu(
    name: str, on_the_cpu: Callable[[str], dict[str, list[float]]]
) -> None:
    found, expected = stepped(name), on_the_cpu(name)
    assert found.keys() == expected.keys()
    for key, values in found.items():
        assert values[0] == expected[key][0], key
        np.testing.assert_allclose(
            values,
            expected[key],
            rtol=1e-3,
            atol=1e-3 * max(np.abs(expected[key][1:]).max(), SMALL),
            err_msg=key,
        )


@EMULATED
def test_a_step_of_a_liquid_hardly_stops_the_device() -> None:
    """Number of readbacks of a liquid's step.

    The host waits for the device at each readback, and graphs hold no allocations.
    """
    from benchmarks.emulated_cuda import meter

    simulation, counts = made("dam-break"), []
    for _ in range(6):
        meter.clear()
        simulation.step(min(simulation.stable_dt(), DT))
        counts.append([meter["readbacks"], meter["launches"], meter["allocations"]])
    # Of steps after the kernels have been loaded.
    readbacks, launches, allocations = np.array(counts[2:]).max(axis=0)
    assert allocations == 0
    assert readbacks <= 2  # the result of the solve, and that of the step
    # Most of them are in graphs: levels of 16^3 cells are faster so than in one block.
    assert launches <= 200


# Less than the actual density: the correction moves particles in each step.
CROWDED = "density_correction.max_density=0.9"


@EMULATED
@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("dam-break", {"calls": 4, "readbacks": 2, "launches": 230}),
        ("dam-break-2d " + CROWDED, {"calls": 6, "readbacks": 3, "launches": 260}),
        # One of these is by a correction.
        ("floating-bodies-2d", {"calls": 8, "readbacks": 4, "launches": 500}),
        pytest.param(
            "column-collapse", {"calls": 7, "readbacks": 3, "launches": 900}, marks=pytest.mark.slow
        ),
        pytest.param(
            "floating-bodies", {"calls": 6, "readbacks": 3, "launches": 450}, marks=pytest.mark.slow
        ),
        pytest.param(
            "splash-unilateral",
            {"calls": 4, "readbacks": 2, "launches": 200},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "honey-coil", {"calls": 32, "readbacks": 8, "launches": 4000}, marks=pytest.mark.slow
        ),
    ],
)
def test_graphs_of_a_step_give_the_same_bits_with_few_calls(
    name: str, most: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Graphs of a step: equal bits with few calls.

    The host waits for the device at each readback, and graphs hold no allocations.
    """
    from benchmarks.emulated_cuda import meter

    states, counts = [], []
    for on_device in (False, True):
        monkeypatch.setattr(LaunchGraph, "on_device", on_device)
        scene_name, *overrides = name.split()
        # Bodies of less than three cells would be met as exact shapes, by more launches.
        resolution = {"column-collapse": 16, "floating-bodies-2d": 96}.get(name, 32)
        simulation = made(scene_name, resolution, *overrides)
        for _ in range(4):
            meter.clear()
            row = simulation.step(min(simulation.stable_dt(), DT))
            counts.append(
                {what: meter[what] for what in ("calls", "readbacks", "launches", "allocations")}
            )
        states.append(
            {key: np.asarray(value).tobytes() for key, value in simulation.state().items()}
            | {"row": repr(row)}
        )
    assert [key for key in states[0] if states[0][key] != states[1][key]] == []
    # Of the last step: the first ones load kernels and capture graphs.
    for what, number in most.items():
        assert counts[-1][what] <= number, what
        assert counts[-1][what] > number // 2, f"{what}: lower the bound"
    assert counts[-1]["calls"] < counts[3]["calls"] // 2  # graphs, in place of launches
    assert name != "dam-break" or counts[-1]["allocations"] == 0


@EMULATED
def test_bodies_with_more_entries_than_there_is_room_for_are_solved_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bodies with more entries than allocated: solved again.

    A GPU learns the number of cells at bodies with the solve; a solve with missing entries must not
    count.
    """
    states = []
    for least in (coupling.LEAST, 2):
        monkeypatch.setattr(coupling, "LEAST", least)
        simulation = made("floating-bodies-2d")
        for _ in range(3):
            simulation.step(min(simulation.stable_dt(), DT))
        states.append(simulation.state())
        assert simulation.projection.coupling.columns.capacity > 2
    one, other = (state["bodies"] for state in states)
    # Sums over entries are rounded differently.
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)
    assert np.abs(one[:, 3:]).max() > 0.01  # they move


@EMULATED
def test_the_gpu_model_records_every_launch() -> None:
    command = [sys.executable, "-m", "benchmarks.gpu_model", "--cells", "16"]
    done = subprocess.run(
        command,
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
        cwd=Path(__file__).parents[1],
    )
    rows = [
        [float(cell) for cell in line.split("|")[2:-1]]
        for line in done.stdout.splitlines()
        if "^3 |" in line
    ]
    assert len(rows) == 8
    for table in (np.array(rows[:4]), np.array(rows[4:])):
        launches, gigabytes, *times = table.T
        assert (launches > 50).all()
        assert (gigabytes[1:] / gigabytes[:-1] > 6.0).all()
        assert (np.diff(times, axis=1) > 0).all()
        assert (times[1] <= times[0]).all()  # the faster memory


@EMULATED
@pytest.mark.slow
def test_the_verdict_on_a_gpu_is_rehearsed(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.gpu", "--rehearse", "--out", str(tmp_path)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=3600,
        cwd=Path(__file__).parents[1],
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert len(verdict["claims"]) >= 12 and not verdict["left_out"]
    assert all(claim["holds"] for claim in verdict["claims"])
    assert "| PASS | answers equal the CPU's |" in (tmp_path / "verdict.md").read_text()
