"""The command line: exit codes, messages, Ctrl-C."""

import json
import re
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from command_line import invoke
from warp_lcp.cli import commands as cli
from warp_lcp.cli import view_commands
from warp_lcp.cli.suites import benchmarks, suite_names
from warp_lcp.extras import live
from warp_lcp.scene import simulator
from warp_lcp.simulation import SimulationFailed


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def test_the_command_line_loads_no_simulator_before_a_command_runs():
    """Modules of a new process that imports the commands: help and completion need no others."""
    heavy = ("warp_lcp.grid", "warp_lcp.material", "warp_lcp.run.loop", "warp_lcp.render.render")
    code = (
        "import sys, warp_lcp.cli.commands;"
        f"print(*[name for name in sys.modules if name.startswith({heavy})])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_run(scene_file, out):
    result = invoke(
        "run", scene_file, "--out", out, "--device", "cpu", "--set", "time.duration=0.2"
    )
    assert result.exit_code == 0
    assert "frame 4/4" in result.stderr
    assert "finished: frame 4 of 4 reached" in result.stdout
    assert json.loads((out / "run.json").read_text())["status"] == "finished"


@pytest.mark.parametrize(("page", "window"), [(True, False), (False, True), (False, False)])
def test_a_run_is_shown_from_its_start(page, window, tmp_path, monkeypatch):
    """Page and window of a run in progress: opened at its start, each on request only."""
    notes, events, opened = [], [], []
    observer = SimpleNamespace(note=notes.append, start=lambda *times: events.append(times))
    monkeypatch.setattr(live, "served", lambda folder, *, port: nullcontext("http://here"))
    monkeypatch.setattr(
        view_commands.subprocess, "Popen", lambda command, **options: opened.append(command[-2:])
    )
    with view_commands.show_while_running(observer, tmp_path, page=page, window=window) as shown:
        assert not notes
        assert not opened
        shown.start(0.0, 2.0)
    assert events == [(0.0, 2.0)]
    assert notes == ["page: http://here"] * page
    assert opened == [["view", str(tmp_path.resolve())]] * window


def test_a_profile_is_shown_and_written(scene_file, out):
    result = invoke("run", scene_file, "--out", out, "--device", "cpu", "--frames", 2, "--profile")
    assert result.exit_code == 0
    shown = [line.split()[0] for line in result.stdout.splitlines()]
    assert shown[0] == "stage"
    assert {
        "frames",
        "(frames,",
        "checkpoints",
        "(checkpoints,",
        "rest",
        "all",
        "finished:",
    } == set(shown[1:]) - {"kernels,"}
    assert (
        json.loads((out / "profile.json").read_text())["steps"]
        == json.loads((out / "run.json").read_text())["steps"]
    )
    assert (
        invoke(
            "run", scene_file, "--out", out, "--device", "cpu", "--frames", 2, "--force"
        ).exit_code
        == 0
    )
    assert not (out / "profile.json").exists()


@pytest.mark.parametrize("name", ["x" * 5000, "x" * 300], ids=["path", "part"])
@pytest.mark.parametrize(
    "words",
    [
        "check {}",
        "run {}",
        "run dam-break-2d --out {}",
        "run --resume --out {}",
        "render {}",
        "solve {}",
        "tune {}",
    ],
)
def test_invalid_paths_are_refused(words, name):
    result = invoke(*words.format(name).split())
    assert result.exit_code == 2
    assert name in result.stderr
    assert result.stderr.endswith(": File name too long\n")


def test_the_folder_is_named_after_the_scene(scene_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert invoke("run", scene_file, "--frames", 1, "--device", "cpu").exit_code == 0
    assert (tmp_path / "out" / "dots" / "particles.pvd").is_file()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run", "no-such-scene"], "no such built-in scene"),
        (["run", "{scene}", "--set", "time.cfl=0"], "time.cfl = 0: must be at least 0.001"),
        (
            ["run", "{scene}", "--device", "cuda:77"],
            "--device cuda:77: there is no such device; choose from",
        ),
        (["run", "{scene}", "--resume"], "there is no run to resume"),
        (["run", "{scene}", "--resume", "--force"], "exclude each other"),
        (["run", "{scene}", "--frames", "-1"], "--frames"),
        (
            ["run", "{scene}", "--device", "cpu", "--record-problems", "problems"],
            "the simulator dots has no problems to record",
        ),
        (["run"], "SCENE"),
        (["run", "{scene}", "--fast"], "--fast"),
        (["check", "{scene}", "--set", "domain.wal=x"], "did you mean 'wall'?"),
        (["schema", "--simulator", "dts"], "did you mean 'dots'?"),
    ],
)
def test_wrong_input_exits_with_2(scene_file, out, arguments, expected):
    filled = [argument.format(scene=scene_file) for argument in arguments]
    result = invoke(*filled, *(["--out", out] if filled[0] == "run" else []))
    assert result.exit_code == 2
    assert expected in result.stderr
    assert "Traceback" not in result.stderr
    assert not (out / "run.json").exists()


def test_existing_output_is_kept_without_force(scene_file, out):
    run = ["run", scene_file, "--out", out, "--device", "cpu"]
    assert invoke(*run, "--frames", 1).exit_code == 0
    refused = invoke(*run)
    assert refused.exit_code == 2
    assert "--force to delete it" in refused.stderr
    assert invoke(*run, "--resume", "--frames", 2).exit_code == 0
    assert invoke(*run, "--force", "--frames", 0).exit_code == 0
    assert [path.name for path in out.glob("frames/particles*")] == ["particles_000000.vtu"]


def test_a_finished_run_that_is_resumed_says_so(scene_file, out):
    assert invoke("run", scene_file, "--out", out, "--device", "cpu").stdout.startswith(
        "finished: frame "
    )
    again = invoke("run", "--resume", "--out", out, "--device", "cpu")
    assert again.exit_code == 0
    assert again.stdout.startswith("finished earlier, nothing to do: frame 10 of 10 reached; ")
    more = invoke("run", "--resume", "--out", out, "--device", "cpu", "--set", "time.duration=0.6")
    assert more.stdout.startswith("finished: frame 12 of 12 reached")


def test_similar_files_are_suggested_for_a_missing_file(scene_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("my-scene.toml", "other.toml"):
        (tmp_path / name).write_text(scene_file.read_text())
    assert (
        invoke("check", "my-scen.toml").stderr
        == "my-scen.toml: there is no such file; did you mean 'my-scene.toml'?\n"
    )
    assert "did you mean 'my-scene.toml'?" in invoke("check", "my-scene").stderr
    assert "did you mean 'dam-break'?" in invoke("check", "dam-brek").stderr
    assert (
        invoke("check", "nothing-like-it.toml").stderr
        == "nothing-like-it.toml: there is no such file\n"
    )
    assert (
        f"did you mean '{tmp_path / 'other.toml'}'?"
        in invoke("check", tmp_path / "othr.toml").stderr
    )


def test_initials_of_a_key_suggest_the_key(scene_file):
    said = invoke("check", scene_file, "--set", "time.fps=24").stderr
    assert "time.fps: unknown key; did you mean 'frames_per_second'?" in said


def test_the_help_of_bench_names_every_suite():
    shown = invoke("bench", "--help").stdout
    assert {"domains", "tank", *benchmarks()} == {
        name for name in suite_names() if re.search(rf"\b{name}\b", shown)
    }


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("run dam", ["dam-break", "dam-break-2d"]),
        ("check my", ["my-scene.toml"]),
        ("check sub", ["sub/"]),
        ("tune wave", ["wave-maker"]),
        ("bench t", ["tank", "threads", "tradeoff"]),
        ("bench tradeoff wave", ["wave-maker"]),
        ("solve --method primal", ["primal-dual-active-set"]),
    ],
)
def test_the_shell_completes_scenes_suites_and_methods(words, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my-scene.toml").write_text("")
    (tmp_path / "my-notes.txt").write_text("")
    (tmp_path / "sub").mkdir()
    typed = f"warp-lcp {words}"
    asked = {
        "_WARP_LCP_COMPLETE": "complete_bash",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(len(typed.split()) - 1),
    }
    result = CliRunner().invoke(cli.app, [], prog_name="warp-lcp", env=asked)
    assert result.stdout.split() == expected


def test_a_failed_run_exits_with_1_and_names_the_checkpoint(dots, scene_file, out):
    def before_step(simulation: Any, dt: float) -> None:
        if simulation.step_count == 6:
            raise SimulationFailed("step 7: velocity is not finite in cell (3, 1, 0)")

    dots.before_step = before_step
    result = invoke("run", scene_file, "--out", out, "--device", "cpu")
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
    result = invoke("run", scene_file, "--out", out, "--device", "cpu")
    assert result.exit_code == 1
    assert "stopped: interrupted" in result.stderr
    assert f"warp-lcp run {out / 'scene.toml'} --out {out} --device cpu --resume" in result.stderr
    assert (out / "checkpoints" / "step_000007.npz").is_file()
    assert signal.getsignal(signal.SIGINT) is before
    dots.before_step = lambda simulation, dt: None
    assert (
        invoke("run", out / "scene.toml", "--out", out, "--device", "cpu", "--resume").exit_code
        == 0
    )
    assert json.loads((out / "run.json").read_text())["resumed_from_step"] == 7


def test_check_prints_the_plan(scene_file):
    result = invoke("check", scene_file)
    assert result.exit_code == 0
    assert "8 x 8 = 64 cells of 0.125 m" in result.stdout
    assert "11 at 20 per second" in result.stdout


def test_scenes_lists_what_can_be_run():
    result = invoke("scenes")
    assert result.exit_code == 0
    assert "ceiling-drop" in result.stdout
    assert "a column of water breaks over a pillar (3-D)" in result.stdout


def test_schema_is_json(dots):
    schema = json.loads(invoke("schema", "--simulator", "dots").stdout)
    assert schema["properties"].keys() >= {
        "scene",
        "time",
        "domain",
        "physics",
        "solver",
        "solid",
        "output",
    }
    assert "from" in json.dumps(schema)


def test_info_names_versions_and_devices(dots):
    result = invoke("info")
    assert result.exit_code == 0
    for expected in (
        "warp-lcp",
        "warp-lang",
        "device cpu",
        "kernel cache",
        "simulator dots",
        "dots that fall",
        "projected-multigrid, then ",
    ):
        assert expected in result.stdout


def test_a_simulator_that_does_not_load(dots, scene_file, monkeypatch):
    entry = SimpleNamespace(name="fluids", load=lambda: getattr(json, "SIMULATOR"))  # noqa: B009
    monkeypatch.setattr(simulator, "entry_points", lambda group: [entry])
    result = invoke("check", scene_file)
    assert result.exit_code == 2
    assert (
        "a simulator cannot be loaded: module 'json' has no attribute 'SIMULATOR'" in result.stderr
    )
