"""Runs driven from Python: bits of the command line's, callbacks, refusals."""

import json
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from typer.testing import CliRunner

import warp_lcp as wl
from small_runs import run_contents
from warp_lcp.cli.commands import app
from warp_lcp.run.api import RunError
from warp_lcp.run.folder import OutputError
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import SimulationFailed

POOL = {
    "scene": {"simulator": "fluids"},
    "time": {"duration": 0.2, "frames_per_second": 50},
    "domain": {"size": (1.0, 0.5), "resolution": 24},
    "liquid": [{"shape": "box", "min": np.array([0.0, 0.0]), "max": [1.0, 0.2]}],
}
# Two steps per frame.
FINE = {**POOL, "time": {"duration": 0.2, "frames_per_second": 50, "dt_max": 0.012}}
CRATE = {
    **POOL,
    "solid": [{"shape": "box", "min": [0.4, 0.25], "max": [0.6, 0.4], "density": 400.0}],
}
SHORT = {"duration": 0.1, "resolution": 32}


def by_command(scene: str, folder: Path) -> None:
    words = ["run", scene, "--out", str(folder), "--device", "cpu"]
    words += [
        word
        for key, value in {"time.duration": 0.1, "domain.resolution": 32}.items()
        for word in ("--set", f"{key}={value}")
    ]
    outcome = CliRunner().invoke(app, words)
    assert outcome.exit_code == 0, outcome.output


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("scene", ["dam-break-2d", "floating-bodies-2d", "column-collapse-2d"])
def test_frames_log_and_checkpoints_are_those_of_the_command_line(scene, tmp_path):
    by_command(scene, tmp_path / "command")
    run = wl.Run(scene, folder=tmp_path / "python", device="cpu", **SHORT)
    frames = [(frame.index, frame.time) for frame in run]
    assert run_contents(tmp_path / "python") == run_contents(tmp_path / "command")
    assert [index for index, _ in frames] == list(range(run.scene.time.frame_count + 1))
    assert [time for _, time in frames] == pytest.approx(
        [run.scene.time.frame_time(index) for index, _ in frames]
    )
    records = [
        json.loads((tmp_path / name / "run.json").read_text()) for name in ("python", "command")
    ]
    for record in records:
        del record["seconds"]
    assert records[0] == records[1]


def test_a_frame_has_the_simulation_s_own_arrays():
    run = wl.Run(CRATE, device="cpu", frames=2)
    for frame in run:
        assert isinstance(frame.particles.position, wp.array)
        assert np.shares_memory(
            frame.particles.position.numpy(), run.simulation.particles.position.numpy()
        )
        assert frame.fields["velocity_x"] is run.simulation.velocity[0]
        assert set(frame.fields) == {"velocity_x", "velocity_y"}
        assert len(frame.bodies) == 1
        shown = frame.parts()[0]
        assert np.array_equal(shown.points, frame.particles.position.numpy())
        assert frame.row.get("step", 0) == run.simulation.step_count
        with pytest.raises(RunError, match=r"set output\.ids = true"):
            assert frame.ids is None
    assert run.record.status == "finished"


def test_without_a_folder_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wl.Run(POOL, device="cpu", frames=2).finish()
    assert not list(tmp_path.iterdir())


def test_scenes_by_name_path_tables_and_object_are_the_same(tmp_path):
    path = tmp_path / "scene.toml"
    by_command("dam-break-2d", tmp_path / "run")
    path.write_text((tmp_path / "run" / "scene.toml").read_text())
    scene = load_scene("dam-break-2d", ["time.duration=0.1", "domain.resolution=32"])
    runs = [
        wl.Run("dam-break-2d", **SHORT),
        wl.Run("dam-break-2d", overrides={"time.duration": 0.1, "domain.resolution": 32}),
        wl.Run(path),
        wl.Run(str(path)),
        wl.Run(scene),
        wl.Run(load_scene("dam-break-2d"), **SHORT),
        wl.Run(scene.model_dump(by_alias=True, exclude_none=True)),
    ]
    assert all(run.scene == scene for run in runs)


def test_a_loop_that_is_left_resumes_bit_for_bit(tmp_path):
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    wl.Run(CRATE, folder=uninterrupted, device="cpu").finish()
    for frame in wl.Run(CRATE, folder=parts, device="cpu"):
        if frame.index == 4:
            break
    record = json.loads((parts / "run.json").read_text())
    assert (record["status"], record["reason"]) == (
        "stopped",
        "stopped by the program after frame 4",
    )
    assert [frame.index for frame in wl.Run.resume(parts, device="cpu")] == [5, 6, 7, 8, 9, 10]
    one, other = run_contents(uninterrupted), run_contents(parts)
    assert {name: one[name] for name in other.keys() & one.keys() if "step" not in name} == {
        name: value for name, value in other.items() if "step" not in name
    }


def test_a_loop_with_an_error_leaves_a_run_that_can_be_resumed(tmp_path):
    def drive():
        for frame in wl.Run(POOL, folder=tmp_path / "run", device="cpu"):
            if frame.index == 3:
                raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        drive()
    assert next(frame.index for frame in wl.Run.resume(tmp_path / "run", device="cpu")) == 4


def without_checkpoints(folder: Path) -> dict:
    return {name: value for name, value in run_contents(folder).items() if "step" not in name}


def failing_at(step: int, action):
    def callback(run):
        if run.row["step"] == step:
            action()

    return callback


def fail() -> None:
    raise LookupError("mine")


def test_a_callback_that_fails_in_any_step_costs_no_frame(tmp_path):
    """Callback that fails in any step: no frame is lost.

    Some of the steps end a frame: the resumed run writes it and passes it to its loop.
    """
    uninterrupted = tmp_path / "whole"
    steps = [
        (frame.index, frame.row["step"])
        for frame in wl.Run(FINE, folder=uninterrupted, device="cpu", frames=3)
        if frame.index
    ]
    assert steps == [(1, 2), (2, 4), (3, 6)]
    ends = {step: index for index, step in steps}
    for step in range(1, steps[-1][1] + 1):
        out = tmp_path / f"{step}"
        with pytest.raises(LookupError, match="mine"):
            wl.Run(
                FINE, folder=out, device="cpu", frames=3, on_step=failing_at(step, fail)
            ).finish()
        assert json.loads((out / "run.json").read_text())["reason"] == "LookupError: mine"
        run = wl.Run.resume(out, device="cpu", frames=3)
        seen = [frame.index for frame in run]
        first = ends.get(step) or min(index for index, end in steps if end > step)
        assert seen == list(range(first, 4)), step
        assert run.record.resumed_from_step == step
        assert not [warning for warning in run.record.warnings if "missing" in warning]
        assert without_checkpoints(out) == without_checkpoints(uninterrupted), step


def test_a_frame_of_which_a_file_was_deleted_is_written_again(tmp_path):
    uninterrupted, out = tmp_path / "whole", tmp_path / "out"
    for folder in (uninterrupted, out):
        wl.Run(FINE, folder=folder, device="cpu", frames=2).finish()
    (out / "frames" / "grid_000002.vtu").unlink()
    run = wl.Run.resume(out, device="cpu", frames=2)
    assert [frame.index for frame in run] == [2]
    assert not [warning for warning in run.record.warnings if "missing" in warning]
    assert without_checkpoints(out) == without_checkpoints(uninterrupted)
    (out / "frames" / "grid_000001.vtu").unlink()  # before the checkpoint: reported, as usual
    run = wl.Run.resume(out, device="cpu", frames=3)
    assert [frame.index for frame in run] == [3]
    assert [warning for warning in run.record.warnings if "grid 1 are missing" in warning]


@pytest.mark.parametrize("step", [1, 2, 4])
def test_ctrl_c_in_a_loop_stops_the_run_after_its_step(tmp_path, step):
    uninterrupted, out = tmp_path / "whole", tmp_path / "out"
    wl.Run(FINE, folder=uninterrupted, device="cpu", frames=3).finish()
    handler = signal.getsignal(signal.SIGINT)
    run = wl.Run(FINE, folder=out, device="cpu", frames=3)
    run.on_step(failing_at(step, lambda: signal.raise_signal(signal.SIGINT)))
    with pytest.raises(KeyboardInterrupt):
        run.finish()
    assert signal.getsignal(signal.SIGINT) is handler
    record = json.loads((out / "run.json").read_text())
    if step == 1:  # the first step has not ended: nothing is lost
        assert (record["status"], record["steps"]) == ("stopped", 1)
    else:
        assert (record["status"], record["reason"], record["steps"]) == (
            "stopped",
            "interrupted by SIGINT",
            step,
        )
        assert (out / "checkpoints" / f"step_{step:06d}.npz").is_file()
    wl.Run.resume(out, device="cpu", frames=3).finish()
    assert without_checkpoints(out) == without_checkpoints(uninterrupted)


def test_ctrl_c_in_a_step_waits_for_its_end(dots, scene_file, tmp_path):
    dots.before_step = lambda simulation, dt: (
        signal.raise_signal(signal.SIGINT) if simulation.step_count == 5 else None
    )
    with pytest.raises(KeyboardInterrupt):
        wl.Run(scene_file, folder=tmp_path / "out", device="cpu").finish()
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (record["status"], record["reason"], record["steps"]) == (
        "stopped",
        "interrupted by SIGINT",
        6,
    )
    dots.before_step = lambda simulation, dt: None
    assert wl.Run.resume(tmp_path / "out", device="cpu").finish().resumed_from_step == 6


def test_a_second_ctrl_c_does_not_wait(dots, scene_file, tmp_path):
    """Second Ctrl-C in a long callback: it does not wait, and the step is kept."""

    def twice() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("goes on")

    with pytest.raises(KeyboardInterrupt):
        wl.Run(
            scene_file, folder=tmp_path / "out", device="cpu", on_step=failing_at(4, twice)
        ).finish()
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (record["status"], record["reason"], record["steps"]) == (
        "stopped",
        "interrupted after step 4",
        4,
    )
    assert wl.Run.resume(tmp_path / "out", device="cpu").finish().resumed_from_step == 4


def test_ctrl_c_between_frames_is_the_program_s(tmp_path):
    def drive():
        for frame in wl.Run(FINE, folder=tmp_path / "run", device="cpu"):
            if frame.index == 2:
                signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        drive()
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (record["status"], record["reason"]) == (
        "stopped",
        "stopped by the program after frame 2",
    )


def test_a_run_in_another_thread_leaves_signals_alone(tmp_path):
    records = []
    thread = threading.Thread(
        target=lambda: records.append(
            wl.Run(FINE, folder=tmp_path / "run", device="cpu", frames=1).finish()
        )
    )
    thread.start()
    thread.join()
    assert [record.status for record in records] == ["finished"]


def test_callbacks_see_every_step_and_stop_the_run(tmp_path):
    seen = []
    run = wl.Run(POOL, folder=tmp_path / "run", device="cpu")

    @run.on_step
    def look(run):
        seen.append((run.row["step"], run.time))
        if len(seen) == 5:
            run.stop()

    record = run.finish()
    assert [step for step, _ in seen] == [1, 2, 3, 4, 5]
    assert (record.status, record.reason, record.steps) == (
        "stopped",
        "interrupted by its program",
        5,
    )
    assert np.all(np.diff([time for _, time in seen]) > 0)


def test_an_impulse_is_what_the_body_s_momentum_changes_by():
    free = {**CRATE, "physics": {"gravity": [0.0, 0.0]}}
    run, momenta = wl.Run(free, device="cpu"), []
    for frame in run:
        momenta.append([*frame.bodies[0].momentum[:2], frame.bodies[0].angular_momentum[2]])
        if frame.index == 1:
            center = frame.bodies[0].position[:2]
            run.push(0, [3.0, 0.5], at=[center[0], center[1] + 0.1])
        if frame.index == 2:
            break
    assert momenta[1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert momenta[2] == pytest.approx([3.0, 0.5, -0.1 * 3.0], rel=1e-3)  # r x J = x Jy - y Jx


def test_gravity_can_turn():
    """Gravity that changes its direction.

    A free fall gains the new gravity's velocity: half of it in the step of the change, by the
    leapfrog.
    """
    drop = {
        **POOL,
        "liquid": [{"shape": "sphere", "center": [0.5, 0.3], "radius": 0.08}],
        "physics": {"gravity": [0.0, 0.0]},
    }
    run, speeds, times = wl.Run(drop, device="cpu", duration=0.12), [], []
    for frame in run:
        speeds.append(frame.particles.velocity.numpy()[:, :2].mean(axis=0).astype(float))
        times.append(frame.time)
        if frame.index == 2:
            run.gravity = [2.0, -1.0]
    assert np.allclose(speeds[2], 0.0, atol=1e-6)
    slope = (speeds[-1] - speeds[3]) / (times[-1] - times[3])
    assert slope == pytest.approx([2.0, -1.0], rel=2e-2)


def test_added_material_fills_what_is_empty_and_has_its_velocity():
    run, counts = wl.Run(POOL | {"output": {"ids": True}}, device="cpu", frames=4), []
    for frame in run:
        assert len(np.unique(frame.ids)) == len(frame.ids) == frame.particles.count
        assert np.array_equal(frame.ages > frame.time - 1e-6, frame.ids < (counts or [2**62])[0])
        counts.append(frame.particles.count)
        if frame.index == 2:
            # Its lower half is full.
            added = run.add(shape="box", min=[0.25, 0.1], max=[0.5, 0.4], velocity=[0.5, 0.0])
            assert (
                frame.particles.velocity.numpy()[-1] == pytest.approx([0.5, 0.0, 0.0])
                or frame.particles.count == counts[-1] + added
            )
            assert run.add(shape="box", min=[0.75, 0.3], max=[0.8, 0.4]) > 0
            with pytest.raises(RunError, match="holds no empty cell"):
                run.add(shape="box", min=[0.1, 0.02], max=[0.3, 0.1])
    cell = 1.0 / 24
    assert added == pytest.approx(4 * 0.25 * 0.2 / cell**2, rel=0.15)
    assert counts[-1] > counts[0] + added


def test_added_material_is_in_the_checkpoint(tmp_path):
    """Added material in the checkpoint.

    A run that is stopped after material was added, and resumed, has the frames of an uninterrupted
    one.
    """

    def drive(folder, leave):
        run = wl.Run(POOL, folder=folder, device="cpu")
        run.on_step(
            lambda run: (
                run.add(shape="box", min=[0.3, 0.3], max=[0.5, 0.4])
                if run.row["step"] == 3
                else None
            )
        )
        for frame in run:
            if leave and frame.index == 5:
                break

    drive(tmp_path / "whole", leave=False)
    drive(tmp_path / "parts", leave=True)
    wl.Run.resume(tmp_path / "parts", device="cpu").finish()
    one, other = run_contents(tmp_path / "whole"), run_contents(tmp_path / "parts")
    assert one["log"] == other["log"]
    assert all(one[name] == other[name] for name in one if name.startswith("frames"))


def test_a_run_that_fails_says_so(tmp_path):
    def spoil(run):
        run.simulation.particles.velocity.numpy()[0] = np.nan

    with pytest.raises(SimulationFailed, match="not finite"):
        wl.Run(POOL, folder=tmp_path / "run", device="cpu", on_step=spoil).finish()
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "failed"


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"scene": "dam-brake"}, SceneError, "dam-brake.*dam-break"),
        ({"scene": 7}, SceneError, "must be a scene file.*dict.*"),
        (
            {
                "scene": {
                    "scene": {"simulator": "fluids"},
                    "domain": {"size": [1, 1], "resolution": 0},
                }
            },
            SceneError,
            "domain.resolution",
        ),
        ({"scene": {}}, SceneError, "scene.simulator: is missing"),
        ({"resolutoin": 96}, SceneError, "resolutoin: no such key.*resolution"),
        ({"resolution": "many"}, SceneError, "domain.resolution"),
        ({"resolution": object()}, RunError, "domain.resolution: must be a number, a string"),
        ({"frames": -1}, RunError, "frames = -1"),
        ({"frames": 2.5}, RunError, "frames = 2.5"),
        ({"folder": 3}, RunError, "folder = 3"),
        ({"device": "tpu"}, ValueError, "tpu"),
        ({"on_step": 5}, RunError, "on_step: must be a function"),
    ],
)
def test_wrong_arguments_are_named_before_any_work(arguments, error, words):
    with pytest.raises(error, match=words):
        wl.Run(**{"scene": POOL, **arguments})


def test_unsupported_calls_are_named(tmp_path):
    run = wl.Run(CRATE, device="cpu", frames=1)
    with pytest.raises(RunError, match="has not started"):
        run.push(0, [1.0, 0.0])
    for _ in run:
        with pytest.raises(RunError, match="body = 1: must be from 0 to 0"):
            run.push(1, [1.0, 0.0])
        with pytest.raises(RunError, match=r"impulse = .*must be 2 finite numbers"):
            run.push(0, [1.0, 0.0, 0.0])
        with pytest.raises(RunError, match=r"gravity = .*must be 2 finite numbers"):
            run.gravity = [0.0, np.nan]
        with pytest.raises(SceneError, match=r"liquid\[1\]"):
            run.add(shape="box", min=[0.0, 0.0])
    with pytest.raises(RunError, match="iterated already"):
        next(iter(run))
    with pytest.raises(OutputError, match="no run to resume"):
        wl.Run.resume(tmp_path)
    wl.Run(POOL, folder=tmp_path / "run", device="cpu", frames=0).finish()
    with pytest.raises(OutputError, match="holds a run already"):
        wl.Run(POOL, folder=tmp_path / "run", device="cpu").finish()
