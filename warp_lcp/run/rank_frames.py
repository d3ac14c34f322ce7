"""Frames of several ranks: one part per rank, and files that list all parts."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Self

from warp_lcp.distributed.collective import Collective, on_root
from warp_lcp.files.atomic import make_folder
from warp_lcp.frames.frame_folder import FrameFolder, FrameWriter
from warp_lcp.frames.pieces import WHOLE, Kind, VtkPiece, describe, rank_folder, write_whole
from warp_lcp.simulation import Cells, Part, Stopwatch, Volume, VolumeGroup

Pieces = dict[str, VtkPiece]  # metadata of a rank's parts, by name


class RankFrames:
    """Frames of a run on several ranks.

    `frames/rank_0003/<name>_<index>.vtu` (or .vti), and `frames/<name>_<index>.pvtu` (.pvti).
    Volumes are gathered on one rank, and stored beside those.

    Args:
        whole: folder of the run's frames.
        collective: collective operations of the ranks.
    """

    def __init__(self, whole: FrameFolder, collective: Collective) -> None:
        """Inspect a run's folder; nothing is written before the first frame."""
        self.whole, self.collective = whole, collective
        self.frames = whole.frames
        self.pieces = self.frames / rank_folder(collective.ranks.rank)

    def write(self, index: int, time: float, frame: list[Part]) -> list[Path]:
        """Write this rank's parts of a frame.

        Args:
            index: the frame's number.
            time: time of the frame [s].
            frame: this rank's parts.

        Returns:
            Their files.

        Raises:
            OSError: a file cannot be written; the earlier ones are intact.
        """
        make_folder(self.pieces, within=self.whole.folder)
        folders = [
            self.frames if isinstance(part, Volume | VolumeGroup) else self.pieces for part in frame
        ]
        return [
            self.whole.write_part(folder / f"{part.name}_{index:06d}", part)
            for folder, part in zip(folders, frame, strict=True)
        ]

    @on_root
    def resume(self, times: list[float]) -> None:
        """Continue after the frames of `times`, as `FrameFolder.resume` does; collective."""
        self.whole.resume(times)

    def describe(self, frame: list[Part]) -> Pieces:
        """Return the metadata of this rank's parts.

        Raises:
            ValueError: a field has another length than its points or cells.
        """
        images: Kind = self.whole.grid_format
        return {
            part.name: describe(part, images if isinstance(part, Cells) else "vtu")
            for part in frame
            if not isinstance(part, Volume | VolumeGroup)
        }

    @on_root
    def publish(self, index: int, time: float, pieces: list[Pieces]) -> None:
        """Write the index files of a frame, and add it to the collections; collective.

        Args:
            index: the frame's number.
            time: time of the frame [s].
            pieces: metadata of every rank's parts, whose files exist.

        Raises:
            OSError: a file cannot be written.
        """
        for name in dict.fromkeys(name for those in pieces for name in those):
            of_ranks = [
                (rank_folder(rank), those[name])
                for rank, those in enumerate(pieces)
                if name in those
            ]
            found = [
                (f"{folder}/{name}_{index:06d}.{piece.kind}", piece) for folder, piece in of_ranks
            ]
            file = self.frames / f"{name}_{index:06d}.{WHOLE[found[0][1].kind]}"
            write_whole(file, found)
            self.whole.collect(name, time, file)


class RankFrameWriter:
    """Frame writer on each rank; errors of any rank are raised on all.

    Its methods are collective. A frame is published, in order, when all ranks have written their
    parts.

    Args:
        frames: frames of the run.
        watch: measures the writes of this rank.

    Attributes:
        newest: number of the newest published frame.
    """

    def __init__(self, frames: RankFrames, watch: Stopwatch) -> None:
        self.newest: int | None = None
        self._frames, self._collective, self._mine = (
            frames,
            frames.collective,
            FrameWriter(frames, watch),
        )
        self._waiting: deque[tuple[int, float, list[Pieces]]] = deque()

    def put(self, index: int, time: float, frame: list[Part]) -> None:
        """Queue a frame, see `FrameWriter.put`; collective.

        Raises:
            OSError: an earlier frame could not be written on some rank.
        """
        with self._collective.together():
            pieces = self._frames.describe(frame)
            self._mine.put(index, time, frame)
        self._waiting.append((index, time, self._collective.exchange(pieces)))
        self._publish()

    def check(self) -> None:
        """Raise earlier errors of any rank, without waiting for frames.

        Raises:
            OSError: a frame could not be written.
        """
        if self._waiting:  # equal on all ranks
            with self._collective.together():
                self._mine.check()
            self._publish()

    def flush(self) -> None:
        """Wait until every frame is on disk.

        Raises:
            OSError: a frame could not be written.
        """
        with self._collective.together():
            self._mine.flush()
        self._publish()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the thread, as `FrameWriter` does."""
        self._mine.end()
        if kind is None:
            self.flush()

    def _publish(self) -> None:
        done = min(
            -1 if written is None else written
            for written in self._collective.exchange(self._mine.newest)
        )
        while self._waiting and self._waiting[0][0] <= done:
            index, time, pieces = self._waiting.popleft()
            self._frames.publish(index, time, pieces)
            self.newest = index
