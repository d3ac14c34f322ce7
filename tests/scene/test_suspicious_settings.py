"""Suspicious settings: reported by `check` and at the start of a run.

The report has the value, the usual range, and the unit.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tomli_w
from typer.testing import CliRunner

from warp_lcp.cli.commands import app
from warp_lcp.run.check import start
from warp_lcp.scene.scene_file import built_in_scenes, load_scene

Tables = dict[str, Any]
POOL: Tables = {
    "scene": {"simulator": "fluids"},
    "time": {"duration": 0.5},
    "domain": {"size": [1.0, 0.5], "resolution": 16},
    "liquid": [{"shape": "box", "min": [0.0, 0.0], "max": [0.5, 0.25]}],
}
SAND: Tables = {**POOL, "scene": {"simulator": "granular"}, "sand": POOL["liquid"]}
del SAND["liquid"]
BALL = {"shape": "sphere", "center": [0.7, 0.4], "radius": 0.05}
DROP: Tables = {  # a drop of 1 um
    **POOL,
    "time": {"duration": 1e-4, "frames_per_second": 1e5},
    "domain": {"size": [4e-6, 4e-6], "resolution": 16},
    "liquid": [{"shape": "sphere", "center": [2e-6, 2e-6], "radius": 1e-6}],
    "surface_tension": {"coefficient": 0.072},
}


def notes(tables: Tables, **more: Any) -> list[str]:
    return load_scene({**tables, **more}).notes()


@pytest.mark.parametrize("tables", [POOL, SAND])
def test_a_usual_scene_has_no_notes(tables: Tables) -> None:
    assert notes(tables) == []


@pytest.mark.parametrize("name", built_in_scenes())
def test_built_in_scenes_have_no_notes(name: str) -> None:
    assert load_scene(name).notes() == []


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            {"physics": {"density": 0.3}},
            "physics.density = 0.3 kg/m^3: 600 to 14,000 for liquids, water has 1000, are usual; "
            "if g/cm^3 was meant, it is 300",
        ),
        ({"physics": {"gravity": [0.0, 9.81]}}, "physics.gravity = [0.0, 9.81] points up"),
        (
            {"physics": {"gravity": [0.0, -981.0]}},
            "(Earth: 9.81); if cm/s^2 were meant, it is 9.81",
        ),
        (
            {"liquid": [{"shape": "box", "min": [0.2, 0.0], "max": [1.8, 0.25]}]},
            "liquid[0] (box) extends 0.8 m beyond the domain, which extends from the origin to "
            "[1.0, 0.5] m: the part outside is left out",
        ),
        (
            {"liquid": [{**BALL, "center": [1.2, 0.2], "radius": 0.5}]},
            "liquid[0] (sphere) extends 0.7 m beyond the domain",
        ),
        ({"liquid": [{**POOL["liquid"][0], "velocity": [500.0, 0.0]}]}, "sound in air: 340"),
        (
            {"viscosity": {"value": 1e-6}},
            "viscosity.value = 1e-06 Pa s: 0.001 (water), 10 (honey), 10,000 (tar) are usual; if "
            "m^2/s of a liquid as heavy as water",
        ),
        (
            {"surface_tension": {"coefficient": 72.0}},
            "= 72 N/m: 0.02 to 0.5, 0.072 for water, are usual; if mN/m was meant, it is 0.072",
        ),
        (
            {"surface_tension": {"coefficient": 0.07, "contact_angle": 1.0472}},
            "in degrees; if radians were meant, it is 60",
        ),
        ({"wall_drag": {"coefficient": 5.0}}, "wall_drag.coefficient = 5: about 0.005 are usual"),
        ({"solid": [{**BALL, "drag": 5.0}]}, "solid[0].drag = 5"),
        (
            {"solid": [{**BALL, "density": 0.3}]},
            "solid[0].density = 0.3 kg/m^3: 10 (foam) to 22,600 (osmium) are usual",
        ),
        (
            {"solid": [{**BALL, "mass": 500.0}]},
            "the body has 50,000 kg/m^3 or more, 10 (foam) to 22,600 (osmium) are usual; if grams",
        ),
        ({"solid": [{**BALL, "mass": 500.0}]}, "if grams were meant, it is 0.5"),
        (
            {"solid": [{**BALL, "density": 500.0, "angular_velocity": 6.2832}]},
            "angular_velocity = 6.2832 is in degrees/s; if radians were",
        ),
        (
            {"solid": [{**BALL, "rotate": 0.7854, "about": [0.7, 0.4]}]},
            "solid[0].rotate = 0.7854 is in degrees; if radians were meant, it is 45",
        ),
        (
            {
                "solid": [
                    {**BALL, "motion": {"kind": "rotation", "rate": 3.1416, "center": [0.7, 0.4]}}
                ]
            },
            "solid[0].motion.rate = 3.1416 is in degrees/s; if radians were meant, it is 180",
        ),
        ({"time": {"duration": 0.5, "cfl": 50.0}}, "time.cfl = 50: 1 to 4 are usual"),
        (
            {"time": {"duration": 0.02}, "liquid": [{**POOL["liquid"][0], "velocity": [5.0, 0.0]}]},
            "time.duration = 0.02 s is shorter than a frame, 0.0333333 s at time.frames_per_second "
            "= 30",
        ),
        (
            {
                "domain": {"size": [1000.0, 500.0], "resolution": 16},
                "liquid": [{"shape": "box", "min": [0.0, 0.0], "max": [500.0, 250.0]}],
            },
            "nothing moves by more than 1.23 m until then, 0.02 of a cell; lengths are in m, times "
            "in s",
        ),
        (
            {
                "time": {"duration": 0.5, "dt_min": 0.01},
                "liquid": [{**POOL["liquid"][0], "velocity": [50.0, 0.0]}],
            },
            "time.dt_min = 0.01 s is longer than the stable step, 0.0025 s for time.cfl = 2 at 50 "
            "m/s",
        ),
    ],
)
def test_suspicious_liquid_settings_are_reported(more: Tables, said: str) -> None:
    (note,) = notes(POOL, **more)
    assert said in note


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            {"material": {"density": 1.6}},
            "physics.density = 1.6 kg/m^3: 1,200 to 2,000 for sand, air included, are usual; if "
            "g/cm^3 was",
        ),
        (
            {"material": {"friction_angle": 0.6}},
            "0.6 degrees: 25 to 45 are usual; if radians was meant, it is 34.3775",
        ),
        ({"material": {"cohesion": 5e7}}, "material.cohesion = 5e+07 Pa: 100 to 5,000 (damp sand)"),
        (
            {"friction": {"dynamic_angle": 35.0, "grain_size": 0.5}},
            "friction.grain_size = 0.5 m is larger than a cell, 0.0625 m; if mm",
        ),
        ({"physics": {"gravity": [0.0, 9.81]}}, "points up"),
        ({"time": {"duration": 0.5, "cfl": 8.0}}, "0.5 to 1 are usual"),
    ],
)
def test_suspicious_sand_settings_are_reported(more: Tables, said: str) -> None:
    (note,) = notes(SAND, **more)
    assert said in note


@pytest.mark.parametrize(
    "more",
    [
        {"physics": {"gravity": [0.0, 0.0]}},
        {"physics": {"gravity": [9.81, 0.0]}},
        {"physics": {"density": 13_534.0}},
        {"liquid": [{"shape": "box", "min": [-0.05, -0.05], "max": [0.5, 0.25]}]},
        {"liquid": [{**BALL, "center": [0.5, 0.0], "radius": 0.2}]},
        {"liquid": [{"shape": "plane", "point": [0.0, 0.2], "normal": [0.0, 1.0]}]},
        {"solid": [{"shape": "box", "min": [-1.0, -1.0], "max": [0.1, 0.1]}]},
        {"solid": [{**BALL, "rotate": 11.0, "about": [0.7, 0.4]}]},
        {"solid": [{**BALL, "rotate": 5.5, "about": [0.7, 0.4]}]},
        {"solid": [{**BALL, "mass": 10.0}]},
        {"surface_tension": {"coefficient": 0.49, "contact_angle": 140.0}},
    ],
)
def test_plausible_settings_are_not_reported(more: Tables) -> None:
    assert notes(POOL, **more) == []


def test_check_and_run_report_a_dt_min_above_the_capillary_limit(tmp_path: Path) -> None:
    """Shortest step that is unstable with surface tension: named by check and run.

    A drop of 1 um reached many times its speed, and the only warning was about the CFL number.
    """
    scene, out = tmp_path / "drop.toml", tmp_path / "out"
    scene.write_bytes(tomli_w.dumps(DROP).encode())
    message = "time.dt_min = 1e-06 s is longer, and steps would be unstable: use 6e-09"
    checked = CliRunner().invoke(app, ["check", str(scene), "--device", "cpu"])
    ran = CliRunner().invoke(
        app, ["run", str(scene), "--device", "cpu", "--out", str(out), "--frames", "1"]
    )
    assert checked.exit_code == ran.exit_code == 0
    assert message in checked.stdout
    assert message in ran.stderr.split("frame 0")[0]
    assert (
        "step 1: the longest stable step is 5.61e-08 s, less than time.dt_min; steps may be "
        "unstable" in ran.stderr
    )
    short = load_scene({**DROP, "time": {**DROP["time"], "dt_min": 6e-9}})
    assert not any("dt_min" in note for note in start(short, "cpu").notes())


@pytest.mark.parametrize(
    ("setting", "part"),
    [
        ('volume_format="vdb"', "volume"),
        ('grid_format="vti"', "grid"),
        ("surface_ply=true", "surface"),
        ("ids=true", "particles"),
    ],
)
def test_keys_of_parts_that_are_not_written_are_noted(setting: str, part: str) -> None:
    def notes(written: str) -> list[str]:
        scene = load_scene("dam-break", [f"output.{setting}", f"output.{part}={written}"])
        return [note for note in scene.notes() if "has no effect" in note]

    assert notes("true") == []
    (note,) = notes("false")
    assert f"without output.{part}" in note
