"""Run folder: its files, write access, and the run's record."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal, get_type_hints

import numpy as np
from pydantic import TypeAdapter

from warp_lcp.distributed.collective import Collective, on_root
from warp_lcp.distributed.watchdog import POST
from warp_lcp.files import Tables
from warp_lcp.files.atomic import (
    SPARE,
    SUFFIX,
    TEMPORARY,
    make_folder,
    reserve,
    sync_folder,
    write_text,
)
from warp_lcp.files.size_limits import one_line
from warp_lcp.frames.frame_folder import FRAME_FILE, FrameFolder, FrameWriter
from warp_lcp.frames.pieces import in_ranks, remove_empty_ranks
from warp_lcp.run.checkpoint import (
    CHECKPOINT_FILE,
    PIECES,
    REFUSED_FILE,
    Checkpoint,
    CheckpointFolder,
)
from warp_lcp.run.continuation import (
    MAY_CHANGE,
    RESOLUTION,
    Change,
    differences,
    fingerprint,
    mesh_digests,
)
from warp_lcp.run.devices import versions
from warp_lcp.run.folder_lock import LOCK, FolderBusyError, locked
from warp_lcp.run.log import Log, OutputError
from warp_lcp.run.missing_outputs import gaps
from warp_lcp.run.rank_frames import RankFrames, RankFrameWriter
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import dump_scene, keys, load_scene, table_keys
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import Part, Stopwatch

Status = Literal["running", "finished", "stopped", "failed"]

RECORD = "run.json"
SCENE = "scene.toml"
ROUNDING = 1e-9
BEFORE = "during the first step"
# Room for the growth of run.json until the run ends, with the reason and warnings [bytes].
LAST_WORDS = 8192
OWN_FILES = re.compile(
    rf"scene\.toml|run\.json(?:{re.escape(SPARE)})?|profile\.json|(?:log|probes|forces)\.csv"
    rf"|[a-z][a-z_]*\.pvd|{POST}"
)
IMAGE_FILE = re.compile(r"(?:(?:frame|slice)_\d{6,}|sheet)\.png")
CHECKPOINTS = "checkpoints"
STORED_STATE = re.compile(f"{CHECKPOINT_FILE.pattern}|{REFUSED_FILE.pattern}")
OWN_FOLDERS = {"frames": FRAME_FILE, CHECKPOINTS: STORED_STATE, "images": IMAGE_FILE}


@dataclass
class RunRecord:
    """Record of a run, as in run.json.

    Args:
        scene: name of the scene.
        simulator: name of the simulator.
        device: name of the device.
        engine: engine that ran it, see `warp_lcp.run.devices`.
        ranks: number of processes.
        status: exit status, or that the run has not ended.
        reason: reason for the end.
        steps: number of steps since the scene's start.
        time: time reached [s].
        frames: number of the newest frame.
        resumed_from_step: step of the checkpoint from which this part of the run continued; 0 if
            there was none and it started from the beginning.
        changed: keys of the scene that have changed since the part before, with both values.
        resampled_from_resolution: domain.resolution of the checkpoint, if the state was resampled
            to another grid.
        mesh_files: digest of the content of each mesh file, by its key.
        overrides: `--set` options of this run, with the values of the scene's file, see
            `warp_lcp.run.resolve_scene`.
        seconds: wall time of this part of the run.
        warnings: warnings about the results.
        versions: versions of the software.
    """

    scene: str
    simulator: str
    device: str
    engine: str = "single"
    ranks: int = 1
    status: Status = "running"
    reason: str = ""
    steps: int = 0
    time: float = 0.0
    frames: int = 0
    resumed_from_step: int | None = None
    changed: list[str] = field(default_factory=list)
    resampled_from_resolution: int | None = None
    mesh_files: dict[str, str] = field(default_factory=dict)
    overrides: list[dict[str, str]] = field(default_factory=list)
    seconds: float = 0.0
    warnings: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=versions)


@dataclass(frozen=True)
class Continuation:
    """State from which a run continues.

    Args:
        checkpoint: the checkpoint; None if nothing was computed yet.
        remarks: remarks for the user, such as newer checkpoints that cannot be used.
        changed: a line for each key of the scene that has changed since the checkpoint was written.
        resampled_from: domain.resolution of the checkpoint, if the scene has another one.
    """

    checkpoint: Checkpoint | None
    remarks: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    resampled_from: int | None = None


class RunFolder:
    """Files of one run: scene.toml, run.json, log.csv, frames and checkpoints.

    On several ranks the root rank owns the folder and each rank adds its parts. Methods are
    collective, except `write_record`: an error on any rank is raised on all.

    Args:
        path: path of the folder, visible to all ranks.
        scene: the scene of the run.
        collective: collective operations of the ranks that share the run; None for one process.

    Raises:
        SceneError: a mesh file of the scene cannot be read.
    """

    def __init__(self, path: Path, scene: Scene, collective: Collective | None = None) -> None:
        """Inspect a folder, which need not exist; nothing is written yet."""
        self.path, self.scene, self.log = path, scene, path / "log.csv"
        self.collective, self._shared = (
            collective or Collective.for_one_process(),
            collective is not None,
        )
        with self.collective.together():
            self.mesh_files = mesh_digests(scene)
        output = scene.output
        whole = FrameFolder(
            path, output.grid_format, surface_ply=output.surface_ply, frame_format=output.format
        )
        self.frames = RankFrames(whole, collective) if collective else whole
        self.checkpoints = CheckpointFolder(
            path / CHECKPOINTS, fingerprint(scene, self.mesh_files), keys(scene), collective
        )

    @contextmanager
    def held(self, *, resume: bool) -> Iterator[list[str]]:
        """Hold the lock of the folder, which is created if needed; yield remarks.

        Args:
            resume: a run must exist.

        Raises:
            OutputError: the folder cannot be created or written, another process runs there, or
                there is no run to resume.
        """
        with ExitStack() as stack:
            yield self._lock(stack, resume) or []

    @on_root
    def _lock(self, stack: ExitStack, resume: bool) -> list[str]:
        """Lock the folder until a stack is closed; return remarks."""
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path}: is not a folder")
        if resume:
            self._check_run()
        _probe(self.path)
        try:
            return stack.enter_context(locked(self.path))
        except FolderBusyError as error:
            raise OutputError(str(error)) from error
        except OSError as error:
            raise OutputError(
                f"{error.filename or self.path}: cannot be written: {error.strerror}"
            ) from error

    @on_root
    def check_new(self, *, force: bool) -> None:
        """Raise an error if a new run would overwrite files, or cannot write.

        Only files of an earlier run may be overwritten.

        Args:
            force: an earlier run may be overwritten.

        Raises:
            OutputError: the folder is not empty, or it cannot be created or written.
        """
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path}: is not a folder")
        _probe(self.path)
        own_files, foreign = self._contents()
        # Empty, or a run that was killed while it wrote its first files.
        if not foreign and all(path.name.startswith(f".{RECORD}") for path in own_files):
            return
        if foreign or not holds_run(self.path):
            shown = ", ".join(
                one_line(str(path.relative_to(self.path))) for path in [*foreign, *own_files][:3]
            )
            raise OutputError(
                f"{self.path}: holds files that do not belong to a run ({shown}), which --force "
                "does not delete; choose another folder"
            )
        if not force:
            raise OutputError(
                f"{self.path}: holds a run already; use --resume to continue it, --force to delete "
                "it, or --out for another folder"
            )

    def start(self, record: RunRecord) -> None:
        """Start a run in a checked folder; files of an earlier run are deleted.

        Raises:
            OSError: a file cannot be deleted or written.
            OutputError: ranks do not see the same folder.
        """
        self._start(record)
        self._check_shared()

    @on_root
    def _start(self, record: RunRecord) -> None:
        """Delete files of an earlier run, and write scene and record."""
        own, _ = self._contents()
        # Checkpoints first, so that a half-deleted run is not continued.
        own.sort(key=lambda file: file.parent.name != CHECKPOINTS)
        for file in own:
            if file.name != RECORD:  # replaced below: the folder always has a record
                file.unlink()
        for name in OWN_FOLDERS:
            if (self.path / name).is_dir():
                # Before there is a run to which the old files could seem to belong.
                sync_folder(self.path / name)
            remove_empty_ranks(self.path / name)
        self.write_record(record)
        write_text(self.path / SCENE, dump_scene(self.scene))

    def resume(self) -> Continuation:
        """Return the newest valid checkpoint to continue from; the same on all ranks.

        Raises:
            OutputError: there is no run, its scene is another one, or no checkpoint is valid.
        """
        while True:
            continuation: Continuation | None = self._continuation()
            if continuation is not None and not self._shared:
                return continuation
            saved_state: Mapping[str, np.ndarray] = {}
            # The states are too large for a message.
            if (
                continuation
                and continuation.checkpoint
                and PIECES not in continuation.checkpoint.state
            ):
                saved_state, continuation = (
                    continuation.checkpoint.state,
                    replace(continuation, checkpoint=replace(continuation.checkpoint, state={})),
                )
            continued = self.collective.share(continuation)
            assert continued is not None, "of the root rank"
            checkpoint = continued.checkpoint
            if checkpoint is None or (checkpoint.state and self.checkpoints.complete(checkpoint)):
                return continued
            if not checkpoint.state:
                with self.collective.together():
                    state = (
                        saved_state
                        if self.collective.ranks.is_root
                        else self.checkpoints.read(checkpoint.step).state
                    )
                return replace(continued, checkpoint=replace(checkpoint, state=state))

    @on_root
    def _continuation(self) -> Continuation:
        """Return the checkpoint to continue from, and remarks, on the root rank."""
        self._check_run()
        self._check_same_scene()
        checkpoint, refused = self.checkpoints.newest()
        if checkpoint is None and not refused and not self._has_steps():
            return Continuation(
                None, [f"{self.path}: the interrupted run had no checkpoint; it starts again"]
            )
        if checkpoint is None:
            reasons = refused or ["none was written"]
            raise OutputError(
                "\n  ".join(
                    [f"{self.path}: no checkpoint to resume from; --force starts again", *reasons]
                )
            )
        end = self.scene.time.frame_time(self.scene.time.frame_count)
        if checkpoint.time > end * (1.0 + ROUNDING):
            raise OutputError(
                f"{self.path}: time.duration = {self.scene.time.duration:g} s is less than the "
                f"checkpoint's time, {checkpoint.time:.6g} s: "
                "frames would be lost; choose a longer duration"
            )
        missing = [
            name
            for name, found in (
                (RECORD, read_record(self.path)),
                (SCENE, recorded_keys(self.path / SCENE)),
            )
            if not found
        ]
        remarks = [
            *refused,
            *self._other_versions(),
            *(f"{name}: was missing or damaged; rewritten" for name in missing),
        ]
        if RECORD in missing:
            remarks.append(
                "earlier --set values are unknown: pass them again, else those of the scene are "
                "used"
            )
        if refused:
            remarks.append(
                f"continuing from step {checkpoint.step} instead; refused checkpoints stay as "
                "checkpoints/refused_*.npz"
            )
        now = keys(self.scene)
        before = checkpoint.keys or now
        steps = differences(before, now, Change.OTHER_STEPS)
        if steps:
            remarks.append(
                f"from step {checkpoint.step} on, steps differ from those of the original run: "
                f"{'; '.join(steps)}"
            )
        old = int(before.get(RESOLUTION, now[RESOLUTION]))
        changed = differences(before, now, Change.SAME_STEPS, Change.OTHER_STEPS, Change.RESAMPLED)
        return Continuation(checkpoint, remarks, changed, None if old == now[RESOLUTION] else old)

    def gaps(
        self,
        tables: Mapping[str, tuple[str, ...]],
        step: int,
        times: list[float],
        frame: list[Part],
    ) -> list[str]:
        """Return a line for each gap in the files up to a step; see `run.gaps`.

        Raises:
            OSError: a file cannot be read.
            OutputError: the log has other columns.
        """
        return self._gaps(tables, step, times, frame) or []

    @on_root
    def _gaps(
        self,
        tables: Mapping[str, tuple[str, ...]],
        step: int,
        times: list[float],
        frame: list[Part],
    ) -> list[str]:
        whole = self.frames.whole if isinstance(self.frames, RankFrames) else self.frames
        logs = {self.log.with_stem(name): columns for name, columns in tables.items()}
        return gaps(logs, whole, self.checkpoints, step=step, times=times, frame=frame)

    def is_missing_files(self, index: int, frame: list[Part]) -> bool:
        """Return whether a file of a frame, as the run would write it, is missing or cut.

        Raises:
            OSError: a file cannot be read.
        """
        return bool(self.collective.share(self._is_missing_files(index, frame)))

    @on_root
    def _is_missing_files(self, index: int, frame: list[Part]) -> bool:
        whole = self.frames.whole if isinstance(self.frames, RankFrames) else self.frames
        return any(index in whole.missing(kind, index + 1) for kind in whole.kinds(frame))

    def prepare_continuation(self, record: RunRecord, step: int) -> None:
        """Prepare a checked folder to continue after a step; delete incomplete files.

        Raises:
            OSError: a file cannot be written, renamed or deleted.
            OutputError: ranks do not see the same folder.
        """
        self._prepare_continuation(record, step)
        self._check_shared()

    @on_root
    def _prepare_continuation(self, record: RunRecord, step: int) -> None:
        self.write_record(record)
        write_text(self.path / SCENE, dump_scene(self.scene))
        for file in (path for path, _ in _walk(self.path) if TEMPORARY.fullmatch(path.name)):
            if file.name != f".{RECORD}{SPARE}{SUFFIX}":
                file.unlink()
        self.checkpoints.set_aside(step)

    def open_log(
        self, columns: tuple[str, ...], *, after_step: int | None = None, table: str = "log"
    ) -> Log:
        """Open the log, or another table, at its start or after a step, see `Log`."""
        return Log(
            self.log.with_stem(table), columns, after_step=after_step, collective=self.collective
        )

    def frame_writer(self, watch: Stopwatch) -> FrameWriter | RankFrameWriter:
        """Return the frame writer, which writes while the simulation continues."""
        return (
            RankFrameWriter(self.frames, watch)
            if isinstance(self.frames, RankFrames)
            else FrameWriter(self.frames, watch)
        )

    def write_record(self, record: RunRecord) -> None:
        """Write run.json.

        At the start, room for the final record is reserved, so that it can be written on a full
        disk.

        Raises:
            OSError: the disk is full before the run begins, or cannot be written at all; on the
                root rank.
        """
        if not self.collective.ranks.is_root:
            return
        text, begins = json.dumps(asdict(record), indent=2) + "\n", record.status == "running"
        if begins:
            reserve(self.path / RECORD, len(text) + LAST_WORDS)
        write_text(self.path / RECORD, text, spare=not begins)

    def check_space(self, needed: int) -> None:
        """Raise an error if the output of a run does not fit on the disk.

        Args:
            needed: estimated output of this rank [bytes].

        Raises:
            OutputError: less is free.
        """
        self._check_space(sum(self.collective.exchange(needed)))

    @on_root
    def _check_space(self, needed: int) -> None:
        free = shutil.disk_usage(self.path).free
        if free < needed:
            raise OutputError(
                f"{self.path}: the run needs about {needed / 1e9:.3g} GB and {free / 1e9:.3g} GB "
                "are free; "
                "make room, choose another --out, or write less (time.frames_per_second, "
                "output.particles, output.grid)"
            )

    def _check_shared(self) -> None:
        """Raise an error if ranks do not see the folder of the root rank."""
        with self.collective.together():
            if not (self.path / RECORD).is_file():
                raise OutputError(
                    f"{self.path}: is not the folder that rank 0 writes; choose one that all "
                    "machines share"
                )
            if self.collective.watchdog:
                self.collective.watchdog.post_in(self.path)

    def _check_run(self) -> None:
        """Raise an error if the folder has no run, or foreign entries in its place."""
        if not holds_run(self.path):
            raise OutputError(f"{self.path}: there is no run to resume")
        wrong = [
            self.path / name
            for name in OWN_FOLDERS
            if (self.path / name).exists() and not (self.path / name).is_dir()
        ]
        wrong += [
            path for path in (self.path / RECORD, self.path / SCENE, self.log) if path.is_dir()
        ]
        if wrong:
            kind = (
                "is a folder, expected a file"
                if wrong[0].is_dir()
                else "is a file, expected a folder"
            )
            raise OutputError(f"{wrong[0]}: {kind}; move it away")
        links = [
            path
            for path, pattern in _walk(self.path)
            if path.is_symlink() and _is_of_run(path, self.path, pattern)
        ]
        if links:
            raise OutputError(
                f"{links[0]}: is a link: a run writes only into its own folder; move it away"
            )

    def _check_same_scene(self) -> None:
        """Raise an error if fixed keys, or the content of mesh files, have changed."""
        before, now = recorded_keys(self.path / SCENE), keys(self.scene)
        files = read_record(self.path).get("mesh_files", {})
        if before is None:  # killed before it was written: the checkpoints have the fingerprint
            before = now
        for key, digest in self.mesh_files.items():
            if files.get(key) == digest:
                before[key] = now[key]  # the same mesh at another path
            elif key in files and before.get(key) == now[key]:
                raise OutputError(
                    f"{self.path}: {key} = {now[key]!r}: the content of the file has changed since "
                    "the run began; restore it, or "
                    "start again with --force"
                )
        changes = differences(before, now, Change.REFUSED)
        if changes:
            head = f"{self.path}: --resume needs the same scene, but these keys have changed"
            raise OutputError("\n  ".join([head, *changes, f"may change: {MAY_CHANGE}"]))

    def _has_steps(self) -> bool:
        """Return whether the log, a frame or the record shows a step."""
        rows = self.log.read_bytes().count(b"\n") if self.log.is_file() else 0
        later = any(
            match and int(match["index"])
            for match in map(
                FRAME_FILE.fullmatch, (file.name for file in in_ranks(self.frames.frames))
            )
        )
        return rows > 1 or later or bool(read_record(self.path).get("steps"))

    def _other_versions(self) -> list[str]:
        """Return a remark if the run began with other software versions.

        Results may then differ in bits.
        """
        before, now = read_record(self.path).get("versions", {}), versions()
        now.pop("platform", None)  # it has the version of the kernel, not the processor
        other = [
            f"{name} {before[name]}, now {now[name]}"
            for name in sorted(before.keys() & now.keys())
            if before[name] != now[name]
        ]
        return (
            [
                f"written with other software ({'; '.join(other)}): results may not be bitwise "
                "identical"
            ]
            if other
            else []
        )

    def _contents(self) -> tuple[list[Path], list[Path]]:
        """Return the files of runs, and all other files."""
        own_files: list[Path] = []
        foreign: list[Path] = []
        for path, pattern in _walk(self.path):
            is_own = (
                path.is_file()
                and not path.is_symlink()
                and pattern.fullmatch(_written_as(path.name))
            )
            (own_files if is_own else foreign).append(path)
        return own_files, foreign


def holds_run(folder: Path) -> bool:
    """Return whether a folder holds a run: its record, or a checkpoint."""
    return (folder / RECORD).is_file() or any(
        CHECKPOINT_FILE.fullmatch(file.name) for file in folder.glob(f"{CHECKPOINTS}/*")
    )


def mark_ended(folder: Path, status: Status, reason: str) -> None:
    """Write the end of a run into run.json, if it says that the run is running."""
    with suppress(OSError):
        record = read_record(folder)
        if record.get("status") == "running":
            write_text(
                folder / RECORD,
                json.dumps({**record, "status": status, "reason": reason}, indent=2) + "\n",
                spare=True,
            )


def read_record(folder: Path) -> Tables:
    """Return the content of run.json; empty if it cannot be read or is invalid."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        for key, kind in _record_types().items():
            if key in record:
                kind.validate_python(record[key])
    except (OSError, ValueError, RecursionError, TypeError):
        return {}
    return record if isinstance(record, dict) else {}


@cache
def _record_types() -> dict[str, TypeAdapter[object]]:
    """Return the validators of the values of a record."""
    return {key: TypeAdapter(hint) for key, hint in get_type_hints(RunRecord).items()}


def recorded_keys(path: Path) -> Tables | None:
    """Return the keys of the scene of a run; None without a valid file."""
    try:
        return keys(load_scene(path))
    except SceneError:
        pass  # a mesh may have been moved; the file itself is still valid
    try:
        found = table_keys(tomllib.loads(path.read_text(encoding="utf-8")))
        return found if "scene.simulator" in found else None
    except (OSError, ValueError, RecursionError):
        return None


def _walk(folder: Path) -> Iterator[tuple[Path, re.Pattern[str]]]:
    """Yield the files of a run's folder, with the pattern of valid names."""
    for path in folder.iterdir():
        if path.name in OWN_FOLDERS and path.is_dir() and not path.is_symlink():
            for file in in_ranks(path):
                yield file, OWN_FOLDERS[path.name]
        elif path.name != LOCK:
            yield path, OWN_FILES


def _is_of_run(path: Path, folder: Path, pattern: re.Pattern[str]) -> bool:
    """Return whether a file in a run's folder belongs to the run.

    In the run's own subfolders all files do, beside them only known names.
    """
    return (
        path.parent != folder
        or path.name in OWN_FOLDERS
        or pattern.fullmatch(_written_as(path.name)) is not None
    )


def _written_as(name: str) -> str:
    """Return the final name of a temporary file; other names are unchanged."""
    temporary = TEMPORARY.fullmatch(name)
    return temporary["name"] if temporary else name


def _probe(folder: Path) -> None:
    """Create the folder if needed, and check that it is writable."""
    try:
        make_folder(folder)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
