"""Frames as meshio meshes, and in all file formats that it reads and writes."""

from __future__ import annotations

import contextlib
import io
import re
import struct
import tempfile
import zlib
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal
from xml.etree import ElementTree

import numpy as np

from warp_lcp.files.atomic import replacing_by_name
from warp_lcp.frames.vtu import VtuMesh, mesh_of, vtu_bytes
from warp_lcp.simulation import Cells, Points, Surface, Volume

if TYPE_CHECKING:
    import meshio

FrameFormat = Literal[  # formats that meshio reads back unchanged
    "vtu",
    "xdmf",
    "vtk",
    "gmsh",
    "med",
    "exodus",
    "ply",
    "stl",
    "obj",
    "off",
    "abaqus",
    "avsucd",
    "dolfin-xml",
    "flac3d",
    "h5m",
    "hmf",
    "mdpa",
    "medit",
    "netgen",
    "permas",
    "su2",
    "tecplot",
]
SUFFIXES = {  # suffixes of meshio's formats, by name; the first uncompressed one of several
    "xdmf": "xdmf",
    "vtk": "vtk",
    "gmsh": "msh",
    "med": "med",
    "exodus": "e",
    "ply": "ply",
    "stl": "stl",
    "obj": "obj",
    "off": "off",
    "abaqus": "inp",
    "avsucd": "avs",
    "dolfin-xml": "xml",
    "flac3d": "f3grid",
    "h5m": "h5m",
    "hmf": "hmf",
    "mdpa": "mdpa",
    "medit": "mesh",
    "netgen": "vol",
    "permas": "dato",
    "su2": "su2",
    "tecplot": "dat",
}
WRITTEN_ONLY = {"mdpa", "tecplot"}  # meshio's readers of these accept truncated files
FORMAT_OF = {suffix: name for name, suffix in SUFFIXES.items()}
MODULES = {"dolfin-xml": "dolfin"}  # modules of meshio whose names differ from the format's
OPTIONS: dict[str, dict[str, str | bool]] = {
    "xdmf": {"data_format": "XML"},  # one file; HDF would be a second one, which needs h5py
    "stl": {"binary": True},
}
CELL_KINDS = {1: "vertex", 2: "line", 3: "triangle", 4: "quad", 8: "hexahedron"}  # by corners
CORNERS = {kind: corners for corners, kind in CELL_KINDS.items()}
ADDED = re.compile(":|^GLOBAL_ID$")  # names that meshio's readers add, such as gmsh:dim_tags
AXES = re.compile(r"(?P<name>.+)_(?P<axis>[xyz])")
SAMPLE = 1000  # approximate number of cells of the sample for a format
# Errors of meshio's readers and writers for unsupported meshes and damaged files.
FAULTS = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    NameError,
    RuntimeError,
    EOFError,
    ImportError,
    StopIteration,
    MemoryError,
    struct.error,
    zlib.error,
    ElementTree.ParseError,
)


class MeshConversion(IntEnum):
    """Conversion of a mesh that a format needs, from none to most."""

    AS_IS = 0
    PLAIN_NUMBERS = 1  # points and 64-bit integers in float64, other integers in int32
    SCALARS = 2  # also vectors as three fields, named by axis
    BARE = 3  # also without fields


@dataclass(frozen=True)
class FormatSupport:
    """Support of a format for a kind of parts.

    Args:
        dress: the least conversion needed; None if it cannot store them.
        empty: whether it can store one without points.
        size: size of a file, relative to a VTU file.
        why: reason if it cannot.
    """

    dress: MeshConversion | None
    empty: bool = False
    size: float = 1.0
    why: str = ""


def to_meshio(part: Points | Cells | Surface | Volume) -> meshio.Mesh:
    """Return a part of a frame as a `meshio.VtuMesh`.

    Points [m], cells, and its fields as point data or cell data. Points become vertices, surfaces
    triangles or lines, cells quadrilaterals or hexahedra that share their corners. The voxels of a
    volume that are active in a NanoVDB file become hexahedra: those nearer to the surface than its
    band, or with a density other than 0.

    >>> import numpy as np
    >>> from warp_lcp.simulation import Points
    >>> mesh = to_meshio(Points("drops", np.zeros((2, 3), dtype=np.float32), {"speed": np.ones(2)}))
    >>> mesh.cells[0].type, mesh.points.shape, sorted(mesh.point_data)
    ('vertex', (2, 3), ['speed'])
    """
    return meshio_of(mesh_of(_active(part) if isinstance(part, Volume) else part))


def from_meshio(mesh: meshio.Mesh) -> VtuMesh:
    """Return the content of a `meshio.VtuMesh` with one kind of cells.

    Vectors that were stored as three fields are joined again.

    Raises:
        ValueError: it has cells of several kinds, or of kinds that frames do not have.
    """
    points = np.asarray(mesh.points)
    points = (
        np.zeros((0, 3)) if not points.size else np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    )
    filled = [block for block in mesh.cells if len(block.data)]
    kinds = {block.type for block in filled}
    if len(kinds) > 1 or not kinds <= CORNERS.keys():
        raise ValueError(
            f"its cells are of the kinds {', '.join(sorted(kinds))}; allowed are only "
            f"{', '.join(CORNERS)}"
        )
    each = CORNERS[kinds.pop()] if kinds else 1
    corners = (
        np.concatenate([np.asarray(block.data) for block in filled])
        if filled
        else np.zeros((0, each), dtype=np.int32)
    )
    if corners.size and not 0 <= corners.min() <= corners.max() < len(points):
        raise ValueError(f"a cell names a point that does not exist (there are {len(points)})")
    at_points = {
        name: np.asarray(values)
        for name, values in mesh.point_data.items()
        if not ADDED.search(name)
    }
    in_cells = {name: parts for name, parts in mesh.cell_data.items() if not ADDED.search(name)}
    on_cells = not at_points and bool(in_cells)
    used = [number for number, block in enumerate(mesh.cells) if len(block.data)]
    fields = at_points
    if on_cells:
        fields = {
            name: np.concatenate([np.asarray(parts[number]) for number in used])
            for name, parts in in_cells.items()
            if used
        }
    if any(len(values) != len(corners if on_cells else points) for values in fields.values()):
        raise ValueError("a field has not as many values as there are points or cells")
    return VtuMesh(points, corners, _joined(fields), on_cells)


def write_meshio(path: Path, part: Points | Cells | Surface, name: str) -> None:
    """Write a part of a frame in a format of meshio, atomically.

    A part without points is refused if the format cannot store it.

    Args:
        path: the file.
        part: a part that the format can store, see `holds`.
        name: name of the format.

    Raises:
        OSError: the file cannot be written.
        ValueError: the format cannot store it.
    """
    dress = holds(name, *kind_of(part)).dress
    if dress is None:
        raise ValueError(f"{path}: the format {name} cannot store {part.name}")
    mesh = _dressed(mesh_of(part), dress)
    with replacing_by_name(path) as temporary:
        try:
            _write(temporary, mesh, name)
        except OSError:
            raise
        except _faults() as error:
            raise ValueError(
                f"{path}: cannot be written as {name}: {str(error) or type(error).__name__}"
            ) from error


def read_meshio(path: Path, name: str) -> VtuMesh:
    """Return the content of a file of `write_meshio`.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged, or of another format.
    """
    path.stat()  # raises the system's error
    if name in WRITTEN_ONLY:
        raise ValueError(
            f"{path}: is not a readable frame: {name} files are written for other programs and "
            "cannot be read back"
        )
    try:
        return from_meshio(_module(name).read(str(path)))
    except _faults() as error:
        raise ValueError(
            f"{path}: is not a readable frame: {str(error) or type(error).__name__}"
        ) from error


def meshio_bytes(part: Points | Cells | Surface, name: str) -> int:
    """Return the estimated size of the file of a part [bytes], from a sample."""
    return int(vtu_bytes(part) * holds(name, *kind_of(part)).size)


def kind_of(part: Points | Cells | Surface) -> tuple[type, int]:
    """Return the type of a part and the dimension of its cells."""
    if isinstance(part, Points):
        return Points, 3
    return type(part), part.dimension if isinstance(part, Cells) else part.corners.shape[1]


@cache
def holds(name: str, kind: type, dimension: int) -> FormatSupport:
    """Return how a format supports the parts of a kind.

    A sample is written, read back and compared.

    Args:
        name: name of the format.
        kind: type of the parts.
        dimension: dimension of their cells.
    """
    sample, none = (
        _sample(kind, dimension, round(SAMPLE ** (1.0 / dimension))),
        _sample(kind, dimension, 0),
    )
    support, why, captured = None, "", io.StringIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stderr(captured),
        contextlib.redirect_stdout(captured),
    ):
        path = Path(folder) / f"sample.{SUFFIXES[name]}"
        for dress in MeshConversion:
            if support and dress is MeshConversion.BARE:
                break
            captured.truncate(captured.seek(0))
            try:
                if not _round_trips(path, sample, name, dress):
                    why = why or captured.getvalue()
                    continue
                warns, size = bool(captured.getvalue()), path.stat().st_size / vtu_bytes(sample)
            except _faults() as error:
                why = why or (
                    f"needs {error.name}" if isinstance(error, ModuleNotFoundError) else str(error)
                )
                continue
            empty = False
            with contextlib.suppress(*_faults()):
                empty = _round_trips(path, none, name, dress)
            support = support or FormatSupport(dress, empty, size)
            if not warns:  # else meshio would warn at every frame; another conversion is tried
                return FormatSupport(dress, empty, size)
    return support or FormatSupport(None, why=why)


def _round_trips(
    path: Path, part: Points | Cells | Surface, name: str, dress: MeshConversion
) -> bool:
    """Return whether a part is unchanged after writing and reading.

    That is, its points to float32, its cells, and its fields unless bare.
    """
    expected = mesh_of(part)
    _write(path, _dressed(expected, dress), name)
    copy = from_meshio(_module(name).read(str(path)))
    points = np.asarray(copy.points, dtype=np.float64)
    if expected.points.shape != points.shape or not np.allclose(
        points, expected.points, rtol=1e-6, atol=1e-7
    ):
        return False
    if expected.corners.size and not np.array_equal(copy.corners, expected.corners):
        return False
    return (
        dress is MeshConversion.BARE
        or not len(points)
        or all(
            key in copy.fields
            and copy.fields[key].shape == values.shape
            and np.allclose(copy.fields[key], values, rtol=1e-6)
            for key, values in expected.fields.items()
        )
    )


def _dressed(mesh: VtuMesh, dress: MeshConversion) -> VtuMesh:
    """Return a mesh after a conversion."""
    if dress is MeshConversion.AS_IS:
        return mesh
    fields = {} if dress is MeshConversion.BARE else mesh.fields
    fields = {name: _plain(values) for name, values in fields.items()}
    if dress is MeshConversion.SCALARS:
        flat: dict[str, np.ndarray] = {}
        for name, values in fields.items():
            flat |= (
                {name: values}
                if values.ndim == 1
                else {
                    f"{name}_{axis}": values[:, number].copy() for number, axis in enumerate("xyz")
                }
            )
        fields = flat
    return VtuMesh(mesh.points.astype(np.float64), mesh.corners, fields, mesh.on_cells)


def _plain(values: np.ndarray) -> np.ndarray:
    """Return integers in int32; ids, which are 64-bit, in float64: exact below 2^53."""
    if values.dtype.kind not in "biu":
        return values
    return values.astype(np.float64 if values.dtype.itemsize == 8 else np.int32)


def _joined(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return fields with `velocity_x`, `_y` and `_z` joined to vectors."""
    joined: dict[str, np.ndarray] = {}
    for key, values in fields.items():
        match = AXES.fullmatch(key)
        names = [f"{match['name']}_{axis}" for axis in "xyz"] if match else []
        if not match or not all(name in fields and fields[name].ndim == 1 for name in names):
            joined[key] = values
        elif match["axis"] == "x":
            joined[match["name"]] = np.stack([fields[name] for name in names], axis=-1)
    return joined


def meshio_of(mesh: VtuMesh) -> meshio.Mesh:
    """Return a mesh as a `meshio.VtuMesh`."""
    import meshio

    kind = CELL_KINDS[mesh.corners.shape[1]]
    if mesh.on_cells:
        return meshio.Mesh(
            mesh.points,
            [(kind, mesh.corners)],
            cell_data={name: [values] for name, values in mesh.fields.items()},
        )
    return meshio.Mesh(mesh.points, [(kind, mesh.corners)], point_data=dict(mesh.fields))


def _write(path: Path, mesh: VtuMesh, name: str) -> None:
    with np.errstate(divide="ignore", invalid="ignore"):  # normals of triangles without area
        _module(name).write(str(path), meshio_of(mesh), **OPTIONS.get(name, {}))


def _module(name: str) -> ModuleType:
    """Return meshio's module of a format.

    meshio's own `read` ends the process for a damaged file.
    """
    import meshio

    module: ModuleType = getattr(meshio, MODULES.get(name, name))
    return module


def _faults() -> tuple[type[Exception], ...]:
    import meshio

    return (*FAULTS, meshio.ReadError, meshio.WriteError)


def _active(volume: Volume) -> Cells:
    """Return the voxels of a volume that are active in a NanoVDB or OpenVDB file."""
    values, band = volume.values, volume.band
    active = np.abs(values) < band if band is not None else values != 0.0
    active = active.any(axis=3) if values.ndim == 4 else active
    index = np.argwhere(active)[:, ::-1] + np.array(volume.origin)
    return Cells(volume.name, index, volume.spacing, 3, {volume.name: values[active]})


def _sample(kind: type, dimension: int, side: int) -> Points | Cells | Surface:
    """Return a sample part on a lattice, with all kinds of fields of frames."""
    counts = [side] * dimension + [1] * (3 - dimension)
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    index[:, :dimension] -= 2  # includes negative numbers, and ones with exponents
    count = len(index)
    numbers = np.linspace(-1.7, 3.1, count)
    fields: dict[str, np.ndarray] = {
        "velocity": np.stack([numbers, numbers**2, np.sin(numbers)], axis=-1).astype(np.float32),
        "pressure": (1e4 * numbers).astype(np.float32),
        "wall": (numbers > 0.0).astype(np.uint8),
        "body": np.arange(count, dtype=np.int32),
    }
    points = ((index + 0.3 * np.sin(np.arange(3 * count).reshape(-1, 3))) * 0.137).astype(
        np.float32
    )
    if kind is Cells:
        return Cells("grid", index, 0.137, dimension, fields)
    if kind is Points:
        return Points("particles", points, fields)
    if dimension < 3:
        points[:, 2] = 0.0
    corners = (
        np.stack(
            [np.arange(count - dimension + 1) + number for number in range(dimension)], axis=-1
        )
        if count
        else np.zeros((0, dimension))
    )
    return Surface("surface", points, corners.astype(np.int32), fields)
