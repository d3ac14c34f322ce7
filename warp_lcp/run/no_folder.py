"""Run folder that writes nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from warp_lcp.distributed.collective import Collective
from warp_lcp.frames.frames import FrameWriter
from warp_lcp.run.folder import OutputError, RunFolder, RunRecord
from warp_lcp.run.log import Log, Value
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Part, Stopwatch


class NoLog(Log):
    """Log that discards its rows."""

    def __init__(self, columns: tuple[str, ...]) -> None:
        self.columns = columns

    def append(self, row: Mapping[str, Value]) -> None:
        """Do nothing."""

    def sync(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class NoFrames:
    """Frame folder that discards its frames."""

    def write(self, index: int, time: float, frame: list[Part]) -> list[Path]:
        """Do nothing."""
        return []


class NoFolder(RunFolder):
    """Run folder that writes nothing; for one process, never resumed.

    Args:
        scene: the scene of the run.
    """

    keeps = False

    def __init__(self, scene: Scene) -> None:
        self.scene, self.collective, self.mesh_files = scene, Collective.of_one(), {}

    @contextmanager
    def held(self, *, resume: bool) -> Iterator[list[str]]:
        """Yield no remarks.

        Raises:
            OutputError: there is no run to resume.
        """
        if resume:
            raise OutputError("resume: a run without a folder has no checkpoints")
        yield []

    def check_new(self, *, force: bool) -> None:
        """Do nothing: there is nothing to overwrite."""

    def start(self, record: RunRecord) -> None:
        """Do nothing."""

    def open_log(
        self, columns: tuple[str, ...], *, after_step: int | None = None, table: str = "log"
    ) -> NoLog:
        """Return a log that discards its rows."""
        return NoLog(columns)

    def frame_writer(self, watch: Stopwatch) -> FrameWriter:
        """Return a frame writer that discards its frames."""
        return FrameWriter(NoFrames(), watch)

    def write_record(self, record: RunRecord) -> None:
        """Do nothing."""
