"""Frames as ParaView opens them: VTU files, and PVD collections that give each its time."""

from __future__ import annotations

import base64
import re
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from warp_lcp.driver.atomic import replacing, write_text
from warp_lcp.driver.profile import NoStopwatch, Stopwatch
from warp_lcp.driver.simulator import Cells, Part, Points, Surface

FRAME_FILE = re.compile(r"(?P<name>[a-z][a-z_]*)_(?P<index>\d{6,})\.vtu")

# Corners of a cell in VTK's order for quadrilaterals (the first four) and hexahedra, as x, y, z.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
BASE64 = 4 / 3  # what the encoding adds to the bytes
VTK_TYPES = {1: 1, 2: 3, 3: 5, 4: 9, 8: 12}  # vertex, line, triangle, quadrilateral and hexahedron by their corners
WAITING = 2  # frames in memory, the one being written included


class FrameFolder:
    """The frames of one run: `frames/<name>_<index>.vtu` and `<name>.pvd` beside the folder."""

    def __init__(self, folder: Path) -> None:
        """Look at a run's folder; nothing is written before the first frame."""
        self.folder = folder
        self.frames = folder / "frames"
        self._times: dict[str, list[tuple[float, str]]] = {}

    def write(self, index: int, time: float, frame: list[Part]) -> list[Path]:
        """Write a frame and add it to the collections.

        Args:
            index: the frame's number.
            time: of the frame [s].
            frame: what it shows.

        Returns:
            Its files.

        Raises:
            OSError: a file cannot be written; the earlier ones are intact.
        """
        self.frames.mkdir(exist_ok=True)
        files = []
        for part in frame:
            file = self.frames / f"{part.name}_{index:06d}.vtu"
            write_vtu(file, part)
            times = self._times.setdefault(part.name, [])
            times.append((time, f"frames/{file.name}"))
            write_text(self.folder / f"{part.name}.pvd", collection(times))
            files.append(file)
        return files

    def resume(self, times: list[float]) -> None:
        """Continue after the frames of `times`: later files are deleted, the collections are those of the frames that are there.

        Args:
            times: of the frames that stay, beginning with frame 0 [s].

        Raises:
            OSError: a file cannot be deleted or written.
        """
        self._times.clear()
        for file in sorted(self.frames.glob("*.vtu")):
            match = FRAME_FILE.fullmatch(file.name)
            if match is None:
                continue
            index = int(match["index"])
            if index >= len(times):
                file.unlink()
            else:
                self._times.setdefault(match["name"], []).append((times[index], f"frames/{file.name}"))
        for name, entries in self._times.items():
            write_text(self.folder / f"{name}.pvd", collection(entries))


class FrameWriter:
    """Write frames on a thread of its own while the simulation goes on; at most WAITING frames are in memory.

    What goes wrong there is raised by every later call of `put`, `check` or `flush`, and no later frame is written. Leaving the `with`
    block waits for the frames that were put, whatever ended the block, and raises only if nothing else did.
    """

    def __init__(self, folder: FrameFolder, watch: Stopwatch | None = None) -> None:
        """Begin without frames."""
        self.newest: int | None = None  # the number of the newest frame that this writer brought to disk
        self._folder = folder
        self._watch = watch or NoStopwatch()
        self._pending: deque[Future[None]] = deque()
        self._failed = False
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frames")

    def put(self, index: int, time: float, frame: list[Part]) -> None:
        """Hand over a frame, whose arrays nobody changes any more; wait if there are too many already.

        Raises:
            OSError: an earlier frame could not be written.
        """
        while len(self._pending) >= WAITING:
            self._finish()
        self._pending.append(self._thread.submit(self._write, index, time, frame))

    def check(self) -> None:
        """Raise what went wrong so far, without waiting.

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

    def __enter__(self) -> Self:
        """Return the writer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End the thread."""
        self._thread.shutdown()
        if kind is None:
            self.flush()

    def _finish(self) -> None:
        """Wait for the oldest frame; one that failed stays the oldest, so that it is raised again."""
        self._pending[0].result()
        self._pending.popleft()

    def _write(self, index: int, time: float, frame: list[Part]) -> None:
        if self._failed:  # a run that ends at this frame must not leave a later one
            return
        self._failed = True
        with self._watch.beside("frames, written"):
            files = self._folder.write(index, time, frame)
        self._watch.wrote("frames, written", *files)
        self._failed, self.newest = False, index


def write_vtu(path: Path, part: Part) -> None:
    """Write a part of a frame as a VTU file: binary, uncompressed (compression takes three times as long as writing), atomically.

    Args:
        path: the file.
        part: points become vertices, surfaces triangles or lines; cells become quadrilaterals or hexahedra that share their corners.

    Raises:
        OSError: the file cannot be written.
        ValueError: a field has another length than the points or cells.
    """
    size = _size(part)
    fields = {name: _writable(name, values, size) for name, values in part.fields.items()}
    if isinstance(part, Points):
        points, corners = _writable("points", part.points, size), np.arange(size, dtype=np.int32)[:, None]
    elif isinstance(part, Surface):
        points, corners = _writable("points", part.points, size), part.corners.astype(np.int32, copy=False)
    else:
        points, corners = _corners(part)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.writelines(_vtu(points, corners, fields, "CellData" if isinstance(part, Cells) else "PointData"))


def frame_bytes(frame: list[Part]) -> int:
    """Return about how many bytes the files of a frame take; no less for points, a little more for cells that share corners."""
    total = 0.0
    for part in frame:
        fields = sum(values.nbytes for values in part.fields.values())
        if isinstance(part, Points):
            total += fields + part.points.nbytes + len(part.points) * (4 + 4 + 8)  # connectivity, offset, type
        elif isinstance(part, Surface):
            total += fields + part.points.nbytes + len(part.corners) * (4 * part.corners.shape[1] + 4 + 8)
        else:
            corners = 2**part.dimension
            total += fields + len(part.index) * (4 * corners + 4 + 8 + 2 * 12)  # and about two corner points a cell
        total += 2000
    return int(BASE64 * total)


def collection(entries: list[tuple[float, str]]) -> str:
    """Return a PVD collection of files [s, path relative to the collection] as text."""
    lines = [f'    <DataSet timestep="{time!r}" group="" part="0" file="{file}"/>' for time, file in entries]
    head = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <Collection>"]
    return "\n".join([*head, *lines, "  </Collection>", "</VTKFile>", ""])


def _size(part: Part) -> int:
    return len(part.index if isinstance(part, Cells) else part.points)


def _writable(name: str, values: np.ndarray, size: int) -> np.ndarray:
    """Return a field in a type that VTU has (there are no booleans and no half floats)."""
    if len(values) != size:
        raise ValueError(f"field {name!r} has {len(values)} entries for {size} points or cells")
    if values.dtype == np.bool_:
        values = values.astype(np.uint8)
    elif values.dtype == np.float16:
        values = values.astype(np.float32)
    return np.ascontiguousarray(values)


def _corners(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
    """Return the corner points [m] (float32, shape (m, 3)) and each cell's corners among them, shape (n, 4) or (n, 8)."""
    if len(cells.index) == 0:
        return np.zeros((0, 3), dtype=np.float32), np.zeros((0, 2**cells.dimension), dtype=np.int32)
    low = cells.index.min(axis=0)
    shape = cells.index.max(axis=0) - low + 2
    corners = cells.index[:, None, :] - low + CORNERS[: 2**cells.dimension]
    flat = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), tuple(shape))
    used = np.zeros(shape.prod(), dtype=bool)  # a table over the bounding box: much faster than sorting the corners
    used[flat] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    lattice = np.stack(np.unravel_index(np.flatnonzero(used), tuple(shape)), axis=-1) + low
    if cells.dimension == 2:
        lattice[:, 2] = 0
    return (lattice * cells.spacing).astype(np.float32), number[flat]


def _vtu(points: np.ndarray, corners: np.ndarray, fields: dict[str, np.ndarray], where: str) -> Iterator[bytes]:
    """Yield the parts of a VTU file. One without points still names its fields, so that a viewer finds them in every frame."""
    count, each = corners.shape
    kinds = np.full(count, VTK_TYPES[each], dtype=np.uint8)
    yield (
        b'<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" header_type="UInt64">\n'
        b"<UnstructuredGrid>\n"
    )
    yield f'<Piece NumberOfPoints="{len(points)}" NumberOfCells="{count}">\n<Points>\n'.encode()
    yield from _data_array("Points", points)
    yield b"</Points>\n<Cells>\n"
    yield from _data_array("connectivity", corners.reshape(-1))
    yield from _data_array("offsets", np.arange(each, each * count + 1, each, dtype=np.int32))
    yield from _data_array("types", kinds)
    yield f"</Cells>\n<{where}>\n".encode()
    for name, values in fields.items():
        yield from _data_array(name, values)
    yield f"</{where}>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n".encode()


def _data_array(name: str, values: np.ndarray) -> Iterator[bytes]:
    little = values.astype(values.dtype.newbyteorder("<"), copy=False)
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    yield f'<DataArray type="{_vtu_type(values.dtype)}" Name="{name}"{components} format="binary">'.encode()
    yield base64.b64encode(np.uint64(little.nbytes).astype("<u8").tobytes() + little.tobytes())
    yield b"</DataArray>\n"


def _vtu_type(dtype: np.dtype) -> str:
    return {"f": "Float", "i": "Int", "u": "UInt"}[dtype.kind] + str(8 * dtype.itemsize)
