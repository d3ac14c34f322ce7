"""Run loop on a fake simulator: times, retries, ends, exact resumption."""

import csv
import errno
import json
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from small_runs import read_record, run_contents, run_into
from warp_lcp.frames import vtu as vtu_module
from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.run import loop as run_module
from warp_lcp.run.checkpoint import CheckpointFolder
from warp_lcp.run.folder import OutputError, RunRecord
from warp_lcp.run.profile import Profiler
from warp_lcp.run.progress import ProgressLines
from warp_lcp.run.stepping import plan_dt
from warp_lcp.scene.scene import SceneError, Time
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.simulation import NoStopwatch, SimulationFailed, StepFailed

VOLATILE = "seconds"  # the only column of the log that differs in a repetition


class RemarkObserver(ProgressLines):
    """Observer that stores the remarks."""

    def __init__(self) -> None:
        super().__init__(Console(quiet=True))
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


def go(scene: Path, out: Path, *overrides: str, **options: Any) -> RunRecord:
    observer = options.pop("observer", None) or RemarkObserver()
    return run_into(load_scene(scene, overrides), out, observer=observer, **options)


def rows(out: Path) -> list[dict[str, str]]:
    with open(out / "log.csv", newline="") as file:
        return list(csv.DictReader(file))


def contents(out: Path) -> dict[str, Any]:
    """Return the common contents of two equal runs.

    They are every frame, collection and log row, and the last checkpoint.
    """
    found = run_contents(out)
    kept = sorted(name for name in found if name.startswith("step_"))
    return {name: value for name, value in found.items() if name not in kept[:-1]}


def stop_at(step: int) -> Any:
    """Return a `stop` that ends the run after its `step`-th step."""
    asked = iter(range(1, 10_000))
    return lambda: next(asked) >= step


def fail_on(*steps: int, times: int = 10**6, error: type[Exception] = StepFailed) -> Any:
    """Return a `before_step` that fails so many times at each of the steps."""
    left = dict.fromkeys(steps, times)

    def before_step(simulation: Any, dt: float) -> None:
        number = simulation.step_count + 1
        if left.get(number, 0):
            left[number] -= 1
            raise error(f"no at {number}")

    return before_step


def bounds(**changes: float) -> Time:
    return Time(duration=1.0, dt_max=0.1, dt_min=0.001, **changes)


@pytest.mark.parametrize(
    ("stable", "remaining", "expected"),
    [
        (0.05, 0.5, 0.05),
        (0.3, 0.5, 0.1),  # dt_max
        (1e-9, 0.5, 0.001),  # dt_min
        (0.05, 0.05, 0.05),  # exactly at the frame
        (0.05, 0.04, 0.04),
        (0.05, 0.051, 0.0255),  # no tiny step of 0.001
        (0.05, 0.0999, 0.04995),
        (0.05, 0.1, 0.05),
        (np.inf, 0.01, 0.01),
    ],
)
def test_plan_dt(stable, remaining, expected):
    assert plan_dt(stable, remaining, bounds()) == pytest.approx(expected, rel=1e-12)


def test_frames_are_hit_exactly_without_slivers(scene_file, tmp_path):
    out = tmp_path / "out"
    result = go(scene_file, out)
    assert (result.status, result.frames) == ("finished", 10)
    assert result.time == pytest.approx(0.5, abs=1e-14)
    log = rows(out)
    times = np.array([float(row["time"]) for row in log])
    for frame in range(1, 11):
        assert np.abs(times - frame / 20).min() < 1e-14
    steps = np.array([float(row["dt"]) for row in log])
    assert steps.max() <= 0.02
    assert steps.min() > 0.3 * np.median(steps)
    np.testing.assert_allclose(np.cumsum(steps), times, atol=1e-14)
    assert len(list((out / "frames").glob("particles_*.vtu"))) == 11


def test_log_and_record(scene_file, tmp_path):
    out = tmp_path / "out"
    go(scene_file, out)
    log = rows(out)
    assert list(log[0]) == [
        "step",
        "time",
        "dt",
        "max_speed",
        "solve_status",
        "volume",
        "retries",
        "seconds",
    ]
    assert [int(row["step"]) for row in log] == list(range(1, len(log) + 1))
    assert {row["volume"] for row in log} == {""}
    written = read_record(out)
    assert (written["status"], written["steps"], written["frames"], written["device"]) == (
        "finished",
        len(log),
        10,
        "cpu",
    )
    assert written["resumed_from_step"] is None
    assert written["versions"].keys() >= {"warp-lcp", "warp-lang", "numpy", "python"}
    assert load_scene(out / "scene.toml") == load_scene(scene_file)


def test_checkpoints_are_kept_sparingly(scene_file, tmp_path):
    result = go(scene_file, tmp_path / "out")
    last = result.steps // 4 * 4
    names = sorted(path.name for path in (tmp_path / "out" / "checkpoints").iterdir())
    assert names == [f"step_{step:06d}.npz" for step in sorted({last - 4, last, result.steps})]


@pytest.mark.parametrize("count", [1, 2, 6])
def test_as_many_checkpoints_are_kept_as_the_scene_says(dots, scene_file, tmp_path, count):
    most = []
    dots.before_step = lambda simulation, dt: most.append(
        len(list(tmp_path.glob("out/checkpoints/step_*.npz")))
    )
    result = go(scene_file, tmp_path / "out", f"output.checkpoints_kept={count}")
    names = sorted(path.name for path in (tmp_path / "out" / "checkpoints").iterdir())
    every = [*range(0, result.steps, 4), result.steps]
    assert names == [f"step_{step:06d}.npz" for step in every[-count:]]
    assert max(most) <= count + 1  # a new one is written before an old one is deleted
    assert most[0] == 1  # a run can be resumed from its first step on


def test_checkpoints_by_the_clock(dots, scene_file, tmp_path, monkeypatch):
    """Checkpoints by wall time.

    Every third step lasts a minute: with a checkpoint at least every 1.5 minutes there is one after
    each sixth step.
    """
    now = [0.0]
    monkeypatch.setattr(run_module.clock, "monotonic", lambda: now[0])
    written = []
    write = CheckpointFolder.write
    monkeypatch.setattr(
        CheckpointFolder,
        "write",
        lambda self, checkpoint: (written.append(checkpoint.step), write(self, checkpoint))[1],
    )

    def before_step(simulation: Any, dt: float) -> None:
        now[0] += 60.0 * (simulation.step_count % 3 == 2)

    dots.before_step = before_step
    by_clock = ["output.checkpoint_every=0", "output.checkpoint_minutes=1.5"]
    steps = go(scene_file, tmp_path / "clock", *by_clock, last_frame=4).steps
    assert steps > 18
    assert written == sorted({*range(0, steps, 6), steps})
    written.clear()
    steps = go(
        scene_file,
        tmp_path / "both",
        "output.checkpoint_every=5",
        "output.checkpoint_minutes=1.5",
        last_frame=3,
    ).steps
    assert written[:5] == [0, 5, 9, 10, 15]  # the clock restarts with each
    assert written[-1] == steps


def test_output_can_be_turned_off(scene_file, tmp_path):
    go(scene_file, tmp_path / "out", "output.particles=false")
    assert not (tmp_path / "out" / "particles.pvd").exists()
    assert (tmp_path / "out" / "grid.pvd").exists()


@pytest.mark.parametrize("step", [1, 4, 5, 9, 17])
def test_interrupted_and_resumed_equals_uninterrupted(scene_file, tmp_path, step):
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    go(scene_file, uninterrupted)
    stopped = go(scene_file, parts, stop=stop_at(step))
    assert (stopped.status, stopped.steps) == ("stopped", step)
    resumed = go(scene_file, parts, resume=True)
    assert (resumed.status, resumed.resumed_from_step) == ("finished", step)
    assert contents(parts) == contents(uninterrupted)


def test_a_killed_run_resumes_from_its_last_checkpoint(dots, scene_file, tmp_path):
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    go(scene_file, uninterrupted)
    dots.before_step = fail_on(15, error=KeyboardInterrupt)  # the second Ctrl-C
    with pytest.raises(KeyboardInterrupt):
        go(scene_file, parts)
    assert (read_record(parts)["status"], read_record(parts)["reason"]) == (
        "failed",
        "the program ended unexpectedly",
    )
    dots.before_step = lambda simulation, dt: None
    assert go(scene_file, parts, resume=True).resumed_from_step == 12
    assert contents(parts) == contents(uninterrupted)


def test_frames_of_interest_first_then_the_rest(scene_file, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    go(scene_file, whole)
    first = go(scene_file, parts, last_frame=3)
    assert (first.status, first.frames, first.reason) == ("finished", 3, "frame 3 of 10 reached")
    assert go(scene_file, parts, resume=True).frames == 10
    assert contents(parts) == contents(whole)


def test_a_longer_duration_continues(scene_file, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    go(scene_file, whole, "time.duration=0.7")
    go(scene_file, parts)
    assert go(scene_file, parts, "time.duration=0.7", resume=True).frames == 14
    assert contents(parts) == contents(whole)


def test_resuming_a_finished_run_changes_nothing(scene_file, tmp_path):
    out = tmp_path / "out"
    go(scene_file, out)
    before = contents(out)
    assert go(scene_file, out, resume=True).status == "finished"
    assert contents(out) == before


def test_resume_reports_a_broken_checkpoint_and_takes_the_one_before(scene_file, tmp_path):
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    go(scene_file, uninterrupted)
    go(scene_file, parts, stop=stop_at(10))
    broken = parts / "checkpoints" / "step_000010.npz"
    broken.write_bytes(broken.read_bytes()[:-40])
    observer = RemarkObserver()
    result = go(scene_file, parts, resume=True, observer=observer)
    assert result.resumed_from_step == 8
    assert result.warnings == observer.notes == read_record(parts)["warnings"]
    assert "step_000010.npz: cut short" in observer.notes[0]
    assert observer.notes[1].startswith("continuing from step 8 instead")
    assert (parts / "checkpoints" / "refused_000010.npz").is_file()
    (parts / "checkpoints" / "refused_000010.npz").unlink()
    assert contents(parts) == contents(uninterrupted)


def test_failed_steps_are_retried_with_half_the_step(dots, scene_file, tmp_path):
    out = tmp_path / "out"
    dots.before_step = fail_on(3, 7, times=2)
    assert go(scene_file, out).status == "finished"
    log = rows(out)
    assert [int(row["retries"]) for row in log[:8]] == [0, 0, 2, 0, 0, 0, 2, 0]
    assert float(log[2]["dt"]) < 0.3 * float(log[1]["dt"])


def test_a_step_that_keeps_failing_ends_the_run(dots, scene_file, tmp_path):
    out = tmp_path / "out"
    tried: list[float] = []

    def before_step(simulation: Any, dt: float) -> None:
        if simulation.step_count == 5:
            tried.append(dt)
            raise StepFailed("no convergence")

    dots.before_step = before_step
    result = go(scene_file, out)
    assert result.status == "failed"
    assert result.reason.startswith("step 6 at t = ")
    assert result.reason.endswith("retries 6: no convergence")
    np.testing.assert_allclose(tried, tried[0] / 2.0 ** np.arange(7))
    assert read_record(out)["reason"] == result.reason
    assert (out / "checkpoints" / "step_000005.npz").is_file()
    dots.before_step = lambda simulation, dt: None
    assert go(scene_file, out, resume=True).resumed_from_step == 5


def test_retries_stay_above_dt_min(dots, scene_file, tmp_path):
    dots.before_step = fail_on(1)
    result = go(scene_file, tmp_path / "out", "time.dt_min=0.004")
    assert "retries 2" in result.reason  # 0.0167, 0.0083, 0.0042


def test_a_blow_up_keeps_frames_and_the_last_good_checkpoint(dots, scene_file, tmp_path):
    out = tmp_path / "out"
    dots.before_step = fail_on(11, error=SimulationFailed)
    result = go(scene_file, out)
    assert (result.status, result.reason) == ("failed", "no at 11")
    assert max(path.name for path in (out / "checkpoints").iterdir()) == "step_000008.npz"
    assert len(list((out / "frames").glob("particles_*"))) == result.frames + 1
    assert len(rows(out)) == 10


def test_a_stable_step_that_is_not_a_number(dots, scene_file, tmp_path):
    dots.stable_dt = float("nan")
    assert "stable time step is not a number" in go(scene_file, tmp_path / "out").reason


def test_steps_longer_than_the_cfl_number_allows_are_reported_once(dots, scene_file, tmp_path):
    dots.stable_dt = 1e-5
    result = go(scene_file, tmp_path / "out", "time.dt_min=0.005", last_frame=2)
    assert len(result.warnings) == 1
    assert "less than time.dt_min" in result.warnings[0]


def test_a_full_disk_ends_the_run_with_earlier_files_intact(scene_file, tmp_path, monkeypatch):
    out = tmp_path / "out"
    write, parts = vtu_module._vtu, []

    def full(*arguments: Any) -> Any:
        parts.append(arguments)
        if len(parts) > 8:  # two per frame
            yield b"half a fra"
            raise OSError(errno.ENOSPC, "No space left on device")
        yield from write(*arguments)

    monkeypatch.setattr(vtu_module, "_vtu", full)
    result = go(scene_file, out)
    assert result.status == "failed"
    assert result.reason.startswith("the disk is full")
    assert read_record(out)["status"] == "failed"
    assert sorted(path.name for path in (out / "frames").glob("particles*")) == [
        f"particles_{k:06d}.vtu" for k in range(4)
    ]
    monkeypatch.undo()


def slow_frames(monkeypatch: pytest.MonkeyPatch, seconds: float, fails: int = -1) -> None:
    """Delay the writing of frames, and make one of them fail."""
    write = FrameFolder.write

    def slow(self: FrameFolder, index: int, *arguments: Any) -> list[Path]:
        time.sleep(seconds)
        if index == fails:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, index, *arguments)

    monkeypatch.setattr(FrameFolder, "write", slow)


def test_no_checkpoint_is_ahead_of_its_frames(dots, scene_file, tmp_path, monkeypatch):
    out = tmp_path / "out"
    slow_frames(monkeypatch, 0.01)
    ahead = []

    def look(simulation: Any, dt: float) -> None:
        steps = sorted(out.glob("checkpoints/*.npz"))
        if steps:
            time_reached = float(np.load(steps[-1])["state/time"])
            ahead.append(
                int(time_reached * 20 + 1e-6) - (len(list(out.glob("frames/particles_*.vtu"))) - 1)
            )

    dots.before_step = look
    result = go(scene_file, out)
    assert (result.status, result.frames) == ("finished", 10)
    assert len(ahead) > 10
    assert max(ahead) <= 0


def test_a_frame_that_fails_late_ends_the_run_without_a_checkpoint_after_it(
    dots, scene_file, tmp_path, monkeypatch
):
    uninterrupted, out = tmp_path / "whole", tmp_path / "out"
    go(scene_file, uninterrupted)
    slow_frames(monkeypatch, 0.01, fails=3)
    result = go(scene_file, out)
    assert (result.status, result.frames) == ("failed", 2)
    assert result.reason.startswith("the disk is full")
    assert sorted(path.name for path in out.glob("frames/particles*")) == [
        f"particles_{k:06d}.vtu" for k in range(3)
    ]
    monkeypatch.undo()
    monkeypatch.setattr(
        "warp_lcp.scene.simulator.entry_points",
        lambda group: [type("Entry", (), {"name": "dots", "load": lambda _: dots})()],
    )
    assert go(scene_file, out, resume=True).status == "finished"
    assert contents(out) == contents(uninterrupted)


def test_a_step_that_fails_after_a_frame_did_writes_no_checkpoint(
    dots, scene_file, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    slow_frames(monkeypatch, 0.2, fails=1)
    # Soon after frame 1, before its write failure is detected.
    dots.before_step = fail_on(6)
    result = go(scene_file, out, "output.checkpoint_every=50")
    assert result.status == "failed"
    assert "no at 6" in result.reason
    assert any("No space left" in warning for warning in result.warnings)
    assert [path.name for path in out.glob("checkpoints/*")] == ["step_000000.npz"]


def test_a_profile_counts_every_stage(scene_file, tmp_path):
    out, profile = tmp_path / "out", Profiler("cpu")
    result = go(scene_file, out, profile=profile)
    written = json.loads((out / "profile.json").read_text())
    assert (written["device"], written["steps"], written["seconds"]) == (
        "cpu",
        result.steps,
        result.seconds,
    )
    stages = {stage["stage"]: stage for stage in written["stages"]}
    assert stages["frames, written"]["calls"] == 11
    assert stages["frames, written"]["beside"]
    assert stages["frames, written"]["bytes"] == sum(
        path.stat().st_size for path in out.glob("frames/*.vtu")
    )
    assert stages["checkpoints"]["calls"] == 1 + result.steps // 4 + (result.steps % 4 > 0)
    assert stages["checkpoints"]["bytes"] > 0
    assert (
        sum(stage["seconds"] for stage in stages.values() if not stage["beside"]) <= result.seconds
    )


def test_only_a_profiled_run_measures(dots, scene_file, tmp_path, monkeypatch):
    seen = []
    dots.before_step = lambda simulation, dt: seen.append(simulation.watch)
    create = type(dots).create

    def watched(self: Any, *arguments: Any, **options: Any) -> Any:
        simulation = create(self, *arguments, **options)
        simulation.watch = None
        return simulation

    monkeypatch.setattr(type(dots), "create", watched)
    profile = Profiler("cpu")
    go(scene_file, tmp_path / "out", last_frame=1)
    assert {type(watch) for watch in seen} == {NoStopwatch}
    assert not (tmp_path / "out" / "profile.json").exists()
    seen.clear()
    go(scene_file, tmp_path / "other", last_frame=1, profile=profile)
    assert set(map(id, seen)) == {id(profile)}


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EROFS, "[Errno 30] Read-only"),
        (errno.EFBIG, "[Errno 27] File too"),
    ],
)
def test_a_checkpoint_that_cannot_be_written_leaves_the_last_good_one(
    dots, scene_file, tmp_path, monkeypatch, code, reason
):
    uninterrupted, out = tmp_path / "whole", tmp_path / "out"
    go(scene_file, uninterrupted)
    save, calls = np.savez, []

    def fails(file: Any, **arrays: Any) -> None:
        calls.append(file)
        if len(calls) > 3:  # steps 0, 4 and 8 are written
            file.write(b"half a checkpoint")
            raise OSError(code, os.strerror(code))
        save(file, **arrays)

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", fails)
        result = go(scene_file, out)
    assert result.status == "failed"
    assert result.steps >= 12  # it is written while the run continues
    assert result.reason.startswith(reason)
    assert result.reason.endswith("files written before are intact")
    names = sorted(path.name for path in (out / "checkpoints").iterdir())
    assert names == [f"step_{step:06d}.npz" for step in (0, 4, 8)]
    assert go(scene_file, out, resume=True).resumed_from_step == 8
    assert contents(out) == contents(uninterrupted)


def test_a_run_that_exceeds_the_disk_does_not_begin(scene_file, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=20_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(OutputError, match=r"the run needs about .* GB and 2e-05 GB are free"):
        go(scene_file, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_scene_that_cannot_be_simulated(dots, scene_file, tmp_path):
    go(scene_file, tmp_path / "out")
    dots.refuse = "liquid[0]: holds no particle"
    with pytest.raises(SceneError, match=r"dots: liquid\[0\]: holds no particle"):
        go(scene_file, tmp_path / "out", force=True)
    assert read_record(tmp_path / "out")["status"] == "finished"  # nothing was deleted for it


def test_a_simulator_that_cannot_change_grids(scene_file, tmp_path):
    out = tmp_path / "out"
    go(scene_file, out, stop=stop_at(5))
    with pytest.raises(
        SceneError, match=r"domain.resolution: must stay 8: dots cannot change grids"
    ):
        go(scene_file, out, "domain.resolution=16", resume=True)
    assert read_record(out)["status"] == "stopped"  # nothing was touched
    assert go(scene_file, out, resume=True).resumed_from_step == 5


def test_an_empty_simulation_has_frames(dots, scene_file, tmp_path):
    dots.count = 0
    assert go(scene_file, tmp_path / "out").status == "finished"
    assert len(list((tmp_path / "out" / "frames").glob("grid_*.vtu"))) == 11


def test_notes_reach_the_user_and_the_record(dots, scene_file, tmp_path):
    dots.notes = ["solid[0]: lies outside the domain"]
    observer = RemarkObserver()
    assert go(scene_file, tmp_path / "out", observer=observer).warnings == dots.notes
    assert observer.notes == dots.notes


def test_a_run_reports_steps_above_their_tolerance(scene_file, dots, tmp_path):
    def before_step(simulation: Any, dt: float) -> None:
        dots.status = "STAGNATED" if simulation.step_count in (3, 5) else "CONVERGED"

    dots.before_step = before_step
    result = go(scene_file, tmp_path / "out")
    expected = f"2 of {result.steps} steps missed solver.tolerance = 0.0001"
    assert result.warnings == read_record(tmp_path / "out")["warnings"] == [expected]
    dots.before_step = lambda simulation, dt: None
    assert go(scene_file, tmp_path / "fine").warnings == []
