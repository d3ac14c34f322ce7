"""The command line: exit codes, messages, Ctrl-C."""

import json
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from warp_lcp.cli import commands as cli
from warp_lcp.scene import simulator
from warp_lcp.simulation import SimulationFailed


def call(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def test_run(scene_file, out):
    result = call("run", scene_file, "--out", out, "--device", "cpu", "--set", "time.duration=0.2")
    assert result.exit_code == 0
    assert "frame 4/4" in result.stderr
    assert "finished: frame 4 of 4 reached" in result.stdout
    assert json.loads((out / "run.json").read_text())["status"] == "finished"


def test_a_profile_is_shown_and_written(scene_file, out):
    result = call("run", scene_file, "--out", out, "--device", "cpu", "--frames", 2, "--profile")
    assert result.exit_code == 0
    shown = [line.split()[0] for line in result.stdout.splitlines()]
    assert shown[0] == "stage"
    assert {"frames", "(frames,", "checkpoints", "(checkpoints,", "rest", "all", "finished:"} == set(shown[1:]) - {"kernels,"}
    assert json.loads((out / "profile.json").read_text())["steps"] == json.loads((out / "run.json").read_text())["steps"]
    assert call("run", scene_file, "--out", out, "--device", "cpu", "--frames", 2, "--force").exit_code == 0
    assert not (out / "profile.json").exists()


@pytest.mark.parametrize("name", ["x" * 5000, "x" * 300], ids=["path", "part"])
@pytest.mark.parametrize(
    "words", ["check {}", "run {}", "run dam-break-2d --out {}", "run --resume --out {}", "render {}", "solve {}", "tune {}"]
)
def test_paths_that_no_file_can_have(words, name):
    result = call(*words.format(name).split())
    assert result.exit_code == 2
    assert name in result.stderr
    assert result.stderr.endswith(": File name too long\n")


def test_the_folder_is_named_after_the_scene(scene_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("run", scene_file, "--frames", 1, "--device", "cpu").exit_code == 0
    assert (tmp_path / "out" / "dots" / "particles.pvd").is_file()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run", "no-such-scene"], "no such built-in scene"),
        (["run", "{scene}", "--set", "time.cfl=0"], "time.cfl = 0: must be at least 0.001"),
        (["run", "{scene}", "--device", "cuda:77"], "--device cuda:77: there is no such device; choose from"),
        (["run", "{scene}", "--resume"], "there is no run to resume"),
        (["run", "{scene}", "--resume", "--force"], "choose one"),
        (["run", "{scene}", "--frames", "-1"], "--frames"),
        (["run", "{scene}", "--device", "cpu", "--record-problems", "problems"], "the simulator dots has no problems to show"),
        (["run"], "SCENE"),
        (["run", "{scene}", "--fast"], "--fast"),
        (["check", "{scene}", "--set", "domain.wal=x"], "did you mean 'wall'?"),
        (["schema", "--simulator", "dts"], "did you mean 'dots'?"),
    ],
)
def test_wrong_input_exits_with_2(scene_file, out, arguments, expected):
    filled = [argument.format(scene=scene_file) for argument in arguments]
    result = call(*filled, *(["--out", out] if filled[0] == "run" else []))
    assert result.exit_code == 2
    assert expected in result.stderr
    assert "Traceback" not in result.stderr
    assert not (out / "run.json").exists()


def test_existing_output_is_kept_without_force(scene_file, out):
    run = ["run", scene_file, "--out", out, "--device", "cpu"]
    assert call(*run, "--frames", 1).exit_code == 0
    refused = call(*run)
    assert refused.exit_code == 2
    assert "--force deletes it" in refused.stderr
    assert call(*run, "--resume", "--frames", 2).exit_code == 0
    assert call(*run, "--force", "--frames", 0).exit_code == 0
    assert [path.name for path in out.glob("frames/particles*")] == ["particles_000000.vtu"]


def test_a_failed_run_exits_with_1_and_names_the_checkpoint(dots, scene_file, out):
    def before_step(simulation: Any, dt: float) -> None:
        if simulation.step_count == 6:
            raise SimulationFailed("step 7: velocity is not finite in cell (3, 1, 0)")

    dots.before_step = before_step
    result = call("run", scene_file, "--out", out, "--device", "cpu")
    assert result.exit_code == 1
    assert "failed: step 7: velocity is not finite in cell (3, 1, 0)" in result.stderr
    assert f"last checkpoint: {out / 'checkpoints' / 'step_000004.npz'}" in result.stderr
    assert "--resume" in result.stderr


def test_ctrl_c_ends_the_run_with_a_checkpoint(dots, scene_file, out):
    before = signal.getsignal(signal.SIGINT)

    def before_step(simulation: Any, dt: float) -> None:
        if simulation.step_count == 6:
            signal.raise_signal(signal.SIGINT)

    dots.before_step = before_step
    result = call("run", scene_file, "--out", out, "--device", "cpu")
    assert result.exit_code == 1
    assert "stopped: interrupted" in result.stderr
    assert f"warp-lcp run {out / 'scene.toml'} --out {out} --device cpu --resume" in result.stderr
    assert (out / "checkpoints" / "step_000007.npz").is_file()
    assert signal.getsignal(signal.SIGINT) is before
    dots.before_step = lambda simulation, dt: None
    assert call("run", out / "scene.toml", "--out", out, "--device", "cpu", "--resume").exit_code == 0
    assert json.loads((out / "run.json").read_text())["resumed_from_step"] == 7


def test_check_prints_the_plan(scene_file):
    result = call("check", scene_file)
    assert result.exit_code == 0
    assert "8 x 8 = 64 cells of 0.125 m" in result.stdout
    assert "11 at 20 per second" in result.stdout


def test_scenes_lists_what_can_be_run():
    result = call("scenes")
    assert result.exit_code == 0
    assert "ceiling-drop" in result.stdout
    assert "a column of water breaks over a pillar (3-D)" in result.stdout


def test_schema_is_json(dots):
    schema = json.loads(call("schema", "--simulator", "dots").stdout)
    assert schema["properties"].keys() >= {"scene", "time", "domain", "physics", "solver", "solid", "output"}
    assert "from" in json.dumps(schema)


def test_info_names_versions_and_devices(dots):
    result = call("info")
    assert result.exit_code == 0
    for expected in ("warp-lcp", "warp-lang", "device cpu", "kernel cache", "simulator dots", "dots that fall"):
        assert expected in result.stdout


def test_a_simulator_that_does_not_load(dots, scene_file, monkeypatch):
    entry = SimpleNamespace(name="fluids", load=lambda: getattr(json, "SIMULATOR"))  # noqa: B009
    monkeypatch.setattr(simulator, "entry_points", lambda group: [entry])
    result = call("check", scene_file)
    assert result.exit_code == 2
    assert "a simulator cannot be loaded: module 'json' has no attribute 'SIMULATOR'" in result.stderr
