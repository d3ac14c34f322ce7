"""Power failures: what was flushed to the disk is a run that can be resumed."""

import os
import re
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_crash_points import contents, go, revive

from warp_lcp.cli.solve_file import write_vector
from warp_lcp.files import atomic
from warp_lcp.frames.ply import write_ply
from warp_lcp.run.checkpoint import CheckpointFolder
from warp_lcp.run.problem_folder import ProblemFolder
from warp_lcp.simulation import Surface

Names = dict[str, int]  # names in a folder, with the inode numbers of their files
AUDITED = {"open", "os.rename", "os.remove", "os.mkdir", "os.truncate"}

pytestmark = pytest.mark.skipif(
    os.name == "nt", reason="folders cannot be brought to the disk there"
)


@dataclass(frozen=True)
class PowerFailure:
    """Possible contents of a disk if the power fails now.

    Args:
        names: present names in each folder.
        durable: names in each folder that `fsync` has flushed to the disk.
        files: contents of each file that `fsync` has flushed to the disk.
        promised: newest step whose checkpoint had been written, as known to the run; -1 if
            none.
    """

    names: dict[int, Names]
    durable: dict[int, Names]
    files: dict[int, bytes]
    promised: int

    def durable_file(self, root: int, folder: str, name: str) -> bytes:
        """Return the contents of a file after the failure."""
        number = self.durable.get(self.durable.get(root, {}).get(folder, 0), {}).get(name, 0)
        return self.files.get(number, b"")

    def restore(self, root: int, out: Path, *, ahead: bool) -> None:
        """Set a folder to its state after the failure.

        Args:
            root: inode number of the folder above.
            out: the folder, which does not exist yet.
            ahead: whether names reach the disk at once, before the contents of the files;
                otherwise as late as possible.
        """
        known = self.names if ahead else self.durable
        waiting = [(known.get(root, {}).get(out.name), out)]
        while waiting:
            number, path = waiting.pop()
            if number in self.names:
                path.mkdir()
                waiting += [(inner, path / name) for name, inner in known.get(number, {}).items()]
            elif number is not None:
                path.write_bytes(self.files.get(number, b""))


@dataclass
class VolatileDisk:
    """Recorder of all operations on a folder, with the state at each moment.

    Args:
        root: the folder above.
    """

    root: Path
    moments: list[PowerFailure] = field(default_factory=list)
    calls: list[tuple[str, str]] = field(default_factory=list)
    files: dict[int, bytes] = field(default_factory=dict)
    durable: dict[int, Names] = field(default_factory=dict)
    promised: int = -1
    # Keeps files open, so that no inode number is reused.
    _held: list[int] = field(default_factory=list)
    _lock: Any = field(default_factory=threading.RLock)
    _busy: bool = False
    on: bool = True

    @property
    def number(self) -> int:
        return self.root.stat().st_ino

    def names(self) -> dict[int, Names]:
        folders = [self.root, *(path for path in self.root.rglob("*") if path.is_dir())]
        return {
            folder.stat().st_ino: {entry.name: entry.inode() for entry in os.scandir(folder)}
            for folder in folders
        }

    def look(self) -> None:
        try:
            now = self.names()
        except FileNotFoundError:  # another thread was faster: the next moment follows soon
            return
        last = self.moments[-1] if self.moments else None
        moment = PowerFailure(
            now,
            {key: dict(value) for key, value in self.durable.items()},
            dict(self.files),
            self.promised,
        )
        if moment != last:
            self.moments.append(moment)

    def sync(self, descriptor: int) -> None:
        """Record the effect of `os.fsync`."""
        if not self.on:
            return
        with self.quietly():
            self.look()
            status = os.fstat(descriptor)
            path = os.readlink(f"/proc/self/fd/{descriptor}")
            if os.path.isdir(path):
                self.durable[status.st_ino] = {
                    entry.name: entry.inode() for entry in os.scandir(path)
                }
                self.calls.append(("fsync folder", os.path.basename(path)))
            else:
                self.files[status.st_ino] = Path(path).read_bytes()
                self.calls.append(("fsync", os.path.basename(path)))
            self._held.append(os.dup(descriptor))
            self.look()

    def hook(self, event: str, arguments: tuple) -> None:
        name = str(arguments[0]) if event in AUDITED else ""
        if (
            not self.on
            or self._busy
            or not (name.startswith(str(self.root)) or name.endswith(atomic.SUFFIX))
        ):
            return
        with self.quietly():
            self.look()
            if event == "os.rename":
                self.calls.append(("rename", os.path.basename(str(arguments[1]))))
            elif (
                event == "open"
                and isinstance(arguments[2], int)
                and arguments[2] & os.O_ACCMODE != os.O_RDONLY
            ):
                self.calls.append(("open", os.path.basename(str(arguments[0]))))

    @contextmanager
    def quietly(self) -> Iterator[None]:
        with self._lock:
            before, self._busy = self._busy, True
            try:
                yield
            finally:
                self._busy = before

    def close(self) -> None:
        self.on = False
        for descriptor in self._held:
            os.close(descriptor)


@pytest.fixture
def disk(tmp_path, monkeypatch) -> Iterator[VolatileDisk]:
    if not Path("/proc/self/fd").is_dir():
        pytest.skip("tells which file a descriptor is of")
    root = tmp_path / "disk"
    root.mkdir()
    disk = VolatileDisk(root)
    disk.durable[disk.number] = {}
    monkeypatch.setattr(os, "fsync", disk.sync)
    write = CheckpointFolder.write

    def promise(self: CheckpointFolder, checkpoint: Any) -> Path:
        path = write(self, checkpoint)
        disk.promised = checkpoint.step
        return path

    monkeypatch.setattr(CheckpointFolder, "write", promise)
    sys.addaudithook(disk.hook)  # for ever: a hook cannot be removed, only disabled
    yield disk
    disk.close()


def survives(
    scene: Path, folder: Path, disk: VolatileDisk, run: Callable[[Path], Any], stride: int
) -> list[int]:
    """Simulate a power failure at every `stride`-th moment of a run.

    Return the steps that were resumed from.
    """
    whole = folder / "whole"
    go(scene, whole)
    expected, steps = contents(whole), []
    disk.moments.clear()
    disk.promised = -1
    run(disk.root / "out")
    disk.on = False
    disk.look()
    for index, moment in enumerate(disk.moments[::-1][::stride][::-1]):
        for ahead in (False, True):
            out = folder / f"{index}_{ahead}" / "out"
            out.parent.mkdir()
            moment.restore(disk.number, out, ahead=ahead)
            step = revive(scene, out)
            assert step >= moment.promised or moment.promised < 0, (
                index,
                ahead,
                step,
                moment.promised,
            )
            assert contents(out) == expected, (index, ahead)
            steps.append(step)
            shutil.rmtree(out.parent)
    return steps


@pytest.mark.parametrize("stride", [13, pytest.param(1, marks=pytest.mark.slow)])
def test_at_any_moment(disk, scene_file, tmp_path, stride):
    steps = survives(scene_file, tmp_path, disk, lambda out: go(scene_file, out), stride)
    assert len(disk.moments) > 100
    assert len(set(steps)) > 3


@pytest.mark.parametrize("stride", [29, pytest.param(1, marks=pytest.mark.slow)])
def test_without_frames(disk, scene_file, tmp_path, stride):
    """Run without frames, whose collections would flush the folder's names too."""
    scene_file.write_text(scene_file.read_text() + "particles = false\ngrid = false\n")
    survives(scene_file, tmp_path, disk, lambda out: go(scene_file, out), stride)


@pytest.mark.parametrize("stride", [29, pytest.param(1, marks=pytest.mark.slow)])
def test_over_another_run(disk, scene_file, tmp_path, stride):
    """Run over another run.

    Files deleted by --force do not return as checkpoints of the run that replaced it.
    """

    def twice(out: Path) -> None:
        go(scene_file, out, "time.duration=0.2")
        disk.moments.clear()
        disk.promised = -1
        go(scene_file, out, force=True)

    go(scene_file, tmp_path / "whole")
    twice(disk.root / "out")
    disk.on = False
    begun = [
        moment
        for moment in disk.moments
        if b'"running"' in moment.durable_file(disk.number, "out", "run.json")
    ]
    early = [moment for moment in begun if moment.promised < 0]
    for index, moment in enumerate([*early[:: stride // 6 + 1], *begun[::stride]]):
        out = tmp_path / f"{index}" / "out"
        out.parent.mkdir()
        moment.restore(disk.number, out, ahead=False)
        revive(scene_file, out)
        assert contents(out) == contents(tmp_path / "whole")


def test_the_end_is_durable(disk, scene_file, tmp_path):
    go(scene_file, disk.root / "out")
    disk.look()
    disk.moments[-1].restore(disk.number, tmp_path / "out", ahead=False)
    found = contents(tmp_path / "out")
    # A deleted checkpoint may be there again.
    assert found == found | contents(disk.root / "out")
    assert (tmp_path / "out" / "run.json").read_bytes() == (
        disk.root / "out" / "run.json"
    ).read_bytes()


def _problem(folder: Path) -> None:
    ProblemFolder(folder).write({"step": np.array(3)})


SURFACE = Surface("surface", np.zeros((3, 3), np.float32), np.array([[0, 1, 2]]), {})
WRITERS: dict[str, Callable[[Path], Any]] = {
    "text.md": lambda path: atomic.write_text(path, "text"),
    "x.mtx": lambda path: write_vector(path, np.ones(3)),
    "surface.ply": lambda path: write_ply(path, SURFACE),
    "problem_000003.npz": lambda path: _problem(path.parent),
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_order_of_calls(disk, name):
    """Order of calls, also for files on which no run depends.

    A file is written, flushed and named; then the name is flushed.
    """
    folder = disk.root / "files"
    folder.mkdir()
    disk.calls.clear()
    WRITERS[name](folder / name)
    calls = [(call, re.sub(r"\.[0-9a-f]{16}\.part$", ".part", file)) for call, file in disk.calls]
    calls = [call for call in calls if call[1] in (f".{name}.part", name, "files")]
    assert calls[-4:] == [
        ("open", f".{name}.part"),
        ("fsync", f".{name}.part"),
        ("rename", name),
        ("fsync folder", "files"),
    ]
