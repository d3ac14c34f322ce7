"""Frames in pieces, each in the folder of a rank: PVTU and PVTI files, which make one of them for ParaView, and reading them back."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from warp_lcp.files.atomic import write_text
from warp_lcp.files.claims import read_whole
from warp_lcp.frames.vti import GHOSTS, extent_of, image_box, image_end
from warp_lcp.frames.vtk_xml import attributes, opening, read_back, root, writable, writable_fields
from warp_lcp.frames.vtu import Mesh
from warp_lcp.simulation import Cells, Points, Surface

# where each process keeps its pieces of frames and checkpoints
RANK_FOLDER = re.compile(r"rank_\d{4,}")
SURFACES = (2, 3)  # corners of segments and triangles
WHOLE = {"vtu": "pvtu", "vti": "pvti"}  # the suffix of the file that names the pieces, by theirs

Kind = Literal["vtu", "vti"]
Image = tuple[tuple[int, int, int], tuple[int, int, int]]


@dataclass(frozen=True)
class Piece:
    """What the file of a whole frame says of one of its pieces.

    Args:
        kind: the suffix of its file.
        size: how many points or cells it has.
        fields: attributes of their data arrays.
        points: attributes of the array of points; "" for an image.
        on_cells: the fields are those of cells.
        image: first and last corner of an image [cells].
        spacing: of an image's cells [m].
    """

    kind: Kind
    size: int
    fields: tuple[str, ...]
    points: str
    on_cells: bool
    image: Image | None = None
    spacing: float = 0.0


def describe(part: Points | Cells | Surface, kind: Kind) -> Piece:
    """Return what is to be said of a part that becomes a file of a kind."""
    cells = isinstance(part, Cells)
    size, written = writable_fields(part)
    fields = tuple(attributes(name, values) for name, values in written.items())
    if isinstance(part, Cells) and kind == "vti":
        low, counts = image_box(part)
        end = image_end(low, counts, part.dimension)
        fields = (*fields, attributes(GHOSTS, np.zeros(0, dtype=np.uint8)))
        return Piece(kind, size, fields, "", cells, (_triple(low), _triple(end)), part.spacing)
    points = np.zeros((0, 3), dtype=np.float32) if isinstance(part, Cells) else part.points
    return Piece(
        kind, size, fields, attributes("Points", writable("points", points, len(points))), cells
    )


def write_whole(path: Path, pieces: Sequence[tuple[str, Piece]]) -> None:
    """Write the file that makes one frame of pieces, atomically.

    Args:
        path: the file, whose suffix is that of `WHOLE`.
        pieces: of one kind: their files, relative to `path`, and what is in them; empty ones count
            only if all are.

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
    """Return the files of the pieces that a file of `write_whole` names: of its own name, each in a rank's folder beside it.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no such file, or names others, or one twice.
    """
    with read_back(path):
        kind = path.suffix.removeprefix(".p")
        pieces = root(
            read_whole(path), f"P{'ImageData' if kind == 'vti' else 'UnstructuredGrid'}"
        ).iter("Piece")
        found = [Path(str(piece.get("Source"))) for piece in pieces]
        for file in found:
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
        if len(set(found)) != len(found):
            raise ValueError("names a piece twice")
        return [path.parent / file for file in found]


def one_mesh(meshes: Sequence[Mesh]) -> Mesh:
    """Return the mesh of all pieces, of which there is at least one; empty ones need not have the kind of cells of the others.

    Pieces of a surface have the points on cuts twice, in the same place to the last bit: it comes
    back with each once.

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
    whole = Mesh(
        np.concatenate([mesh.points for mesh in filled]),
        np.concatenate(
            [mesh.corners + start for mesh, start in zip(filled, starts[:-1], strict=True)]
        ),
        {name: np.concatenate([mesh.fields[name] for mesh in filled]) for name in first.fields},
        first.on_cells,
    )
    return _sewn(whole) if len(filled) > 1 and whole.corners.shape[1] in SURFACES else whole


def one_grid(parts: Sequence[Cells]) -> Cells:
    """Return the cells of all pieces, of which there is at least one, as one part.

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
    """Yield what is in a folder, and in the folders of ranks there; nothing if there is no such folder."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if _is_rank(path):
            yield from path.iterdir()
        else:
            yield path


def remove_empty_ranks(folder: Path) -> None:
    """Delete the folders of ranks in a folder that hold nothing.

    Raises:
        OSError: one cannot be deleted.
    """
    for path in list(folder.iterdir()) if folder.is_dir() else ():
        if _is_rank(path) and not any(path.iterdir()):
            path.rmdir()


def _sewn(mesh: Mesh) -> Mesh:
    """Return a mesh with the points of one place as one point, the first of them."""
    places = (
        np.ascontiguousarray(mesh.points).view(np.dtype((np.void, mesh.points.strides[0]))).ravel()
    )
    _, first, place = np.unique(places, return_index=True, return_inverse=True)
    kept, number = np.unique(first, return_inverse=True)
    fields = (
        mesh.fields
        if mesh.on_cells
        else {name: values[kept] for name, values in mesh.fields.items()}
    )
    return Mesh(mesh.points[kept], number[place][mesh.corners], fields, mesh.on_cells)


def _mesh(pieces: Sequence[tuple[str, Piece]], first: Piece) -> Iterator[str]:
    yield opening("PUnstructuredGrid").decode()
    yield '<PUnstructuredGrid GhostLevel="0">\n'
    yield from _arrays("PCellData" if first.on_cells else "PPointData", first.fields)
    yield from _arrays("PPoints", (first.points,))
    yield from (f'<Piece Source="{file}"/>\n' for file, _ in pieces)
    yield "</PUnstructuredGrid>\n</VTKFile>\n"


def _image(pieces: Sequence[tuple[str, Piece]], first: Piece) -> Iterator[str]:
    """Yield a PVTI file; the pieces' boxes fill the image, so that even those without a shown cell count."""
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
