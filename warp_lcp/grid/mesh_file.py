"""Read the triangles of OBJ, STL and PLY files.

No memory is allocated for data that a file only declares.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warp_lcp.files.size_limits import check_claim

FORMATS = (".obj", ".ply", ".stl")
MARK = b"\xef\xbb\xbf"  # byte order mark that some editors write before UTF-8 text
WIDE = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16
# Words of a text STL after the first.
STL_WORDS = re.compile(rb"^[ \t]*(?:facet|endsolid)\b", flags=re.MULTILINE | re.IGNORECASE)
STL_HEADER = 84  # bytes before the first triangle of a binary STL: 80 of text and a count
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("color", "<u2")])
PLY_TYPES = {
    name: code
    for names, code in (
        ("char int8", "i1"),
        ("uchar uint8", "u1"),
        ("short int16", "i2"),
        ("ushort uint16", "u2"),
        ("int int32", "i4"),
        ("uint uint32", "u4"),
        ("float float32", "f4"),
        ("double float64", "f8"),
        ("int64", "i8"),
        ("uint64", "u8"),
    )
    for name in names.split()
}
PLY_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
# Names of a face's list of corners in use.
PLY_CORNERS = ("vertex_indices", "vertex_index")
LARGEST_INDEX = 2**31 - 1

Corners = list[np.ndarray]  # blocks of polygons, each of shape (count, corners)


def read_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the polygons of a file as triangles.

    Texture coordinates, normals, colors, points and lines are ignored.

    Polygons become fans about their first corner. (Where a polygon is not convex, triangles then
    overlap with opposite orientation: the inside stays right.)

    Args:
        path: a file whose name ends in .obj, .stl or .ply.

    Returns:
        Vertices, float64 of shape (n, 3), and triangles, int64 of shape (m, 3). Nothing is checked
        but that the indices exist.

    Raises:
        ValueError: the file is missing, of another format or not readable; the message names it.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path}: a mesh must be one of {', '.join(FORMATS)}")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such mesh file") from None
    except OSError as error:
        raise ValueError(
            f"{path}: the mesh file cannot be read ({error.strerror or error})"
        ) from error
    if not data:
        raise ValueError(
            f"{path}: the mesh file is empty: it has no vertices, so it is not a readable "
            f"{suffix[1:].upper()} file"
        )
    if data.startswith(WIDE) and (
        suffix != ".stl" or data[2:].replace(b"\0", b"")[:5].lower() == b"solid"
    ):
        raise ValueError(
            f"{path}: not a readable {suffix[1:].upper()} file (it is UTF-16 text; save it as "
            "UTF-8)"
        )
    if suffix == ".stl" and not _is_binary_stl(data):
        return _parse_text_stl(path, data)
    try:
        points, blocks = {".obj": _parse_obj, ".ply": _parse_ply, ".stl": _parse_binary_stl}[
            suffix
        ](data)
    except ValueError as error:
        raise ValueError(f"{path}: not a readable {suffix[1:].upper()} file ({error})") from error
    return _triangulate(path, points, [block for block in blocks if len(block)])


def _triangulate(path: Path, points: np.ndarray, blocks: Corners) -> tuple[np.ndarray, np.ndarray]:
    """Cut blocks of equal polygons, each of shape (count, corners), into triangles."""
    if points.size == 0:
        raise ValueError(f"{path}: the mesh has no vertices")
    fans = [
        np.stack([block[:, [0, i, i + 1]] for i in range(1, block.shape[1] - 1)], axis=1)
        for block in blocks
        if block.shape[1] >= 3
    ]
    if not fans:
        raise ValueError(f"{path}: the mesh has no triangles")
    triangles = np.concatenate([fan.reshape(-1, 3) for fan in fans])
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(
            f"{path}: a triangle names a vertex that does not exist (there are {len(points)})"
        )
    return points, triangles


def _blocks(polygons: Sequence[Sequence[int] | np.ndarray]) -> Corners:
    """Return polygons as arrays, one per run of equal numbers of corners."""
    return [np.array(list(run), dtype=np.int64) for _, run in itertools.groupby(polygons, key=len)]


def _is_binary_stl(data: bytes) -> bool:
    """Return whether data is a binary STL.

    Its length decides, or bytes that no text has: a binary file may begin with "solid", too.
    """
    if len(data) < STL_HEADER:
        return False
    is_text = data.removeprefix(MARK).lstrip()[:5].lower() == b"solid" and (
        b"\0" not in data or STL_WORDS.search(data) is not None
    )
    return len(data) == STL_HEADER + STL_TRIANGLE.itemsize * _stl_count(data) or not is_text


def _stl_count(data: bytes) -> int:
    return int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")


def _parse_binary_stl(data: bytes) -> tuple[np.ndarray, Corners]:
    """Read the corners of a binary STL, three for each triangle.

    Bytes after the last triangle, which some programs write, are ignored.
    """
    count, held = _stl_count(data), (len(data) - STL_HEADER) // STL_TRIANGLE.itemsize
    if held < count:
        raise ValueError(
            f"neither text nor a binary file of the right length: it declares {count} triangles "
            f"and holds {held}"
        )
    if not count:
        raise ValueError(f"it declares no triangles, but {len(data) - STL_HEADER} bytes follow")
    points = (
        np.frombuffer(data, STL_TRIANGLE, count, STL_HEADER)["corners"]
        .reshape(-1, 3)
        .astype(np.float64)
    )
    return points, [np.arange(len(points)).reshape(-1, 3)]


def _parse_text_stl(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Read the corners of a text STL; blank lines and upper case are allowed."""
    data = data.removeprefix(MARK).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not data.lstrip()[:5].lower() == b"solid":
        raise ValueError(
            f"{path}: not a readable STL file (neither text nor a binary file of the right length)"
        )
    corners = re.findall(
        rb"^\s*vertex\s+(\S+)\s+(\S+)\s+(\S+)\s*$", data, flags=re.MULTILINE | re.IGNORECASE
    )
    facets = len(re.findall(rb"^\s*endfacet\b", data, flags=re.MULTILINE | re.IGNORECASE))
    if len(corners) != 3 * facets:
        raise ValueError(
            f"{path}: not a readable STL file ({len(corners)} corners in {facets} facets)"
        )
    if not facets:
        raise ValueError(f"{path}: the mesh has no triangles")
    try:
        vertices = np.array([[_number(number) for number in corner] for corner in corners])
    except ValueError as error:
        raise ValueError(f"{path}: not a readable STL file ({error})") from error
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


@dataclass
class _Element:
    """Record type of a PLY file: number of records, and properties.

    A property has a name, a type and, if it is a list, the type of its length.
    """

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


def _parse_ply(data: bytes) -> tuple[np.ndarray, Corners]:
    """Read vertices and faces of a PLY file; ignore other elements and properties."""
    data = data.removeprefix(MARK)
    head = re.match(
        rb"ply[ \t]*(?P<end>\r\n|\n|\r)(?P<lines>.*?(?P=end))\s*end_header[ \t]*(?P=end)",
        data,
        flags=re.DOTALL,
    )
    if not head:
        raise ValueError("its header does not begin with ply and end with end_header")
    order, elements = _ply_header(head["lines"].decode("ascii", "replace"))
    points = np.empty((0, 3))
    polygons: list[Sequence[int] | np.ndarray] = []
    source = _Records(data[head.end() :], order)
    for element in elements:
        names = [name for name, _, _ in element.properties]
        if not names or not element.count:
            continue
        check_claim(
            f"{element.count} x {element.name}",
            8 * element.count * len(names),
            **source.claim(element),
        )
        if any(length for _, _, length in element.properties):
            corners = (
                next((names.index(name) for name in PLY_CORNERS if name in names), -1)
                if element.name == "face"
                else -1
            )
            if corners >= 0 and element.properties[corners][1][0] == "f":
                raise ValueError("vertex indices of its faces are not integers")
            polygons += source.lists(element, corners)
        else:
            table = source.table(element)
            if element.name == "vertex":
                if missing := {"x", "y", "z"} - set(names):
                    raise ValueError(f"its vertices have no {min(missing)}")
                points = table[:, [names.index(axis) for axis in "xyz"]]
    return points, _blocks(polygons)


def _ply_header(text: str) -> tuple[str | None, list[_Element]]:
    """Return the byte order, None for text, and the elements of a header."""
    order: str | None = ""
    elements: list[_Element] = []
    for line in text.splitlines():
        match line.split():
            case ["format", kind, "1.0"] if kind in PLY_ORDERS:
                order = PLY_ORDERS[kind]
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name] if (
                elements and kind in PLY_TYPES and PLY_TYPES.get(length, "f")[0] != "f"
            ):
                elements[-1].properties.append((name, PLY_TYPES[kind], PLY_TYPES[length]))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1].properties.append((name, PLY_TYPES[kind], None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"unknown line in its header: {line[:80]!r}")
    if order == "":
        raise ValueError("its header has no format line")
    return order, elements


class _Records:
    """Records of a PLY file, read in sequence: binary numbers or words of a text.

    `order` is the byte order; None for text.
    """

    def __init__(self, body: bytes, order: str | None) -> None:
        self.body, self.words = body, body.split() if order is None else []
        self.order, self.at = order, 0

    def claim(self, element: _Element) -> dict[str, int]:
        """Return the least size of an element's records, and that of the data left.

        `stored` and `available` are in bytes, two per word of a text.
        """
        each = 2 if self.order is None else 1
        least = sum(self._width(length or kind) for _, kind, length in element.properties)
        return {"stored": each * element.count * least, "available": each * (self._size - self.at)}

    def table(self, element: _Element) -> np.ndarray:
        """Return records without lists, float64 of shape (count, properties)."""
        if self.order is None:
            words = self._next_values("f8", element.count * len(element.properties), element)
            return np.array([_number(word) for word in words]).reshape(element.count, -1)
        record = np.dtype(
            [
                (str(number), self.order + kind)
                for number, (_, kind, _) in enumerate(element.properties)
            ]
        )
        rows = np.frombuffer(self.body, record, element.count, self.at)
        self.at += rows.nbytes
        return np.stack([rows[name].astype(np.float64) for name in record.names or ()], axis=1)

    def lists(self, element: _Element, wanted: int) -> list[Sequence[int] | np.ndarray]:
        """Return a list property of each record, none if `wanted` is -1."""
        records: list[Sequence[int] | np.ndarray] = []
        for _ in range(element.count):
            for number, (_, kind, length) in enumerate(element.properties):
                count = _index(self._next_values(length, 1, element)[0]) if length else 1
                if count < 0:
                    raise ValueError(f"a list of a {element.name} has {count} entries")
                entries = self._next_values(kind, count, element)
                if number == wanted:
                    if not isinstance(entries, np.ndarray):
                        entries = np.array([_index(word) for word in entries], dtype=np.int64)
                    records.append(entries)
        return records

    @property
    def _size(self) -> int:
        """Number of bytes, or of words of a text."""
        return len(self.words if self.order is None else self.body)

    def _width(self, kind: str) -> int:
        return 1 if self.order is None else int(kind[1])

    def _next_values(
        self, kind: str, count: int, element: _Element
    ) -> Sequence[bytes] | np.ndarray:
        """Return the next numbers of a type, or words."""
        begin, self.at = self.at, self.at + count * self._width(kind)
        if not begin <= self.at <= self._size:
            raise ValueError(f"it ends within a {element.name}")
        return (
            self.words[begin : self.at]
            if self.order is None
            else np.frombuffer(self.body, self.order + kind, count, begin)
        )


def _parse_obj(data: bytes) -> tuple[np.ndarray, Corners]:
    """Read vertices and faces of an OBJ file.

    Indices count from 1, or backwards from the last vertex so far.
    """
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for line in (
        data.removeprefix(MARK)
        .decode("utf-8", errors="replace")
        .replace("\\\r\n", " ")
        .replace("\\\n", " ")
        .splitlines()
    ):
        words = line.split("#", 1)[0].split()
        if words[:1] == ["v"]:
            if len(words) < 4:
                raise ValueError("a vertex has fewer than three coordinates")
            vertices.append([_number(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            indices = [_index(word.split("/", 1)[0]) for word in words[1:]]
            polygons.append(
                [index - 1 if index >= 0 else index + len(vertices) for index in indices]
            )
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), _blocks(polygons)


def _number(word: str | bytes) -> float:
    """Return a coordinate; reject underscores, which Python accepts in 1_0."""
    text = word.decode("ascii", "replace") if isinstance(word, bytes) else word
    if "_" in text:
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


def _index(word: str | bytes | int) -> int:
    """Return the number of a vertex, or of entries; limited to the largest mesh."""
    if isinstance(word, (str, bytes)) and ("_" if isinstance(word, str) else b"_") in word:  # type: ignore[operator]
        raise ValueError(f"a face names a vertex by {word!r}")
    index = int(word)
    if abs(index) > LARGEST_INDEX:
        raise ValueError(f"a face names a vertex by a number of {len(str(abs(index)))} digits")
    return index
