"""The folder of a run: what is in it, who may write there, and how the run ended."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from warp_lcp.driver.atomic import SUFFIX, write_text
from warp_lcp.driver.checkpoint import CHECKPOINT_FILE, Checkpoint, CheckpointFolder
from warp_lcp.driver.frames import FRAME_FILE, FrameFolder
from warp_lcp.driver.scene import Scene
from warp_lcp.driver.scene_file import differences, dump_scene, load_scene
from warp_lcp.driver.versions import versions

Status = Literal["running", "finished", "stopped", "failed"]

RECORD = "run.json"
OWN_FILES = re.compile(r"scene\.toml|run\.json|profile\.json|log\.csv|[a-z][a-z_]*\.pvd")
IMAGE_FILE = re.compile(r"(?:frame_\d{6,}|sheet)\.png")
OWN_FOLDERS = {"frames": FRAME_FILE, "checkpoints": CHECKPOINT_FILE, "images": IMAGE_FILE}


class OutputError(ValueError):
    """The output folder cannot take the run. The message says why and what to do."""


@dataclass
class RunRecord:
    """What run.json says of a run.

    Args:
        scene: the scene's name.
        simulator: what simulates it.
        device: where.
        status: how it ended, or that it has not.
        reason: why it ended.
        steps: taken since the scene's start.
        time: reached [s].
        frames: the number of the newest frame.
        resumed_from_step: the checkpoint that this part of the run continued, if it did.
        seconds: that this part of the run took.
        warnings: what the user should know about the results.
        versions: of the software.
    """

    scene: str
    simulator: str
    device: str
    status: Status = "running"
    reason: str = ""
    steps: int = 0
    time: float = 0.0
    frames: int = 0
    resumed_from_step: int | None = None
    seconds: float = 0.0
    warnings: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=versions)


class RunFolder:
    """scene.toml, run.json, log.csv, frames and checkpoints of one run."""

    def __init__(self, path: Path, scene: Scene) -> None:
        """Look at a folder, there or not; nothing is written yet."""
        self.path = path
        self.scene = scene
        self.log = path / "log.csv"
        self.frames = FrameFolder(path)
        self.checkpoints = CheckpointFolder(path / "checkpoints", fingerprint(scene))

    def check_new(self, *, force: bool) -> None:
        """Refuse what a new run may not overwrite, and folders that cannot be written.

        Args:
            force: an earlier run may go.

        Raises:
            OutputError: there is something in the folder, or it cannot be made or written.
        """
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path}: is not a folder")
        _probe(self.path)
        own, foreign = self._contents()
        if not own and not foreign:
            return
        if foreign or self.path / RECORD not in own:
            shown = ", ".join(str(path.relative_to(self.path)) for path in [*foreign, *own][:3])
            raise OutputError(f"{self.path}: holds files that are no run's ({shown}), which --force does not delete; choose another folder")
        if not force:
            raise OutputError(f"{self.path}: holds a run already; --resume continues it, --force deletes it, --out takes another folder")

    def start(self, record: RunRecord) -> None:
        """Begin a run in a folder that `check_new` found fit: what an earlier run left is deleted.

        Raises:
            OSError: a file cannot be deleted or written.
        """
        own, _ = self._contents()
        for file in sorted(own, key=lambda file: file.name == RECORD):  # last, so that a half-deleted run is still a run
            file.unlink()
        self.write_record(record)
        write_text(self.path / "scene.toml", dump_scene(self.scene))

    def resume(self) -> tuple[Checkpoint, list[str]]:
        """Return the checkpoint to continue from, and a warning for each newer one that cannot be used.

        Raises:
            OutputError: there is no run, its scene is another one, or no checkpoint is valid.
        """
        recorded = self.path / "scene.toml"
        if not recorded.is_file():
            raise OutputError(f"{self.path}: there is no run to resume")
        _probe(self.path)
        changes = [line for line in differences(load_scene(recorded), self.scene) if not re.match(r"time\.duration:|output\.", line)]
        if changes:
            raise OutputError(
                "\n  ".join([f"{self.path}: --resume needs the same scene; only time.duration and [output] may differ", *changes])
            )
        checkpoint, refused = self.checkpoints.newest()
        if checkpoint is None:
            reasons = refused or ["none was written"]
            raise OutputError("\n  ".join([f"{self.path}: no checkpoint to resume from; --force starts again", *reasons]))
        return checkpoint, refused

    def write_record(self, record: RunRecord) -> None:
        """Write run.json.

        Raises:
            OSError: the disk is full.
        """
        write_text(self.path / RECORD, json.dumps(asdict(record), indent=2) + "\n")

    def check_space(self, needed: int) -> None:
        """Refuse a run whose output does not fit.

        Args:
            needed: an estimate [bytes].

        Raises:
            OutputError: there is less free.
        """
        free = shutil.disk_usage(self.path).free
        if free < needed:
            raise OutputError(
                f"{self.path}: the run needs about {needed / 1e9:.3g} GB and {free / 1e9:.3g} GB are free; "
                "make room, choose another --out, or write less (time.frames_per_second, output.particles, output.grid)"
            )

    def _contents(self) -> tuple[list[Path], list[Path]]:
        """Return the files that a run makes, and everything else."""
        own: list[Path] = []
        foreign: list[Path] = []
        for path, pattern in _walk(self.path):
            name = path.name.removeprefix(".").removesuffix(SUFFIX) if path.name.endswith(SUFFIX) else path.name
            is_own = path.is_file() and not path.is_symlink() and pattern.fullmatch(name)
            (own if is_own else foreign).append(path)
        return own, foreign


def fingerprint(scene: Scene) -> str:
    """Return a digest of everything that must not change between the parts of a run: all but time.duration and [output]."""
    table = scene.model_dump(by_alias=True, exclude_none=True, exclude={"output": True, "time": {"duration"}})
    return hashlib.blake2b(json.dumps(table, sort_keys=True).encode(), digest_size=16).hexdigest()


def _walk(folder: Path) -> Iterator[tuple[Path, re.Pattern[str]]]:
    """Yield what is in a run's folder with the pattern of the names that a run writes there."""
    for path in folder.iterdir():
        if path.name in OWN_FOLDERS and path.is_dir() and not path.is_symlink():
            for file in path.iterdir():
                yield file, OWN_FOLDERS[path.name]
        else:
            yield path, OWN_FILES


def _probe(folder: Path) -> None:
    """Make the folder if it is not there, and see whether files can be written in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
            file.flush()
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
