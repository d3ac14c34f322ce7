"""Frames that several ranks write: each its own pieces, and the first one the files that name them all."""

from __future__ import annotations

from collections import deque
from pathlib import Path

from warp_lcp.distributed.meeting import Meeting
from warp_lcp.frames.atomic import make_folder
from warp_lcp.frames.frames import FrameFolder, FrameWriter, GridFormat
from warp_lcp.frames.pieces import WHOLE, Kind, Piece, describe, rank_folder, write_whole
from warp_lcp.simulation import Cells, Part, Stopwatch, Volume

Pieces = dict[str, Piece]  # of a rank, by their parts' names


class ParallelFrames(FrameFolder):
    """The frames of a run on several ranks: `frames/rank_0003/<name>_<index>.vtu` (or .vti), and `frames/<name>_<index>.pvtu` (.pvti).

    Args:
        folder: of the run.
        grid_format: of the cells.
        meeting: of the ranks.
    """

    def __init__(self, folder: Path, grid_format: GridFormat, meeting: Meeting) -> None:
        """Look at a run's folder; nothing is written before the first frame."""
        super().__init__(folder, grid_format)
        self.meeting = meeting
        self.pieces = self.frames / rank_folder(meeting.ranks.rank)

    def write(self, index: int, time: float, frame: list[Part]) -> list[Path]:
        """Write the rank's pieces of a frame.

        Args:
            index: the frame's number.
            time: of the frame [s].
            frame: what the rank has of it.

        Returns:
            Their files.

        Raises:
            OSError: a file cannot be written; the earlier ones are intact.
        """
        make_folder(self.pieces)
        return [self.write_part(self.pieces / f"{part.name}_{index:06d}", part) for part in frame]

    def resume(self, times: list[float]) -> None:
        """Continue after the frames of `times`, as `FrameFolder.resume` does; collective."""
        with self.meeting.led():
            if self.meeting.ranks.first:
                super().resume(times)

    def describe(self, frame: list[Part]) -> Pieces:
        """Return what there is to say of the rank's pieces.

        Raises:
            ValueError: a field has another length than its points or cells.
        """
        images: Kind = self.grid_format
        return {part.name: describe(part, images if isinstance(part, Cells) else "vtu") for part in frame if not isinstance(part, Volume)}

    def publish(self, index: int, time: float, pieces: list[Pieces]) -> None:
        """Write the files of a whole frame, and add it to the collections.

        Args:
            index: the frame's number.
            time: of the frame [s].
            pieces: of every rank, whose files are there.

        Raises:
            OSError: a file cannot be written.
        """
        for name in dict.fromkeys(name for those in pieces for name in those):
            of_ranks = [(rank_folder(rank), those[name]) for rank, those in enumerate(pieces) if name in those]
            found = [(f"{folder}/{name}_{index:06d}.{piece.kind}", piece) for folder, piece in of_ranks]
            file = self.frames / f"{name}_{index:06d}.{WHOLE[found[0][1].kind]}"
            write_whole(file, found)
            self.collect(name, time, file)


class ParallelFrameWriter(FrameWriter):
    """A FrameWriter on each rank. Its methods are collective: what goes wrong with a rank's pieces is raised on all.

    A frame is published, as a whole and in order, when all ranks have written their pieces.

    Args:
        folder: of the frames.
        watch: measures what this rank writes.
    """

    def __init__(self, folder: ParallelFrames, watch: Stopwatch) -> None:
        """Begin without frames."""
        super().__init__(folder, watch)
        self._whole, self._meeting = folder, folder.meeting
        self._published: int | None = None
        self._waiting: deque[tuple[int, float, list[Pieces]]] = deque()

    @property
    def newest(self) -> int | None:
        """The number of the newest frame that is there as a whole."""
        return self._published

    def put(self, index: int, time: float, frame: list[Part]) -> None:
        """Hand over a frame, whose arrays nobody changes any more; wait if there are too many already.

        Raises:
            OSError: an earlier frame could not be written on some rank.
        """
        with self._meeting.together():
            pieces = self._whole.describe(frame)
            super().put(index, time, frame)
        self._waiting.append((index, time, self._meeting.exchange(pieces)))
        self._publish()

    def check(self) -> None:
        """Raise what went wrong so far on any rank, without waiting for frames.

        Raises:
            OSError: a frame could not be written.
        """
        if self._waiting:  # as on every rank
            with self._meeting.together():
                super().check()
            self._publish()

    def flush(self) -> None:
        """Wait until every frame is on disk.

        Raises:
            OSError: a frame could not be written.
        """
        with self._meeting.together():
            super().flush()
        self._publish()

    def _publish(self) -> None:
        done = min(-1 if written is None else written for written in self._meeting.exchange(self.written))
        while self._waiting and self._waiting[0][0] <= done:
            index, time, pieces = self._waiting.popleft()
            with self._meeting.led():
                if self._meeting.ranks.first:
                    self._whole.publish(index, time, pieces)
            self._published = index
