"""Frames in parts, one per rank: PVTU and PVTI files, and reading them back.

Each part is in the folder of its rank. PVTU and PVTI files list the parts, for ParaView.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from warp_lcp.files.atomic import write_text
from warp_lcp.files.size_limits import read_whole
from warp_lcp.frames.vti import GHOSTS, extent_of, image_box, image_end
from warp_lcp.frames.vtk_xml import attributes, opening, read_back, root, writable, writable_fields
from warp_lcp.frames.vtu import VtuMesh
from warp_lcp.simulation import Cells, Points, Surface

# Folder of a rank's parts of frames and checkpoints.
RANK_FOLDER = re.compile(r"rank_\d{4,}")
SURFACES = (2, 3)  # numbers of corners of segments and triangles
# Suffix of the file that lists the parts, by the parts' suffix.
WHOLE = {"vtu": "pvtu", "vti": "pvti"}

Kind = Literal["vtu", "vti"]
Image = tuple[tuple[int, int, int], tuple[int, int, int]]


@dataclass(frozen=True)
class VtkPiece:
    """Metadata of a part in the file of a whole frame.

    Args:
        kind: suffix of its file.
        size: number of points or cells.
        fields: attributes of their data arrays.
        points: attributes of the array of points; "" for an image.
        on_cells: whether the fields belong to cells.
        image: first and last corner of an image [cells].
        spacing: cell size of an image [m].
    """

    kind: Kind
    size: int
    fields: tuple[str, ...]
    points: str
    on_cells: bool
    image: Image | None = None
    spacing: float = 0.0


def describe(part: Points | Cells | Surface, kind: Kind) -> VtkPiece:
    """Return the metadata of a part in a file of a kind."""
    cells = isinstance(part, Cells)
    size, written = writable_fields(part)
    fields = tuple(attributes(name, values) for name, values in written.items())
    if isinstance(part, Cells) and kind == "vti":
        low, counts = image_box(part)
        end = image_end(low, counts, part.dimension)
        fields = (*fields, attributes(GHOSTS, np.zeros(0, dtype=np.uint8)))
        return VtkPiece(kind, size, fields, "", cells, (_triple(low), _triple(end)), part.spacing)
    points = np.zeros((0, 3), dtype=np.float32) if isinstance(part, Cells) else part.points
    return VtkPiece(
        kind, size, fields, attributes("Points", writable("points", points, len(points))), cells
    )


def write_whole(path: Path, pieces: Sequence[tuple[str, VtkPiece]]) -> None:
    """Write the file that lists the parts of a frame, atomically.

    Args:
        path: the file, with a suffix of `WHOLE`.
        pieces: parts of one kind: their files, relative to `path`, and their metadata; empty ones
            are omitted unless all are empty.

    Raises:
        OSError: the file cannot be written.
        ValueError: the pieces have different fields.
    """
    filled = [(file, piece) for file, piece in pieces if piece.size] or list(pieces[:1])
    first = filled[0][1]
    for file, piece in filled:
        if (piece.kind, piece.fields, piece.points) != (first.kind, first.fields, first.points):
            raise ValueError(
                f"{path}: {file} has other fields than {filled[0][0]}: {piece.fields} instead of "
                f"{first.fields}"
            )
    lines = _image(pieces, first) if first.kind == "vti" else _mesh(filled, first)
    write_text(path, "".join(lines))


def piece_files(path: Path) -> list[Path]:
    """Return the files of the parts in a file of `write_whole`.

    They have its own name, each in a rank's folder beside it.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no such file, or lists other files, or one twice.
    """
    with read_back(path):
        kind = path.suffix.removeprefix(".p")
        pieces = root(
            read_whole(path), f"P{'ImageData' if kind == 'vti' else 'UnstructuredGrid'}"
        ).iter("Piece")
        sources = [Path(str(piece.get("Source"))) for piece in pieces]
        for file in sources:
            own = (
                len(file.parts) == 2
                and RANK_FOLDER.fullmatch(file.parts[0])
                and file.parts[1] == f"{path.stem}.{kind}"
            )
            if not own or not (path.parent / file).resolve().is_relative_to(path.parent.resolve()):
                raise ValueError(
                    f"names {str(file)!r}: a piece is rank_0000/{path.stem}.{kind} in its own "
                    "folder"
                )
        if len(set(sources)) != len(sources):
            raise ValueError("names a piece twice")
        return [path.parent / file for file in sources]


def one_mesh(meshes: Sequence[VtuMesh]) -> VtuMesh:
    """Return one mesh from those of all parts, at least one.

    Empty parts may have another kind of cells. Parts of a surface have the points on cuts twice,
    with equal bits; in the result each occurs once.

    Raises:
        ValueError: they have other fields or cells than each other.
    """
    filled = [mesh for mesh in meshes if len(mesh.points)] or list(meshes[:1])
    first = filled[0]
    if any(
        mesh.fields.keys() != first.fields.keys() or mesh.on_cells != first.on_cells
        for mesh in filled
    ):
        raise ValueError("its pieces have different fields")
    starts = np.cumsum([0, *(len(mesh.points) for mesh in filled)])
    joined = VtuMesh(
        np.concatenate([mesh.points for mesh in filled]),
        np.concatenate(
            [mesh.corners + start for mesh, start in zip(filled, starts[:-1], strict=True)]
        ),
        {name: np.concatenate([mesh.fields[name] for mesh in filled]) for name in first.fields},
        first.on_cells,
    )
    return _sewn(joined) if len(filled) > 1 and joined.corners.shape[1] in SURFACES else joined


def one_grid(parts: Sequence[Cells]) -> Cells:
    """Return the cells of all parts, at least one, as one object.

    Raises:
        ValueError: they have other fields than each other.
    """
    first = parts[0]
    if any(part.fields.keys() != first.fields.keys() for part in parts):
        raise ValueError("its pieces have different fields")
    fields = {name: np.concatenate([part.fields[name] for part in parts]) for name in first.fields}
    return Cells(
        first.name,
        np.concatenate([part.index for part in parts]),
        first.spacing,
        first.dimension,
        fields,
    )


def rank_folder(rank: int) -> str:
    """Return the name of a rank's folder."""
    return f"rank_{rank:04d}"


def in_ranks(folder: Path) -> Iterator[Path]:
    """Yield the entries of a folder, and of the ranks' folders in it.

    Nothing if there is no such folder.
    """
    for path in folder.iterdir() if folder.is_dir() else ():
        if _is_rank(path):
            yield from path.iterdir()
        else:
            yield path


def remove_empty_ranks(folder: Path) -> None:
    """Delete the empty folders of ranks in a folder.

    Raises:
        OSError: one cannot be deleted.
    """
    for path in list(folder.iterdir()) if folder.is_dir() else ():
        if _is_rank(path) and not any(path.iterdir()):
            path.rmdir()


def _sewn(mesh: VtuMesh) -> VtuMesh:
    """Return a mesh with points at one position merged into the first of them."""
    places = (
        np.ascontiguousarray(mesh.points).view(np.dtype((np.void, mesh.points.strides[0]))).ravel()
    )
    _, first, place = np.unique(places, return_index=True, return_inverse=True)
    first_points, number = np.unique(first, return_inverse=True)
    fields = (
        mesh.fields
        if mesh.on_cells
        else {name: values[first_points] for name, values in mesh.fields.items()}
    )
    return VtuMesh(mesh.points[first_points], number[place][mesh.corners], fields, mesh.on_cells)


def _mesh(pieces: Sequence[tuple[str, VtkPiece]], first: VtkPiece) -> Iterator[str]:
    yield opening("PUnstructuredGrid").decode()
    yield '<PUnstructuredGrid GhostLevel="0">\n'
    yield from _arrays("PCellData" if first.on_cells else "PPointData", first.fields)
    yield from _arrays("PPoints", (first.points,))
    yield from (f'<Piece Source="{file}"/>\n' for file, _ in pieces)
    yield "</PUnstructuredGrid>\n</VTKFile>\n"


def _image(pieces: Sequence[tuple[str, VtkPiece]], first: VtkPiece) -> Iterator[str]:
    """Yield a PVTI file.

    The boxes of the parts must fill the image, so that parts without shown cells are included.
    """
    corners = np.array([piece.image for _, piece in pieces])
    yield opening("PImageData").decode()
    whole = extent_of(corners[:, 0].min(axis=0), corners[:, 1].max(axis=0))
    spacing = " ".join([str(first.spacing)] * 3)
    yield f'<PImageData WholeExtent="{whole}" GhostLevel="0" Origin="0 0 0" Spacing="{spacing}">\n'
    yield from _arrays("PCellData", first.fields)
    for (file, _), (low, end) in zip(pieces, corners, strict=True):
        yield f'<Piece Extent="{extent_of(low, end)}" Source="{file}"/>\n'
    yield "</PImageData>\n</VTKFile>\n"


def _arrays(where: str, arrays: Sequence[str]) -> Iterator[str]:
    yield f"<{where}>\n"
    yield from (f"<PDataArray {array}/>\n" for array in arrays)
    yield f"</{where}>\n"


def _triple(values: np.ndarray) -> tuple[int, int, int]:
    x, y, z = map(int, values)
    return x, y, z


def _is_rank(path: Path) -> bool:
    return RANK_FOLDER.fullmatch(path.name) is not None and path.is_dir() and not path.is_symlink()
