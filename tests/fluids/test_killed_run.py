"""The command line, killed with SIGKILL at random moments and resumed: every file is that of a run that nothing happened to."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

SCENE = """
[scene]
simulator = "fluids"
[time]
duration = 1.5
frames_per_second = 60
[domain]
size = [1.0, 0.5]
resolution = 24
[[liquid]]
shape = "box"
min = [0.0, 0.0]
max = [0.375, 0.375]
[[solid]]
shape = "sphere"
center = [0.7, 0.1]
radius = 0.1
motion = { kind = "sinusoid", period = 0.7, amplitude = [0.1, 0.0] }
[output]
checkpoint_every = 7
"""
PROGRAM = "from warp_lcp.driver.cli import main; main()"
LIMIT = 120  # [s] that a process may take

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")


def start(scene: Path, out: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-c", PROGRAM, "run", str(scene), "--out", str(out), "--device", "cpu", *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process: subprocess.Popen) -> str:
    """Wait for a process, which must succeed, and return what it printed."""
    text, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, text
    return text


def wait_until_it_holds(process: subprocess.Popen, out: Path) -> None:
    """Wait until the process has the folder, or is over."""
    until = time.monotonic() + LIMIT
    while process.poll() is None and time.monotonic() < until:
        try:
            if json.loads((out / "run.lock").read_text())["pid"] == process.pid:
                return
        except (OSError, ValueError):
            pass
        time.sleep(0.005)
    assert process.poll() is not None, "the process does not begin"


def record(out: Path) -> dict:
    return json.loads((out / "run.json").read_text())


def results(out: Path) -> dict[str, bytes]:
    """Return the bytes of every frame, collection and checkpoint, and the log's rows without their seconds."""
    files = [*out.glob("frames/*"), *out.glob("*.pvd"), *out.glob("checkpoints/*")]
    found = {str(path.relative_to(out)): path.read_bytes() for path in files}
    rows = (out / "log.csv").read_text().splitlines()
    return found | {"log.csv": "\n".join(row.rpartition(",")[0] for row in rows).encode()}


def newest_step(out: Path) -> int:
    return max((int(path.stem.removeprefix("step_")) for path in out.glob("checkpoints/step_*.npz")), default=0)


class Before:
    """What lies in the folder of a killed run, to be compared with what its continuation made of it."""

    def __init__(self, out: Path) -> None:
        self.out, self.step = out, newest_step(out)
        self.rows = (out / "log.csv").read_text().splitlines()[: self.step + 1] if (out / "log.csv").is_file() else []
        checkpoint = out / "checkpoints" / f"step_{self.step:06d}.npz"
        reached = float(np.load(checkpoint)["state/time"]) * 60 + 1e-6 if checkpoint.is_file() else -1.0
        self.frames = {path: self.stamp(path) for path in out.glob("frames/*.vtu") if int(path.stem[-6:]) <= reached}

    @staticmethod
    def stamp(path: Path) -> tuple[int, int, int]:
        status = path.stat()
        return status.st_ino, status.st_mtime_ns, status.st_size

    def check(self) -> int:
        """Compare with what is there now: nothing up to the checkpoint was written again. Return the steps that were not repeated."""
        assert record(self.out)["resumed_from_step"] == self.step
        if self.step:  # a row keeps the seconds of the process that computed it
            assert (self.out / "log.csv").read_text().splitlines()[: self.step + 1] == self.rows
        assert {path: self.stamp(path) for path in self.frames} == self.frames
        return self.step


def kill_and_resume(folder: Path, kills: int, seed: int) -> list[int]:
    """Run, kill, resume and kill again, until `kills` processes died at random moments; return the steps resumed from."""
    scene = folder / "scene.toml"
    scene.write_text(SCENE)
    whole = folder / "whole"
    finish(start(scene, whole))  # compiles what is not compiled yet
    finish(start(scene, whole, "--force"))
    expected, seconds = results(whole), 1.2 * record(whole)["seconds"]
    rng, steps, died = np.random.default_rng(seed), [], 0
    for run in range(10 * kills):
        out, before = folder / f"parts_{run}", None
        while True:
            begun = (out / "run.json").is_file()
            process = start(scene, out, *(["--resume"] if begun else []))
            if died < kills:
                wait_until_it_holds(process, out)
                time.sleep(rng.uniform(0.0, seconds))
                process.send_signal(signal.SIGKILL)
            text, _ = process.communicate(timeout=LIMIT)
            if before and (process.returncode == 0 or (begun and record(out)["resumed_from_step"] == before.step)):
                steps.append(before.check())
            if process.returncode == 0:
                break
            assert process.returncode == -signal.SIGKILL, text
            died += 1
            before = Before(out)
        assert results(out) == expected
        assert record(out)["steps"] == record(whole)["steps"]
        if died == kills:
            return steps
    raise AssertionError("the runs end before they can be killed")


def test_three_kills(tmp_path):
    steps = kill_and_resume(tmp_path, 3, 4409)
    assert steps
    assert max(steps) > 0


@pytest.mark.slow
def test_twenty_kills(tmp_path):
    steps = kill_and_resume(tmp_path, 20, 80317)
    print(f"resumed from steps {steps}")
    assert len(steps) >= 15
    assert len(set(steps)) >= 5  # killed all along the run: how far each got is the machine's business


def test_a_second_process_is_refused_and_sigterm_leaves_a_checkpoint(tmp_path):
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    scene.write_text(SCENE.replace("duration = 1.5", "duration = 60.0"))
    process = start(scene, out)
    try:
        wait_until_it_holds(process, out)
        for option in ("--resume", "--force"):
            second = start(scene, out, option)
            text, _ = second.communicate(timeout=LIMIT)
            if option == "--resume" and "no run to resume" in text:  # it held the folder, and had not written yet
                continue
            assert second.returncode == 2, text
            assert re.search(rf"another run writes there \(process {process.pid} on ", text)
            assert "Traceback" not in text
        while newest_step(out) < 7:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        text, _ = process.communicate(timeout=LIMIT)
    finally:
        process.kill()
    assert process.returncode == 1, text
    assert "stopping after this step" in text
    found = record(out)
    assert (found["status"], found["reason"]) == ("stopped", "interrupted by SIGTERM")
    assert newest_step(out) == found["steps"]
    assert f"step_{found['steps']:06d}.npz" in text
    assert not (out / "run.lock").exists()
