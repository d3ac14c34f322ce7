"""VTU files of particles, surfaces and cells.

Particles are vertices, surfaces triangles or segments, cells quadrilaterals or hexahedra.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_lcp.files.atomic import replacing
from warp_lcp.files.size_limits import read_whole
from warp_lcp.frames.vtk_xml import (
    inline,
    inline_values,
    opening,
    read_back,
    root,
    writable,
    writable_fields,
)
from warp_lcp.simulation import Cells, Points, Surface

# Corners of a cell in VTK's order for quadrilaterals (the first four) and hexahedra, as x, y, z.
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
# Vertex, line, triangle, quadrilateral and hexahedron by number of corners.
VTK_TYPES = {1: 1, 2: 3, 3: 5, 4: 9, 8: 12}
VTK_CORNERS = {kind: corners for corners, kind in VTK_TYPES.items()}
BASE64 = 4 / 3  # size of the encoding relative to the bytes
XML_BYTES = 2000  # text around the arrays
OFFSET_BYTES, TYPE_BYTES, POINT_BYTES = 4, 1, 12


@dataclass(frozen=True)
class VtuMesh:
    """Content of a VTU file.

    Args:
        points: [m], shape (n, 3).
        corners: point indices of the cells, shape (m, corners of a cell).
        fields: values at the points, or in the cells, of shape (n,) or (n, 3).
        on_cells: whether the fields belong to cells.
    """

    points: np.ndarray
    corners: np.ndarray
    fields: dict[str, np.ndarray]
    on_cells: bool = False


def write_vtu(path: Path, part: Points | Cells | Surface) -> None:
    """Write a part of a frame as a VTU file, atomically.

    Binary and uncompressed: compression takes three times as long as writing. The arrays are base64
    text. Appended raw bytes would have 3/4 of the size and take 0.6 to 0.8 of the time, but meshio
    cannot read them.

    Args:
        path: the file.
        part: points become vertices, surfaces triangles or lines; cells become quadrilaterals or
            hexahedra that share their corners.

    Raises:
        OSError: the file cannot be written.
        ValueError: a field has another length than the points or cells.
    """
    mesh = mesh_of(part)
    with replacing(path) as file:
        file.writelines(
            _vtu(
                mesh.points, mesh.corners, mesh.fields, "CellData" if mesh.on_cells else "PointData"
            )
        )


def mesh_of(part: Points | Cells | Surface) -> VtuMesh:
    """Return the mesh of a part, its fields in types of VTK.

    Points are vertices; cells share their corners.

    Raises:
        ValueError: a field has another length than the points or cells.
    """
    size, fields = writable_fields(part)
    if isinstance(part, Points):
        points, corners = (
            writable("points", part.points, size),
            np.arange(size, dtype="<i4")[:, None],
        )
    elif isinstance(part, Surface):
        points, corners = (
            writable("points", part.points, size),
            part.corners.astype("<i4", copy=False),
        )
    else:
        points, corners = _corners(part)
    return VtuMesh(points, corners, fields, isinstance(part, Cells))


def read_vtu(path: Path) -> VtuMesh:
    """Return the content of a file of `write_vtu`.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no such file, or truncated.
    """
    with read_back(path):
        piece = root(read_whole(path, copies=3), "UnstructuredGrid").find("Piece")
        if piece is None:
            raise ValueError("no Piece")
        arrays = {
            place.tag: {
                str(array.get("Name")): inline_values(array) for array in place.iter("DataArray")
            }
            for place in piece
        }
        points, cells = np.reshape(arrays["Points"]["Points"], (-1, 3)), arrays["Cells"]
        each = VTK_CORNERS[int(cells["types"][0])] if len(cells["types"]) else 1
        corners = np.reshape(cells["connectivity"], (-1, each))
        on_cells = "CellData" in arrays
        fields = arrays["CellData" if on_cells else "PointData"]
        if (cells["types"] != VTK_TYPES[each]).any() or not np.array_equal(
            cells["offsets"], np.arange(each, each * len(corners) + 1, each)
        ):
            raise ValueError("its cells are not all of one kind")
        if corners.size and not 0 <= corners.min() <= corners.max() < len(points):
            raise ValueError(f"a cell names a point that does not exist (there are {len(points)})")
        if any(len(array) != len(corners if on_cells else points) for array in fields.values()):
            raise ValueError("a field has not as many values as there are points or cells")
        return VtuMesh(points, corners, fields, on_cells)


def vtu_bytes(part: Points | Cells | Surface) -> int:
    """Return the estimated size of the file of a part [bytes].

    It is exact for points, an upper estimate for cells that share corners.
    """
    total = XML_BYTES + sum(values.nbytes for values in part.fields.values())
    if isinstance(part, Points):
        points, cells, each = part.points.nbytes, len(part.points), 1
    elif isinstance(part, Surface):
        points, (cells, each) = part.points.nbytes, part.corners.shape
    else:
        # About two corner points per cell.
        points, cells, each = len(part.index) * 2 * POINT_BYTES, len(part.index), 2**part.dimension
    return int(BASE64 * (total + points + cells * (4 * each + OFFSET_BYTES + TYPE_BYTES)))


def _corners(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
    """Return corner points and each cell's corner indices.

    Points [m] in float32, shape (m, 3); indices of shape (n, 4) or (n, 8).
    """
    each = 2**cells.dimension
    if len(cells.index) == 0:
        return np.zeros((0, 3), dtype="<f4"), np.zeros((0, each), dtype="<i4")
    low = cells.index.min(axis=0)
    shape = cells.index.max(axis=0) - low + 2
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    x, y, z = (cells.index - low).T
    flat = ((x * shape[1] + y) * shape[2] + z)[:, None] + CORNERS[:each] @ strides
    # A table over the bounding box: much faster than sorting the corners.
    used = np.zeros(shape.prod(), dtype=bool)
    used[flat] = True
    number = np.cumsum(used, dtype="<i4")
    number -= 1
    lattice = np.stack(np.unravel_index(np.flatnonzero(used), tuple(shape)), axis=-1) + low
    if cells.dimension == 2:
        lattice[:, 2] = 0
    return (lattice * cells.spacing).astype("<f4"), number[flat]


def _vtu(
    points: np.ndarray, corners: np.ndarray, fields: dict[str, np.ndarray], where: str
) -> Iterator[bytes]:
    """Yield the parts of a VTU file.

    A file without points also lists its fields, so that a viewer finds them in every frame.
    """
    count, each = corners.shape
    yield opening("UnstructuredGrid")
    yield (
        f'<UnstructuredGrid>\n<Piece NumberOfPoints="{len(points)}" '
        f'NumberOfCells="{count}">\n<Points>\n'
    ).encode()
    yield from inline("Points", points)
    yield b"</Points>\n<Cells>\n"
    yield from inline("connectivity", corners.reshape(-1))
    yield from inline("offsets", np.arange(each, each * count + 1, each, dtype="<i4"))
    yield from inline("types", np.full(count, VTK_TYPES[each], dtype=np.uint8))
    yield f"</Cells>\n<{where}>\n".encode()
    for name, values in fields.items():
        yield from inline(name, values)
    yield f"</{where}>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n".encode()
