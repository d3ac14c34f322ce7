"""The folder of a run that several ranks share: the first one owns it, and each adds its pieces."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from warp_lcp.distributed.meeting import Meeting
from warp_lcp.frames.frames import FrameWriter
from warp_lcp.run.checkpoint import PIECES
from warp_lcp.run.folder import CHECKPOINTS, RECORD, Continuation, OutputError, RunFolder, RunRecord
from warp_lcp.run.log import Log, Value
from warp_lcp.run.parallel_checkpoint import ParallelCheckpoints
from warp_lcp.run.parallel_frames import ParallelFrames, ParallelFrameWriter
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Part, Stopwatch


class ParallelLog(Log):
    """A log that the first rank writes; `append` and `sync` are collective, so that a full disk ends all.

    Args:
        path: the file.
        columns: as of `Log`.
        meeting: of the ranks.
        after_step: as of `Log`.
    """

    def __init__(self, path: Path, columns: tuple[str, ...], meeting: Meeting, *, after_step: int | None = None) -> None:
        """Begin a log, or continue one.

        Raises:
            OSError: the file cannot be written.
            OutputError: the existing file has other columns.
        """
        self.columns = columns
        self._meeting = meeting
        with meeting.led():
            if meeting.ranks.first:
                try:
                    super().__init__(path, columns, after_step=after_step)
                except ValueError as error:
                    raise OutputError(str(error)) from error

    def append(self, row: Mapping[str, Value]) -> None:
        """Write a row; columns that it lacks are empty.

        Raises:
            OSError: the disk is full.
            ValueError: the row has a value for a column that the log lacks.
        """
        with self._meeting.led():
            if self._meeting.ranks.first:
                super().append(row)

    def sync(self) -> None:
        """Wait until the rows are on the disk.

        Raises:
            OSError: the disk is full.
        """
        with self._meeting.led():
            if self._meeting.ranks.first:
                super().sync()

    def close(self) -> None:
        """Close the file."""
        if self._meeting.ranks.first:
            super().close()


class ParallelRunFolder(RunFolder):
    """A RunFolder on each of several ranks. Its methods are collective, and raise on all ranks what fails on any.

    Args:
        path: of the folder, which all ranks see.
        scene: what runs.
        meeting: of the ranks.

    Raises:
        SceneError: a mesh file of the scene cannot be read.
    """

    checkpoints: ParallelCheckpoints
    frames: ParallelFrames

    def __init__(self, path: Path, scene: Scene, meeting: Meeting) -> None:
        """Look at a folder, there or not; nothing is written yet."""
        with meeting.together():
            super().__init__(path, scene)
        self.meeting = meeting
        self._first = meeting.ranks.first
        self.frames = ParallelFrames(path, scene.output.grid_format, meeting)
        self.checkpoints = ParallelCheckpoints(path / CHECKPOINTS, self.checkpoints.fingerprint, self.checkpoints.keys, meeting)

    @contextmanager
    def held(self, *, resume: bool) -> Iterator[list[str]]:
        """Keep other processes out of the folder, as `RunFolder.held` does."""
        with ExitStack() as stack:
            remarks: list[str] = []
            with self.meeting.led():
                if self._first:
                    remarks = stack.enter_context(super().held(resume=resume))
            yield remarks

    def check_new(self, *, force: bool) -> None:
        """Refuse what a new run may not overwrite, as `RunFolder.check_new` does."""
        with self.meeting.led():
            if self._first:
                super().check_new(force=force)

    def check_space(self, needed: int) -> None:
        """Refuse a run whose output does not fit.

        Args:
            needed: an estimate of what this rank writes [bytes].
        """
        total = sum(self.meeting.exchange(needed))
        with self.meeting.led():
            if self._first:
                super().check_space(total)

    def start(self, record: RunRecord) -> None:
        """Begin a run, as `RunFolder.start` does."""
        with self.meeting.led():
            if self._first:
                super().start(record)
        self._check_shared()

    def resume(self) -> Continuation:
        """Return where to continue: the newest checkpoint of which all pieces are valid; one of a single process is on all ranks.

        Raises:
            OutputError: there is no run, its scene is another one, or no checkpoint is valid.
        """
        while True:
            found: Continuation | None = None
            whole: Mapping[str, np.ndarray] = {}
            with self.meeting.led():
                if self._first:
                    found = super().resume()
                    if found.checkpoint is not None and PIECES not in found.checkpoint.state:  # too much for a message
                        whole, found = found.checkpoint.state, replace(found, checkpoint=replace(found.checkpoint, state={}))
            continued: Continuation = self.meeting.share(found)
            checkpoint = continued.checkpoint
            if checkpoint is None:
                return continued
            if checkpoint.state:
                if self.checkpoints.complete(checkpoint):
                    return continued
                continue
            with self.meeting.together():
                state = whole if self._first else self.checkpoints.read(checkpoint.step).state
            return replace(continued, checkpoint=replace(checkpoint, state=state))

    def gaps(self, columns: tuple[str, ...], step: int, times: list[float], frame: list[Part]) -> list[str]:
        """Return a line for what the folder lacks, as `RunFolder.gaps` does."""
        with self.meeting.led():
            return super().gaps(columns, step, times, frame) if self._first else []

    def go_on(self, record: RunRecord, step: int) -> None:
        """Begin to write behind a step, as `RunFolder.go_on` does."""
        with self.meeting.led():
            if self._first:
                super().go_on(record, step)
        self._check_shared()

    def _check_shared(self) -> None:
        """Refuse a folder that the first rank has begun to write and that others do not see.

        Raises:
            OutputError: the machine of a rank has another folder of that name, or none.
        """
        with self.meeting.together():
            if not (self.path / RECORD).is_file():
                raise OutputError(f"{self.path}: is not the folder that rank 0 writes; choose one that all machines share")

    def open_log(self, columns: tuple[str, ...], *, after_step: int | None = None) -> Log:
        """Begin the log or continue it."""
        return ParallelLog(self.log, columns, self.meeting, after_step=after_step)

    def frame_writer(self, watch: Stopwatch) -> FrameWriter:
        """Return what writes the frames while the simulation goes on."""
        return ParallelFrameWriter(self.frames, watch)

    def write_record(self, record: RunRecord) -> None:
        """Write run.json; the only method that is not collective.

        Raises:
            OSError: the disk is full; on the first rank.
        """
        if self._first:
            super().write_record(record)
