"""Read a frame of a run, in any format, whole or in parts of ranks."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from warp_lcp.frames.frame_folder import FRAME_FILE
from warp_lcp.frames.meshio_format import FORMAT_OF, WRITTEN_ONLY, meshio_of, read_meshio, to_meshio
from warp_lcp.frames.pieces import one_grid, one_mesh, piece_files
from warp_lcp.frames.vti import read_vti
from warp_lcp.frames.vtu import VtuMesh, read_vtu
from warp_lcp.simulation import Cells

if TYPE_CHECKING:
    import meshio

READERS: dict[str, tuple[Callable[[Path], VtuMesh | Cells], Callable[..., VtuMesh | Cells]]] = {
    "vtu": (read_vtu, one_mesh),
    "vti": (read_vti, one_grid),
}
MESHIO_READS = (suffix for suffix, name in FORMAT_OF.items() if name not in WRITTEN_ONLY)
# Suffixes of a part's file, in order of priority.
READABLE = ("vti", "pvti", "pvtu", "vtu", *MESHIO_READS)


def read_part(file: Path) -> VtuMesh | Cells:
    """Return the content of a frame's file, or of the parts that it lists.

    Raises:
        OSError: a file cannot be read.
        ValueError: it is no frame, or damaged.
    """
    match = FRAME_FILE.fullmatch(file.name)
    if match is None or match["format"] not in READABLE:
        raise ValueError(
            f"{file}: is not a readable frame: its name must be like particles_000012.vtu, and its "
            f"format one of {', '.join(READABLE)}"
        )
    kind = match["format"]
    if kind in FORMAT_OF:
        return read_meshio(file, FORMAT_OF[kind])
    read, joined = READERS[kind.removeprefix("p")]
    if not kind.startswith("p"):
        return read(file)
    if pieces := piece_files(file):
        return joined([read(piece) for piece in pieces])
    raise ValueError(f"{file}: is not a readable frame: names no pieces")


def read_frame(file: str | PathLike[str]) -> meshio.Mesh:
    """Read a file of a run's `frames` as a `meshio.VtuMesh`.

    meshio itself reads neither VTU files without cells, as frames before the first drop are, nor
    VTI files, nor files that list parts of ranks. This function reads all of these, and other
    formats of `output.format`. Volumes are not meshes: see `wp.Volume.load_from_nvdb`.

    Args:
        file: such as `out/frames/particles_000012.vtu`.

    Returns:
        A `meshio.VtuMesh`: points [m], cells, and the fields as point data or cell data.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no frame, or damaged; the message names it.
    """
    found = read_part(Path(file))
    return to_meshio(found) if isinstance(found, Cells) else meshio_of(found)
