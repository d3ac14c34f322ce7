"""Read the triangles of OBJ, STL and PLY files. What meshio cannot take (texture seams, say) is put right before it sees it."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path

import numpy as np

FORMATS = (".obj", ".ply", ".stl")
STL_HEADER = 84  # bytes before the first triangle of a binary STL: 80 of text and a count
STL_TRIANGLE = 50


def read_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the polygons of a file as triangles; texture coordinates, normals, colors, points and lines are ignored.

    Polygons become fans about their first corner. (Where a polygon is not convex, triangles then overlap with opposite orientation: the
    inside stays right.)

    Args:
        path: a file whose name ends in .obj, .stl or .ply.

    Returns:
        Vertices, float64 of shape (n, 3), and triangles, int64 of shape (m, 3). Nothing is checked but that the indices exist.

    Raises:
        ValueError: the file is missing, of another format or not readable; the message names it.
    """
    import meshio

    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path}: a mesh must be one of {', '.join(FORMATS)}")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such mesh file") from None
    except OSError as error:
        raise ValueError(f"{path}: the mesh file cannot be read ({error.strerror or error})") from error
    if suffix == ".stl" and not _is_binary_stl(data):
        return _parse_text_stl(path, data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about details of the format; what matters here is checked afterwards
            if suffix == ".stl":
                mesh = meshio.stl.read(path)
            elif suffix == ".ply":
                mesh = meshio.ply.read(io.BytesIO(_standard_ply(data)))
            else:
                mesh = meshio.obj.read(io.StringIO(_plain_obj(data)))
    except (
        meshio.ReadError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AssertionError,
        AttributeError,
        EOFError,
        UnboundLocalError,
    ) as error:
        reason = str(error).strip() or type(error).__name__
        raise ValueError(f"{path}: not a readable {suffix[1:].upper()} file ({reason})") from error
    return _triangulate(path, np.asarray(mesh.points), [np.asarray(block.data) for block in mesh.cells if len(block.data)])


def _triangulate(path: Path, points: np.ndarray, blocks: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Cut blocks of equal polygons, each of shape (count, corners), into triangles."""
    if points.size == 0:
        raise ValueError(f"{path}: the mesh has no vertices")
    fans = [np.stack([block[:, [0, i, i + 1]] for i in range(1, block.shape[1] - 1)], axis=1) for block in blocks if block.shape[1] >= 3]
    if not fans:
        raise ValueError(f"{path}: the mesh has no triangles")
    triangles = np.concatenate([fan.reshape(-1, 3) for fan in fans]).astype(np.int64)
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(f"{path}: a triangle names a vertex that does not exist (there are {len(points)})")
    vertices = np.zeros((len(points), 3))
    columns = min(points.shape[1], 3)
    vertices[:, :columns] = points[:, :columns]
    return vertices, triangles


def _is_binary_stl(data: bytes) -> bool:
    """Tell a binary STL by its length: its first bytes may say "solid" all the same."""
    return len(data) >= STL_HEADER and len(data) == STL_HEADER + STL_TRIANGLE * int.from_bytes(data[80:84], "little")


def _parse_text_stl(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Read the corners of a text STL (meshio stumbles over blank lines and over words in capitals)."""
    if not data.lstrip()[:5].lower() == b"solid":
        raise ValueError(f"{path}: not a readable STL file (neither text nor of the length that its number of triangles asks for)")
    corners = re.findall(rb"^\s*vertex\s+(\S+)\s+(\S+)\s+(\S+)\s*$", data, flags=re.MULTILINE | re.IGNORECASE)
    facets = len(re.findall(rb"^\s*endfacet\b", data, flags=re.MULTILINE | re.IGNORECASE))
    if len(corners) != 3 * facets:
        raise ValueError(f"{path}: not a readable STL file ({len(corners)} corners in {facets} facets)")
    if not facets:
        raise ValueError(f"{path}: the mesh has no triangles")
    try:
        vertices = np.array([[float(number) for number in corner] for corner in corners])
    except ValueError as error:
        raise ValueError(f"{path}: not a readable STL file ({error})") from error
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _standard_ply(data: bytes) -> bytes:
    """Give the list of corners the name that meshio knows, of the two in use."""
    header, end, body = data.partition(b"end_header")
    if not end:
        raise ValueError("the header does not end")  # meshio would look for it for ever
    header = header.replace(b"\r\n", b"\n")
    return re.sub(rb"\bvertex_index\b", b"vertex_indices", header) + end + body


def _plain_obj(data: bytes) -> str:
    """Reduce an OBJ to vertices and faces of positive indices: meshio refuses texture seams and misreads relative indices."""
    lines = []
    vertices = 0
    for line in data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] == "v":
            vertices += 1
            lines.append(" ".join(words[:4]))
        elif words[0] == "f":
            indices = [int(word.split("/", 1)[0]) for word in words[1:]]
            lines.append("f " + " ".join(str(index if index > 0 else index + vertices + 1) if index else "0" for index in indices))
    return "\n".join(lines)
