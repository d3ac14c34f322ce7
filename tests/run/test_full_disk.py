"""Full disk at any moment: true status, kept output, and a later resumption."""

import builtins
import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from test_crash_points import contents, go

from warp_lcp.files import atomic
from warp_lcp.run import folder as run_folder
from warp_lcp.run.folder import OutputError, RunRecord


class FullDisk:
    """Files of a folder with a limited total size.

    Files opened by `open` fail beyond the limit.

    Args:
        folder: folder of the counted files.
        size: limit of their total size [bytes].
        code: code of the error.
        block: block size to which a file's size is rounded up [bytes].
    """

    def __init__(self, folder: Path, size: int, code: int = errno.ENOSPC, block: int = 1) -> None:
        self.folder, self.size, self.code, self.block = folder, size, code, block
        self.refused: list[str] = []

    def rounded(self, size: int) -> int:
        return -(-size // self.block) * self.block

    def used(self) -> int:
        """Return the used bytes; a file that another thread renames may be missed."""
        sizes = []
        for path in self.folder.rglob("*"):
            with suppress(FileNotFoundError):
                sizes.append(self.rounded(path.stat().st_size) if path.is_file() else 0)
        return sum(sizes)

    def open(
        self, file: Any, mode: str = "r", buffering: int = -1, *more: Any, **options: Any
    ) -> Any:
        path = os.readlink(f"/proc/self/fd/{file}") if isinstance(file, int) else str(file)
        if (
            "opener" in options
            or "r" in mode.replace("r+", "")
            or not path.startswith(str(self.folder))
        ):
            return self._open(file, mode, buffering, *more, **options)
        raw = LimitedFile(file, mode.replace("b", "").replace("t", ""), path=path, disk=self)
        stream = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return (
            stream
            if "b" in mode
            else io.TextIOWrapper(stream, *more, line_buffering=buffering == 1, **options)
        )

    @contextmanager
    def mounted(self) -> Iterator["FullDisk"]:
        self._open = builtins.open
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(builtins, "open", self.open)
            patch.setattr(io, "open", self.open)
            yield self


class LimitedFile(io.FileIO):
    """File on such a disk."""

    def __init__(self, file: Any, mode: str, *, path: str, disk: FullDisk) -> None:
        super().__init__(file, mode)
        self._disk = disk
        self.path = path

    def write(self, data: Any) -> int:
        before = os.fstat(self.fileno()).st_size
        end = (before if "a" in self.mode else self.tell()) + len(data)
        grows = self._disk.rounded(max(end, before)) - self._disk.rounded(before)
        if grows and self._disk.used() + grows > self._disk.size:
            self._disk.refused.append(Path(self.path).name)
            raise OSError(self._disk.code, os.strerror(self._disk.code), self.path)
        return super().write(data) or 0


def ends_truly(out: Path, record: RunRecord) -> None:
    """Check that run.json has the true status, and that no file is incomplete."""
    assert json.loads((out / "run.json").read_text())["status"] == record.status == "failed"
    assert record.reason.startswith("the disk is full: ")
    assert [path.name for path in out.rglob(".*")] == []


def fill(
    scene: Path, folder: Path, sizes: list[int], *, code: int = errno.ENOSPC, block: int = 1
) -> dict[str, int]:
    """Run on disks of these sizes and resume on larger ones.

    Return the kinds of files at which the disks were full first.
    """
    go(scene, folder / "whole")
    expected, where = contents(folder / "whole"), {}
    for size in sizes:
        out = folder / f"full_{size}"
        out.mkdir()
        with FullDisk(out, size, code, block).mounted() as disk:
            try:
                record = go(scene, out)
            except OutputError:  # before the run began
                assert not (out / "run.json").exists()
                record = None
        if not disk.refused:
            assert record is not None
            assert record.status == "finished", record.reason
            break
        temporary = atomic.TEMPORARY.fullmatch(disk.refused[0])
        first = (
            (temporary["name"] if temporary else disk.refused[0]).rstrip("0123456789").split("_")[0]
        )
        where[first] = where.get(first, 0) + 1
        if (out / "run.json").exists():
            ends_truly(out, record)
            assert go(scene, out, resume=True).status == "finished"
        else:
            assert record is None or record.status == "failed"
            go(scene, out)
        assert contents(out) == expected, size
        shutil.rmtree(out)
    return where


def whole_size(scene: Path, folder: Path) -> int:
    go(scene, folder / "size")
    return (
        sum(path.stat().st_size for path in (folder / "size").rglob("*") if path.is_file()) + 30_000
    )


@pytest.fixture
def quick(monkeypatch):
    """Leave out operations that matter only in a power failure."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def test_full_at_any_moment(quick, scene_file, tmp_path):
    size = whole_size(scene_file, tmp_path)
    where = fill(scene_file, tmp_path, [*range(200, size, size // 16), size])
    assert where.keys() >= {"run.json.spare", "particles", "grid", "step"}, where


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "block", "stride"),
    [(errno.ENOSPC, 1, 173), (errno.EDQUOT, 1, 577), (errno.ENOSPC, 4096, 811)],
)
def test_full_at_every_moment(quick, scene_file, tmp_path, code, block, stride):
    size = (whole_size(scene_file, tmp_path)) * (3 if block > 1 else 1)
    where = fill(scene_file, tmp_path, [*range(1, size, stride), size], code=code, block=block)
    print(where)
    assert where.keys() >= {"run.json.spare", "particles", "grid", "step"}


@pytest.mark.parametrize(
    "name",
    [
        "run.json.spare",
        ".run.json.part",
        "scene.toml",
        "log.csv",
        "particles.pvd",
        "particles_",
        "step_",
        "profile",
    ],
)
def test_full_in_each_kind_of_file(quick, scene_file, tmp_path, monkeypatch, name):
    """Full disk at each kind of file, and from then on at every file."""
    out, write, full = tmp_path / "out", LimitedFile.write, []

    def fails(self: LimitedFile, data: Any) -> int:
        if full or name in re.sub(r"\.[0-9a-f]{16}\.part$", ".part", Path(self.path).name):
            full.append(self.path)
            self._disk.size = 0
        return write(self, data)

    monkeypatch.setattr(LimitedFile, "write", fails)
    with FullDisk(out, 10**9).mounted():
        record = go(scene_file, out)
    if name == "profile":  # not requested here
        assert record.status == "finished"
    elif name == "run.json.spare":
        assert record.status == "failed"
        assert not (out / "run.json").exists()
    else:
        ends_truly(out, record)


def test_a_reason_of_some_length_has_its_room(quick, tmp_path):
    with FullDisk(tmp_path, 20_000).mounted() as disk:
        atomic.reserve(tmp_path / "run.json", run_folder.LAST_WORDS)
        atomic.write_text(tmp_path / "run.json", "{}")
        disk.size = disk.used()
        with pytest.raises(OSError, match="No space left"):
            atomic.write_text(tmp_path / "scene.toml", "x")
        atomic.write_text(tmp_path / "run.json", "y" * run_folder.LAST_WORDS, spare=True)
    assert (tmp_path / "run.json").read_text() == "y" * run_folder.LAST_WORDS
    assert len(list(tmp_path.iterdir())) == 1


@contextmanager
def mounted(folder: Path, size: int) -> Iterator[None]:
    """Mount a disk of some size at a folder, as root."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if (
        sys.platform != "linux"
        or os.geteuid()
        or subprocess.run(command, capture_output=True, check=False).returncode
    ):
        pytest.skip("a disk can be mounted only by root")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize("left", [0, 12_288, 36_864, 53_248])
def test_a_real_disk(dots, scene_file, tmp_path, monkeypatch, left):
    """Real disk, whose free space is not known beforehand: others write there too."""
    monkeypatch.setattr(run_folder.RunFolder, "check_space", lambda self, needed: None)
    disk = tmp_path / "disk"
    with mounted(disk, 1 << 20):
        (disk / "others").write_bytes(bytes((1 << 20) - left))
        if left == 0:
            with pytest.raises(OutputError, match="No space left"):
                go(scene_file, disk / "out")
            return
        ends_truly(disk / "out", go(scene_file, disk / "out"))
        (disk / "others").unlink()
        assert go(
            scene_file,
            disk / "out",
            **({"resume": True} if (disk / "out" / "checkpoints").is_dir() else {"force": True}),
        ).steps


def test_a_disk_that_becomes_read_only(dots, scene_file, tmp_path):
    """Disk that becomes read-only: the run reports it and releases its folder."""
    disk = tmp_path / "disk"

    def before_step(simulation: Any, dt: float) -> None:
        if simulation.step_count == 5:
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=False)

    with mounted(disk, 1 << 20):
        dots.before_step = before_step
        record = go(scene_file, disk / "out")
        if record.status == "finished":
            pytest.skip("the disk cannot be made read-only while a file is open")
        assert record.status == "failed"
        assert "Read-only" in record.reason
        subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
        dots.before_step = lambda simulation, dt: None
        assert go(scene_file, disk / "out", resume=True).status == "finished"
