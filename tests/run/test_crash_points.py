"""Runs killed before any file operation and resumed: equal to uninterrupted ones."""

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from small_runs import run_contents, run_into
from warp_lcp.files.atomic import SUFFIX
from warp_lcp.run.folder import OutputError
from warp_lcp.run.progress import ProgressLines
from warp_lcp.scene.scene_file import load_scene

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork"),
    # The child runs NumPy and its own threads.
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
]

SHORT = ["time.duration=0.1", "output.checkpoint_every=2", "output.checkpoints_kept=2"]
# Audit events are raised before the system call.
OPERATIONS = {"open", "os.rename", "os.remove", "os.mkdir", "os.truncate"}


def go(scene: Path, out: Path, *overrides: str, resume: bool = False, force: bool = False) -> Any:
    loaded = load_scene(scene, [*SHORT, *overrides])
    return run_into(
        loaded, out, observer=ProgressLines(Console(quiet=True)), resume=resume, force=force
    )


def contents(out: Path) -> dict[str, Any]:
    """Return the common contents of equal runs, and the names of hidden files."""
    return {**run_contents(out), "hidden": sorted(path.name for path in out.rglob(".*"))}


def killed(run: Callable[[], Any], folder: Path, operation: int) -> bool:
    """Run in a child that dies before its `operation`-th file operation.

    Return whether it got that far.
    """
    child = os.fork()
    if child == 0:
        left = [operation]

        def hook(event: str, arguments: tuple) -> None:
            name = str(arguments[0]) if event in OPERATIONS else ""
            # A temporary file's name, relative to its folder.
            if name and (name.startswith(str(folder)) or name.endswith(SUFFIX)):
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(hook)
        try:
            run()
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def revive(scene: Path, out: Path) -> int:
    """Resume, or begin a run that had not begun; return the first step."""
    try:
        resumed = go(scene, out, resume=True)
    except OutputError as error:
        assert "there is no run to resume" in str(error)
        resumed = go(scene, out)
        assert resumed.resumed_from_step is None
    assert resumed.status == "finished"
    assert not [warning for warning in resumed.warnings if "missing" in warning]
    assert (
        json.loads((out / "run.json").read_text())["resumed_from_step"] == resumed.resumed_from_step
    )
    return resumed.resumed_from_step or 0


def crash_everywhere(scene: Path, folder: Path, stride: int) -> list[int]:
    """Kill a run at every `stride`-th operation and compare the resumed one.

    Return the steps resumed from.
    """
    whole = folder / "whole"
    go(scene, whole)
    expected, steps = contents(whole), []
    for operation in range(1, 10_000, stride):
        out = folder / f"killed_{operation}"
        if not killed(lambda out=out: go(scene, out), out, operation):
            return steps
        steps.append(revive(scene, out))
        assert contents(out) == expected, f"killed before operation {operation}"
    raise AssertionError("the run does not end")


def test_killed_anywhere(scene_file, tmp_path):
    steps = crash_everywhere(scene_file, tmp_path, 7)
    assert len(steps) > 10
    assert len(set(steps)) > 3


@pytest.mark.slow
def test_killed_everywhere(scene_file, tmp_path):
    steps = crash_everywhere(scene_file, tmp_path, 1)
    assert len(steps) > 80
    assert steps == sorted(steps)  # the later it is killed, the later it resumes


@pytest.mark.parametrize("stride", [11, pytest.param(1, marks=pytest.mark.slow)])
def test_killed_while_it_resumes(scene_file, tmp_path, stride):
    go(scene_file, tmp_path / "whole")
    expected, count, part = contents(tmp_path / "whole"), 0, tmp_path / "part"
    assert killed(lambda: go(scene_file, part), part, 57)
    broken = max(part.glob("checkpoints/step_*.npz"))
    broken.write_bytes(broken.read_bytes()[:-9])
    for operation in range(1, 10_000, stride):
        out = shutil.copytree(part, tmp_path / f"killed_{operation}")
        if not killed(lambda out=out: go(scene_file, out, resume=True), out, operation):
            break
        count += 1
        revive(scene_file, out)
        assert contents(out) == expected, f"killed before operation {operation} of the resumed part"
    assert count * stride > 30


@pytest.mark.parametrize("stride", [6, pytest.param(1, marks=pytest.mark.slow)])
def test_killed_while_force_deletes(scene_file, tmp_path, stride):
    """Runs killed while --force deletes another run.

    Its steps are not continued, and none of its files remains.
    """
    go(scene_file, tmp_path / "whole")
    expected, count, other = contents(tmp_path / "whole"), 0, tmp_path / "other"
    go(scene_file, other, "physics.density=900.0", "time.duration=0.15")
    for operation in range(1, 60, stride):
        out = shutil.copytree(other, tmp_path / f"killed_{operation}")
        assert killed(lambda out=out: go(scene_file, out, force=True), out, operation)
        count += 1
        go(scene_file, out, force=True)
        assert contents(out) == expected, f"killed before operation {operation}"
    assert count * stride > 50
