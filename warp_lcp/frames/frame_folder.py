"""Frames of a run: VTU, VTI, NanoVDB, OpenVDB and PLY files, and PVD collections.

PVD collections list files with their times, for ParaView. Formats of meshio have no collection:
ParaView opens numbered files as a series.
"""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol, Self, cast

from warp_lcp.files.atomic import make_folder, write_text
from warp_lcp.frames.meshio_format import (
    SUFFIXES,
    FrameFormat,
    holds,
    kind_of,
    meshio_bytes,
    write_meshio,
)
from warp_lcp.frames.nvdb import nvdb_bytes, write_nvdb
from warp_lcp.frames.pieces import WHOLE, in_ranks, piece_files
from warp_lcp.frames.ply import ply_bytes, write_ply
from warp_lcp.frames.vdb import vdb_bytes, write_vdb
from warp_lcp.frames.vti import vti_bytes, write_vti
from warp_lcp.frames.vtu import vtu_bytes, write_vtu
from warp_lcp.simulation import (
    Cells,
    NoStopwatch,
    Part,
    Points,
    Stopwatch,
    Surface,
    Volume,
    VolumeGroup,
)

FRAME_FILE = re.compile(
    rf"(?P<name>[a-z][a-z_]*)_(?P<index>\d{{6,}})"
    rf"\.(?P<format>p?vtu|p?vti|n?vdb|{'|'.join(SUFFIXES.values())})"
)
COLLECTED = ("vtu", "vti", "pvtu", "pvti")  # formats that ParaView opens as a series
WAITING = 2  # frames in memory, including the one being written
END = b"</VTKFile>\n"  # end of complete files

GridFormat = Literal["vtu", "vti"]
# Writer and file size of a part, by format.
OWN_FORMATS: dict[str, tuple[Callable[..., None], Callable[..., int]]] = {
    "vtu": (write_vtu, vtu_bytes),
    "vti": (write_vti, vti_bytes),
    "nvdb": (write_nvdb, nvdb_bytes),
    "vdb": (write_vdb, vdb_bytes),
}


class FrameFolder:
    """Frames of one run: `frames/<name>_<index>.vtu` (or .vti, .nvdb, .vdb).

    Except for volumes, `<name>.pvd` beside the folder lists them.

    Args:
        folder: folder of the run.
        grid_format: format of the cells; "vtu": as the other parts.
        surface_ply: write surfaces as PLY files too.
        frame_format: format of particles, surfaces and bodies; a part without points is a VTU file
            if the format cannot store it.
    """

    def __init__(
        self,
        folder: Path,
        grid_format: GridFormat = "vtu",
        *,
        surface_ply: bool = False,
        frame_format: FrameFormat = "vtu",
    ) -> None:
        """Inspect a run's folder; nothing is written before the first frame."""
        self.folder = folder
        self.grid_format, self.surface_ply, self.frame_format = (
            grid_format,
            surface_ply,
            frame_format,
        )
        self.frames = folder / "frames"
        self._times: dict[str, list[tuple[float, str]]] = {}

    def write(self, index: int, time: float, frame: list[Part]) -> list[Path]:
        """Write a frame and add it to the collections.

        Args:
            index: the frame's number.
            time: time of the frame [s].
            frame: its parts.

        Returns:
            Its files.

        Raises:
            OSError: a file cannot be written; the earlier ones are intact.
        """
        make_folder(self.frames, within=self.folder)
        files = []
        for part in frame:
            file = self.write_part(self.frames / f"{part.name}_{index:06d}", part)
            files.append(file)
            if self.surface_ply and isinstance(part, Surface):
                files.append(file.with_suffix(".ply"))
                write_ply(files[-1], part)
            if self.has_collection(part):
                self.collect(part.name, time, file)
        return files

    def has_collection(self, part: Part) -> bool:
        """Return whether a part has a PVD collection.

        Collections list only files of VTK's XML formats.
        """
        if isinstance(part, Volume | VolumeGroup):
            return False
        return self.frame_format == "vtu" or (isinstance(part, Cells) and self.grid_format == "vti")

    def collect(self, name: str, time: float, file: Path) -> None:
        """Add the file of a frame's part to the part's collection.

        Raises:
            OSError: the collection cannot be written.
        """
        times = self._times.setdefault(name, [])
        times.append((time, f"frames/{file.name}"))
        write_text(self.folder / f"{name}.pvd", collection(times))

    def resume(self, times: list[float]) -> None:
        """Continue after the frames of `times`; delete later files.

        The collections then list the remaining frames.

        Args:
            times: times of the remaining frames, beginning with frame 0 [s].

        Raises:
            OSError: a file cannot be deleted or written.
        """
        self._times.clear()
        for file in sorted(in_ranks(self.frames)):
            match = FRAME_FILE.fullmatch(file.name)
            if match is None:
                continue
            index = int(match["index"])
            if index >= len(times):
                file.unlink()
            elif match["format"] in COLLECTED and file.parent == self.frames:
                self._times.setdefault(match["name"], []).append(
                    (times[index], f"frames/{file.name}")
                )
        for name, entries in self._times.items():
            if self.frame_format != "vtu" and not (self.folder / f"{name}.pvd").is_file():
                continue  # of a format without collections, whose VTU files are empty frames
            write_text(self.folder / f"{name}.pvd", collection(entries))

    def kinds(self, frame: Sequence[Part]) -> list[str]:
        """Return the kinds of files of a frame, for `missing`.

        The names of its parts, and those with `.ply` for parts with such a file.
        """
        return [part.name for part in frame] + [
            f"{part.name}.ply" for part in frame if self.surface_ply and isinstance(part, Surface)
        ]

    def missing(self, kind: str, count: int) -> list[int]:
        """Return the frames before `count` without a complete file of a kind.

        A file of ranks is complete if all of its parts exist.

        Raises:
            OSError: a file cannot be read.
        """
        present, name, is_beside = set(), kind.removesuffix(".ply"), kind.endswith(".ply")
        for file in self.frames.iterdir() if self.frames.is_dir() else ():
            match = FRAME_FILE.fullmatch(file.name)
            if match is None or match["name"] != name:
                continue
            # A file beside the frame's own.
            is_ply = match["format"] == "ply" and self.frame_format != "ply"
            if is_ply == is_beside and _is_whole(file):
                present.add(int(match["index"]))
        return sorted({*range(count)} - present)

    def write_part(self, path: Path, part: Part) -> Path:
        """Write a part to a path with the suffix of its format; return the file.

        Raises:
            OSError: the file cannot be written.
        """
        name = part_format(part, self.grid_format, self.frame_format)
        file = path.with_suffix(f".{SUFFIXES.get(name, name)}")
        if name in OWN_FORMATS:
            OWN_FORMATS[name][0](file, part)
        else:
            write_meshio(file, cast(Points | Cells | Surface, part), name)
        return file


class Frames(Protocol):
    """Interface of frame folders."""

    def write(self, index: int, time: float, frame: list[Part]) -> list[Path]:
        """Write frame `index` of a time [s]; return its files."""


class FrameWriter:
    """Write frames on a thread of its own while the simulation continues.

    At most WAITING frames are in memory.
    Errors are raised by every later call of `put`, `queue_files`,
    `check` or `flush`, and nothing is written after an error. The end of the `with` block waits for
    queued frames, whatever ended the block, and raises only if nothing else did.
    """

    def __init__(self, folder: Frames, watch: Stopwatch | None = None) -> None:
        self.newest: int | None = None  # number of the newest frame on disk
        self._folder = folder
        self._watch = watch or NoStopwatch()
        self._pending: deque[Future[None]] = deque()
        self._failed = False
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frames")

    def put(self, index: int, time: float, frame: list[Part]) -> None:
        """Queue a frame, whose arrays must not change; wait if the queue is full.

        Raises:
            OSError: an earlier frame could not be written.
        """

        def write() -> list[Path]:
            files = self._folder.write(index, time, frame)
            self.newest = index
            return files

        self.queue_files("frames, written", write)

    def queue_files(self, name: str, write: Callable[[], list[Path]]) -> None:
        """Queue a function that returns its files; wait if the queue is full.

        It is called after all earlier items are on disk.

        Args:
            name: name of the written data in the profile.
            write: the function.

        Raises:
            OSError: an earlier item could not be written.
        """
        while len(self._pending) >= WAITING:
            self._finish()
        self._pending.append(self._thread.submit(self._write, name, write))

    def check(self) -> None:
        """Raise earlier errors, without waiting.

        Raises:
            OSError: a frame could not be written.
        """
        while self._pending and self._pending[0].done():
            self._finish()

    def flush(self) -> None:
        """Wait until every frame is on disk.

        Raises:
            OSError: a frame could not be written.
        """
        while self._pending:
            self._finish()

    def end(self) -> None:
        """Wait for the queued frames, and accept no more."""
        self._thread.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end()
        if kind is None:
            self.flush()

    def _finish(self) -> None:
        """Wait for the oldest item; a failed one stays, to be raised again."""
        self._pending[0].result()
        self._pending.popleft()

    def _write(self, name: str, write: Callable[[], list[Path]]) -> None:
        if self._failed:  # after an error nothing later may be written
            return
        self._failed = True
        with self._watch.beside(name):
            files = write()
        self._watch.add_file_sizes(name, *files)
        self._failed = False


def frame_bytes(
    frame: list[Part],
    grid_format: GridFormat = "vtu",
    *,
    surface_ply: bool = False,
    frame_format: FrameFormat = "vtu",
) -> int:
    """Return the estimated size of the files of a frame [bytes]; an upper estimate.

    Args:
        frame: its parts.
        grid_format: format of the cells.
        surface_ply: count the PLY files of surfaces.
        frame_format: format of the other parts.
    """
    total = sum(ply_bytes(part) for part in frame if surface_ply and isinstance(part, Surface))
    for part in frame:
        name = part_format(part, grid_format, frame_format)
        total += (
            OWN_FORMATS[name][1](part)
            if name in OWN_FORMATS
            else meshio_bytes(cast(Points | Cells | Surface, part), name)
        )
    return total


def part_format(part: Part, grid_format: GridFormat, frame_format: FrameFormat = "vtu") -> str:
    """Return the format of a part's file; surfaces may also have a PLY file."""
    if isinstance(part, Volume):
        return "nvdb"
    if isinstance(part, VolumeGroup):
        return "vdb"
    if isinstance(part, Cells) and grid_format == "vti":
        return "vti"
    size = len(part.index if isinstance(part, Cells) else part.points)
    return (
        frame_format
        if frame_format == "vtu" or size or holds(frame_format, *kind_of(part)).empty
        else "vtu"
    )


def _is_whole(file: Path) -> bool:
    """Return whether a frame's file, and all parts that it lists, are complete."""
    try:
        return _has_end(file) and (
            file.suffix[1:] not in WHOLE.values() or all(map(_has_end, piece_files(file)))
        )
    except ValueError:
        return False


def _has_end(file: Path) -> bool:
    """Return whether a file exists and is not truncated."""
    if not file.is_file():
        return False
    with open(file, "rb") as stream:
        stream.seek(-min(file.stat().st_size, len(END)), os.SEEK_END)
        return stream.read() == END if file.suffix.endswith(("vtu", "vti")) else stream.tell() > 0


def collection(entries: list[tuple[float, str]]) -> str:
    """Return a PVD collection of files [s, path relative to the collection] as text."""
    lines = [
        f'    <DataSet timestep="{time!r}" group="" part="0" file="{file}"/>'
        for time, file in entries
    ]
    head = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <Collection>"]
    return "\n".join([*head, *lines, "  </Collection>", "</VTKFile>", ""])
