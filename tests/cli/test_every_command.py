"""Every command on every scene.

On built-in scenes, and on random ones that have every table, every shape and many sizes.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from command_line import succeed
from default_run import chosen, few
from particle_scenes import particle_scenes, stepped_by_default
from scenes_of_every_table import MOTIONS, SHAPES, SIDES, scene_of_every_table
from warp_lcp.extras.live import LiveServer
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.scene.scene_file import built_in_scenes, load_scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.scene.table import Table

CELLS = {
    "jet": 128,
    "mesh-obstacle": 15,
    "pouring-pile": 18,
    "retracting-wall": 25,
    "river": 256,
    "waterfall": 32,
    "wave-maker": 30,
}  # along the longest side, where 24 and 12 are too small
# In ten seeds liquid and sand have each size once, in twenty in 2-D and in 3-D.
FEW, MORE = range(20), range(20, 100)


def small(name: str) -> str:
    """Return the override that makes a built-in scene small."""
    return f"domain.resolution={CELLS.get(name, 12 if load_scene(name).dimension == 3 else 24)}"


def every_command(scene: object, tmp_path: Path, *overrides: str) -> None:
    """Run every command without a window on a scene and on its run folder."""
    out, problems = tmp_path / "out", tmp_path / "problems"
    sets = [word for override in overrides for word in ("--set", override)]
    loaded = load_scene(str(scene))
    expected_text = "whole run" if isinstance(loaded, ParticleScene) else "disk"
    alone = loaded.scene.simulator == "fluids" and not any(solid.is_body for solid in loaded.solid)
    assert expected_text in succeed("check", scene, "--device", "cpu", *sets)
    assert "seconds a step" in succeed("check", scene, "--device", "cpu", "--calibrate", *sets)
    recorded = ["--record-problems", problems] if alone else []
    assert "finished: frame 1 " in succeed(
        "run", scene, "--device", "cpu", "--out", out, "--frames", 1, *recorded, *sets
    )
    assert "finished: frame 2 " in succeed(
        "run", "--resume", "--out", out, "--device", "cpu", "--frames", 2
    )
    assert "finished earlier" in succeed(
        "run", "--resume", "--out", out, "--device", "cpu", "--frames", 2
    )
    assert expected_text in succeed("check", out / "scene.toml", "--device", "cpu"), (
        "the scene as it ran is one"
    )
    assert "image" in succeed("render", out, "--slice", "--size", "320x240")
    assert "frame_000002.png" in succeed("render", out, "--frame", 2, "--size", "320x240")
    assert "3 frames" in succeed("export", out, "--out", tmp_path / "run.usda")
    succeed("serve", out, "--port", 0)
    if recorded:
        # A thread thinner than a cell has none.
        for problem in sorted(problems.glob("problem_*.npz"))[-1:]:
            succeed("solve", problem)
        succeed(
            "run",
            scene,
            "--out",
            tmp_path / "profiled",
            "--device",
            "cpu",
            "--frames",
            0,
            "--profile",
            *sets,
        )
    if (out / "probes.csv").exists():
        with open(out / "probes.csv", newline="") as table:
            values = [
                float(value) for row in csv.DictReader(table) for value in row.values() if value
            ]
        assert np.isfinite(values).all()


@pytest.fixture
def nobody_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the server of the live page at once."""

    def end(server: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LiveServer, "serve_forever", end)


def written(seed: int, tmp_path: Path) -> Path:
    file = tmp_path / "scene.toml"
    file.write_bytes(tomli_w.dumps(scene_of_every_table(seed)).encode())
    return file


# Scenes that `tests/run/test_threads.py` steps are slow ones, and two thirds of the others.
@pytest.mark.parametrize(
    "name",
    chosen(built_in_scenes(), sorted(set(built_in_scenes()) - set(stepped_by_default()))[::3]),
)
def test_every_built_in_scene_is_checked(name: str) -> None:
    told = "whole run" if name in particle_scenes() else "disk"
    assert told in succeed("check", name, "--device", "cpu", "--set", small(name))


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("seed", few((*FEW, *MORE), 4))
def test_drawn_scenes_are_checked(seed: int, tmp_path: Path) -> None:
    assert "whole run" in succeed("check", written(seed, tmp_path), "--device", "cpu")


@pytest.mark.parametrize("seed", few((3, 7, 2, 4), 1))
def test_every_command_on_drawn_scenes(seed: int, tmp_path: Path, nobody_waits: None) -> None:
    every_command(written(seed, tmp_path), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 160))
def test_every_command_on_more_drawn_scenes(seed: int, tmp_path: Path, nobody_waits: None) -> None:
    every_command(written(seed, tmp_path), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", built_in_scenes())
def test_every_command_on_every_built_in_scene(
    name: str, tmp_path: Path, nobody_waits: None
) -> None:
    every_command(name, tmp_path, small(name))


def test_drawn_scenes_have_every_table_shape_and_motion() -> None:
    """Tables of random scenes: each is one that the commands above meet."""
    drawn = [scene_of_every_table(seed) for seed in FEW]
    for simulator in ("fluids", "granular"):
        of_simulator = [data for data in drawn if data["scene"]["simulator"] == simulator]
        model: type[Table] = simulators()[simulator].scene_model
        assert set(model.model_fields) == set().union(*of_simulator)
        for key in ("liquid" if simulator == "fluids" else "sand", "solid"):
            assert {shape["shape"] for data in of_simulator for shape in data[key]} == set(SHAPES)
        assert {
            solid["motion"]["kind"]
            for data in of_simulator
            for solid in data["solid"]
            if "motion" in solid
        } == set(MOTIONS)
        sizes = [data["domain"]["size"] for data in of_simulator]
        assert {(max(size), len(size)) for size in sizes} == {
            (side, dimension) for side in SIDES for dimension in (2, 3)
        }
