"""Frames as ParaView opens them: VTU files, and PVD collections that give each its time."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np

from warp_lcp.driver.atomic import replacing, write_text
from warp_lcp.driver.simulator import Cells, Points

FRAME_FILE = re.compile(r"(?P<name>[a-z][a-z_]*)_(?P<index>\d{6,})\.vtu")

# Corners of a cell in VTK's order for quadrilaterals (the first four) and hexahedra, as x, y, z.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
BASE64 = 4 / 3  # what meshio's encoding adds to the bytes


class FrameFolder:
    """The frames of one run: `frames/<name>_<index>.vtu` and `<name>.pvd` beside the folder."""

    def __init__(self, folder: Path) -> None:
        """Look at a run's folder; nothing is written before the first frame."""
        self.folder = folder
        self.frames = folder / "frames"
        self._times: dict[str, list[tuple[float, str]]] = {}

    def write(self, index: int, time: float, frame: list[Points | Cells]) -> None:
        """Write a frame and add it to the collections.

        Args:
            index: the frame's number.
            time: of the frame [s].
            frame: what it shows.

        Raises:
            OSError: a file cannot be written; the earlier ones are intact.
        """
        self.frames.mkdir(exist_ok=True)
        for part in frame:
            file = self.frames / f"{part.name}_{index:06d}.vtu"
            write_vtu(file, part)
            times = self._times.setdefault(part.name, [])
            times.append((time, f"frames/{file.name}"))
            write_text(self.folder / f"{part.name}.pvd", collection(times))

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


def write_vtu(path: Path, part: Points | Cells) -> None:
    """Write a part of a frame as a VTU file: binary, uncompressed (compression takes three times as long as writing), atomically.

    Args:
        path: the file.
        part: points become vertices; cells become quadrilaterals or hexahedra that share their corners.

    Raises:
        OSError: the file cannot be written.
        ValueError: a field has another length than the points or cells.
    """
    fields = {name: _writable(name, values, _size(part)) for name, values in part.fields.items()}
    if _size(part) == 0:
        write_text(path, _empty_vtu(fields, cells=isinstance(part, Cells)))  # meshio refuses empty meshes
        return
    if isinstance(part, Points):
        points = np.ascontiguousarray(part.points)
        vertices = np.arange(len(points), dtype=np.int32)[:, None]
        mesh = meshio.Mesh(points, [("vertex", vertices)], point_data=fields)
    else:
        points, corners = _corners(part)
        kind = "quad" if part.dimension == 2 else "hexahedron"
        mesh = meshio.Mesh(points, [(kind, corners)], cell_data={name: [values] for name, values in fields.items()})
    with replacing(path) as temporary:
        meshio.vtu.write(str(temporary), mesh, compression=None, header_type="UInt64")


def frame_bytes(frame: list[Points | Cells]) -> int:
    """Return about how many bytes the files of a frame take; no less for points, a little more for cells that share corners."""
    total = 0.0
    for part in frame:
        fields = sum(values.nbytes for values in part.fields.values())
        if isinstance(part, Points):
            total += fields + part.points.nbytes + len(part.points) * (4 + 4 + 8)  # connectivity, offset, type
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


def _size(part: Points | Cells) -> int:
    return len(part.points if isinstance(part, Points) else part.index)


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


def _empty_vtu(fields: dict[str, np.ndarray], *, cells: bool) -> str:
    """Return a VTU file without points or cells that still names its fields, so that a viewer finds them in every frame."""

    def array(name: str, kind: str, components: int = 1) -> str:
        return f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}" format="ascii"></DataArray>'

    data = "".join(array(name, _vtu_type(values.dtype), *values.shape[1:]) for name, values in fields.items())
    tag = "CellData" if cells else "PointData"
    return (
        '<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian"><UnstructuredGrid>\n'
        f'<Piece NumberOfPoints="0" NumberOfCells="0">\n<Points>{array("Points", "Float32", 3)}</Points>\n'
        f"<Cells>{array('connectivity', 'Int32')}{array('offsets', 'Int32')}{array('types', 'UInt8')}</Cells>\n"
        f"<{tag}>{data}</{tag}>\n</Piece></UnstructuredGrid></VTKFile>\n"
    )


def _vtu_type(dtype: np.dtype) -> str:
    return {"f": "Float", "i": "Int", "u": "UInt"}[dtype.kind] + str(8 * dtype.itemsize)
