"""Safe reader of real Matrix Market files.

SciPy's reader (1.17) ends the process if a number is truncated.
"""

from __future__ import annotations

import bz2
import gzip
import re
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse

from warp_lcp.files.size_limits import SizeLimitError, check_claim, free_host_memory, read_whole

PACKED: dict[str, Callable[[Path], gzip.GzipFile | bz2.BZ2File]] = {
    ".gz": gzip.open,
    ".bz2": bz2.open,
}
HEADER = re.compile(
    rb"%%MatrixMarket[ \t]+matrix[ \t]+(?P<form>coordinate|array)[ \t]+"
    rb"(?P<field>real|double|integer|unsigned-integer|pattern|complex)[ \t]+"
    rb"(?P<symmetry>general|symmetric|skew-symmetric|hermitian)[ \t]*\r?\n(?:[ "
    rb"\t]*+(?:%[^\n]*+)?\r?\n)*+"
    rb"(?P<size>[ \t]*\d{1,18}(?:[ \t]+\d{1,18}){1,2})[ \t]*+(?:\r?\n|\Z)",
    re.IGNORECASE,
)
COPIES = 5  # copies of the text in memory: the shortest number has 2 bytes, and 8 after conversion
NUMBER = 8  # bytes
HEAD = 1 << 16  # bytes that are searched for a header before the whole file is read
Matrix = scipy.sparse.csr_array | np.ndarray  # of a file, float64
ShapeTest = Callable[[int, int], bool]  # whether a matrix of these sizes is allowed


class MarketError(ValueError):
    """Error of the file format; the message does not include the file's name."""


def read_shape(path: Path, fits: ShapeTest, expected: str) -> tuple[int, int]:
    """Return rows and columns from the header of a matrix.

    Args:
        path: the file; .gz and .bz2 are unpacked.
        fits: whether a shape is allowed.
        expected: description of allowed shapes for the message.

    Raises:
        OSError: the file cannot be read.
        ValueError: as `read_market`.
    """
    text = _text(path, HEAD)
    header = HEADER.match(text)
    # A long comment, or a truncated size.
    if len(text) == HEAD and (header is None or header.end() == HEAD):
        header = HEADER.match(_text(path))
    rows, columns, more = _size(header, fits, expected)
    if more and header is not None and path.suffix not in PACKED:
        width = 2 if header["field"].lower() == b"pattern" else 3
        _check_stored(
            _entries(rows, columns, more[0]), width * more[0], path.stat().st_size - header.end()
        )
    return rows, columns


def read_market(path: Path, fits: ShapeTest, expected: str) -> Matrix:
    """Read a matrix: scipy.sparse (CSR) or numpy, as in the file, float64.

    Args:
        path: the file; .gz and .bz2 are unpacked.
        fits: whether a shape is allowed; called before the matrix is read.
        expected: description of allowed shapes for the message.

    Raises:
        OSError: the file cannot be read.
        MarketError: the file is not of this format.
        ValueError: its numbers are complex, or its shape does not fit.
        ClaimError: its sizes exceed the file or the free memory.
    """
    text = _text(path)
    header = HEADER.match(text)
    rows, columns, more = _size(header, fits, expected)
    assert header is not None
    form, field, symmetry = (header[name].lower() for name in ("form", "field", "symmetry"))
    body = text[header.end() :]
    if form == b"array":
        return _dense(body, rows, columns, symmetry)
    return _sparse(body, rows, columns, more[0], symmetry, pattern=field == b"pattern")


def _size(
    header: re.Match[bytes] | None, fits: ShapeTest, expected: str
) -> tuple[int, int, list[int]]:
    """Check a header; return rows, columns and the number of entries.

    The last one only for sparse matrices.
    """
    if header is None:
        raise MarketError(
            "it must begin with %%MatrixMarket matrix FORM FIELD SYMMETRY and a line with its size"
        )
    form, field, symmetry = (header[name].lower() for name in ("form", "field", "symmetry"))
    rows, columns, *more = map(int, header["size"].split())
    if field == b"complex":
        raise ValueError("holds complex numbers: A, b and bounds must be real")
    if not fits(rows, columns):
        raise ValueError(f"has shape {rows} x {columns}: {expected}")
    if len(more) != (form == b"coordinate") or (form == b"array" and field == b"pattern"):
        raise MarketError("the line with its size does not fit its form")
    if symmetry != b"general" and rows != columns:
        raise MarketError(f"has shape {rows} x {columns}: symmetric matrices are square")
    return rows, columns, more


def _dense(body: bytes, rows: int, columns: int, symmetry: bytes) -> np.ndarray:
    """Return a dense matrix, stored by columns.

    Of a symmetric matrix, the file has the lower triangle, without the diagonal if that is 0.
    """
    skew = symmetry == b"skew-symmetric"
    count = (
        rows * columns if symmetry == b"general" else rows * (rows - 1 if skew else rows + 1) // 2
    )
    values = _numbers(body, count, f"{rows} x {columns} values", NUMBER * rows * columns)
    if symmetry == b"general":
        return np.ascontiguousarray(values.reshape(columns, rows).T)
    found = np.zeros((rows, rows))
    column, row = np.triu_indices(rows, k=int(skew))
    found[row, column] = values
    found[column, row] = -values if skew else values
    return found


def _sparse(
    body: bytes, rows: int, columns: int, entries: int, symmetry: bytes, *, pattern: bool
) -> scipy.sparse.csr_array:
    """Return a sparse matrix from entries (row, column, value), counted from 1."""
    width = 2 if pattern else 3
    what = _entries(rows, columns, entries)
    table = _numbers(
        body, width * entries, what, NUMBER * (rows + columns + 2 * width * entries)
    ).reshape(entries, width)
    kind: type[np.integer] = np.int32 if max(rows, columns) <= np.iinfo(np.int32).max else np.int64
    with np.errstate(invalid="ignore"):  # conversion changes an index that is no whole number
        row, column = (table[:, axis].astype(kind) - 1 for axis in range(2))
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    if not (inside & (row + 1.0 == table[:, 0]) & (column + 1.0 == table[:, 1])).all():
        raise MarketError(f"an entry is outside of rows 1 to {rows} and columns 1 to {columns}")
    value = np.ones(entries) if pattern else table[:, 2]
    if symmetry != b"general":
        other = row != column
        sign = -1.0 if symmetry == b"skew-symmetric" else 1.0
        row, column = np.concatenate([row, column[other]]), np.concatenate([column, row[other]])
        value = np.concatenate([value, sign * value[other]])
    return scipy.sparse.coo_array((value, (row, column)), shape=(rows, columns)).tocsr()


def _numbers(body: bytes, count: int, what: str, needed: int) -> np.ndarray:
    """Return exactly `count` numbers of a text.

    Args:
        body: the text.
        count: expected number.
        what: name of the numbers in messages.
        needed: memory of the result [bytes].
    """
    _check_stored(what, count, len(body), needed)
    try:
        with warnings.catch_warnings():
            # NumPy then reports invalid numbers.
            warnings.simplefilter("error", DeprecationWarning)
            found = np.fromstring(body, dtype=np.float64, sep=" ") if body.strip() else np.zeros(0)
    except (DeprecationWarning, ValueError) as error:
        raise MarketError("it holds an entry that is not a number") from error
    if len(found) != count:
        raise MarketError(f"it holds {len(found)} numbers, expected {count} for {what}")
    return found


def _entries(rows: int, columns: int, entries: int) -> str:
    return f"{rows} x {columns} with {entries} entries"


def _check_stored(what: str, count: int, held: int, needed: int = 0) -> None:
    """Raise an error if a count of numbers exceeds the file or free memory."""
    check_claim(what, needed, stored=len("1\n") * count - 1, available=held)


def _text(path: Path, most: int | None = None) -> bytes:
    """Return the content of a file, or its first bytes; .gz and .bz2 are unpacked."""
    unpack = PACKED.get(path.suffix)
    if unpack is None and most is not None and path.is_file():
        with path.open("rb") as stream:
            return stream.read(most)
    if unpack is None:
        return read_whole(path, copies=COPIES)
    free = free_host_memory()
    try:
        with unpack(path) as stream:
            if most is not None:
                return bytes(stream.read(most))
            text: bytes = stream.read(-1 if free is None else free // COPIES)
            if free is not None and stream.read(1):
                raise SizeLimitError("its unpacked content does not fit into the free memory")
    except (EOFError, zlib.error, MemoryError) as error:
        raise MarketError(f"cannot be unpacked: {error}") from error
    return text
