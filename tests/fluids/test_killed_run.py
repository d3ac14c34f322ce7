"""Command line killed by SIGKILL at random moments and resumed.

Every file is that of an uninterrupted run.
"""

import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from small_runs import read_record
from warp_lcp.cli import commands as cli

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
PROGRAM = "from warp_lcp.cli.commands import main; main()"
LIMIT = 120  # [s] limit of a process

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL"),
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
]


def arguments(scene: Path, out: Path, *more: str) -> list[str]:
    return ["run", str(scene), "--out", str(out), "--device", "cpu", *more]


def start(scene: Path, out: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-c", PROGRAM, *arguments(scene, out, *more)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


class ForkedCommand:
    """Command line in a fork of this process.

    The fork has imported everything, so that it starts at once. It dies as any other process.
    """

    def __init__(self, scene: Path, out: Path, *more: str) -> None:
        self.printed = out.with_suffix(".txt")
        self.process = multiprocessing.get_context("fork").Process(
            target=self.main, args=[arguments(scene, out, *more)]
        )
        self.process.start()
        self.pid = self.process.pid

    def main(self, arguments: list[str]) -> None:
        with open(self.printed, "w") as file:
            for stream in (1, 2):
                os.dup2(file.fileno(), stream)
            sys.stdout = sys.stderr = file  # not pytest's
            cli.app(arguments)

    def poll(self) -> int | None:
        return self.process.exitcode

    returncode = property(poll)

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.process.pid, number)

    def communicate(self, timeout: float) -> tuple[str, None]:
        self.process.join(timeout)
        return self.printed.read_text(), None


def call(scene: Path, out: Path, *more: str) -> tuple[int, str]:
    """Run in this process; return the exit code and the output."""
    result = CliRunner().invoke(cli.app, arguments(scene, out, *more))
    return result.exit_code, result.output


def wait_until_it_holds(process: subprocess.Popen | ForkedCommand, out: Path) -> None:
    """Wait until the process holds the folder, or has ended."""
    until = time.monotonic() + LIMIT
    while process.poll() is None and time.monotonic() < until:
        try:
            if json.loads((out / "run.lock").read_text())["pid"] == process.pid:
                return
        except (OSError, ValueError):
            pass
        time.sleep(0.005)
    assert process.poll() is not None, "the process does not begin"


def results(out: Path) -> dict[str, bytes]:
    """Return the bytes of every output file, and the log without seconds.

    The files are frames, collections and checkpoints.
    """
    files = [*out.glob("frames/*"), *out.glob("*.pvd"), *out.glob("checkpoints/*")]
    found = {str(path.relative_to(out)): path.read_bytes() for path in files}
    rows = (out / "log.csv").read_text().splitlines()
    return found | {"log.csv": "\n".join(row.rpartition(",")[0] for row in rows).encode()}


def newest_step(out: Path) -> int:
    return max(
        (int(path.stem.removeprefix("step_")) for path in out.glob("checkpoints/step_*.npz")),
        default=0,
    )


class KilledRunFolder:
    """Contents of a killed run's folder, to compare with its continuation."""

    def __init__(self, out: Path) -> None:
        self.out, self.step = out, newest_step(out)
        self.rows = (
            (out / "log.csv").read_text().splitlines()[: self.step + 1]
            if (out / "log.csv").is_file()
            else []
        )
        checkpoint = out / "checkpoints" / f"step_{self.step:06d}.npz"
        reached = (
            float(np.load(checkpoint)["state/time"]) * 60 + 1e-6 if checkpoint.is_file() else -1.0
        )
        self.frames = {
            path: self.stamp(path)
            for path in out.glob("frames/*.vtu")
            if int(path.stem[-6:]) <= reached
        }

    @staticmethod
    def stamp(path: Path) -> tuple[int, int, int]:
        status = path.stat()
        return status.st_ino, status.st_mtime_ns, status.st_size

    def check(self) -> int:
        """Compare with the present contents.

        Nothing up to the checkpoint may have been written again. Return the number of steps that
        were not repeated.
        """
        assert read_record(self.out)["resumed_from_step"] == self.step
        if self.step:  # a row keeps the seconds of the process that computed it
            assert (self.out / "log.csv").read_text().splitlines()[: self.step + 1] == self.rows
        assert {path: self.stamp(path) for path in self.frames} == self.frames
        return self.step


def kill_and_resume(
    folder: Path, kills: int, seed: int, begin: Callable[..., Any], duration: float
) -> list[int]:
    """Run, kill, resume and kill again, until `kills` processes died.

    They die at random moments. Return the steps resumed from.
    """
    scene = folder / "scene.toml"
    scene.write_text(SCENE.replace("duration = 1.5", f"duration = {duration}"))
    uninterrupted = folder / "whole"
    # The first run loads and compiles kernels.
    for option in (["--set", "time.duration=0.1"], ["--force"]):
        code, text = call(scene, uninterrupted, *option)
        assert code == 0, text
    expected, seconds = results(uninterrupted), 1.2 * read_record(uninterrupted)["seconds"]
    rng, steps, died = np.random.default_rng(seed), [], 0
    for run in range(10 * kills):
        out, before = folder / f"parts_{run}", None
        while True:
            has_record = (out / "run.json").is_file()
            process = begin(scene, out, *(["--resume"] if has_record else []))
            if died < kills:
                wait_until_it_holds(process, out)
                time.sleep(rng.uniform(0.0, seconds))
                process.send_signal(signal.SIGKILL)
            text, _ = process.communicate(timeout=LIMIT)
            if (
                before
                and has_record
                and (
                    process.returncode == 0 or read_record(out)["resumed_from_step"] == before.step
                )
            ):
                steps.append(before.check())
            if process.returncode == 0:
                break
            assert process.returncode == -signal.SIGKILL, text
            died += 1
            before = KilledRunFolder(out)
        assert results(out) == expected
        assert read_record(out)["steps"] == read_record(uninterrupted)["steps"]
        if died == kills:
            return steps
    raise AssertionError("the runs end before they can be killed")


@pytest.mark.slow
def test_three_kills(tmp_path):
    steps = kill_and_resume(tmp_path, 3, 4999, ForkedCommand, 0.75)
    assert steps
    assert max(steps) > 0


@pytest.mark.slow
def test_twenty_kills(tmp_path):
    steps = kill_and_resume(tmp_path, 20, 80317, start, 1.5)
    print(f"resumed from steps {steps}")
    assert len(steps) >= 15
    # Killed all along the run: the progress of each depends on the machine.
    assert len(set(steps)) >= 5


def test_a_second_process_is_refused_and_sigterm_leaves_a_checkpoint(tmp_path):
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    scene.write_text(SCENE.replace("duration = 1.5", "duration = 60.0"))
    process = ForkedCommand(scene, out)
    try:
        wait_until_it_holds(process, out)
        for option in ("--resume", "--force"):
            code, text = call(scene, out, option)
            # It held the folder and had not written yet.
            if option == "--resume" and "no run to resume" in text:
                continue
            assert code == 2, text
            assert re.search(rf"another run writes there \(process {process.pid} on ", text)
            assert "Traceback" not in text
        while newest_step(out) < 7:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        text, _ = process.communicate(timeout=LIMIT)
    finally:
        process.send_signal(signal.SIGKILL)
    assert process.returncode == 1, text
    assert "stopping after this step" in text
    found = read_record(out)
    assert (found["status"], found["reason"]) == ("stopped", "interrupted by SIGTERM")
    assert newest_step(out) == found["steps"]
    assert f"step_{found['steps']:06d}.npz" in text
    assert not (out / "run.lock").exists()
