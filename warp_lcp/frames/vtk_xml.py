"""Arrays in VTK's XML files: types, base64 text, and safe reading."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from warp_lcp.simulation import Cells, Points, Surface

# Bytes encoded at a time, a multiple of 3: memory stays small, and other threads run in between.
ENCODED = 3 * 2**18
TYPE = re.compile(r"(?P<kind>Float|Int|UInt)(?P<bits>8|16|32|64)")
LENGTH_BYTES = 8  # before each array, see header_type


def opening(kind: str) -> bytes:
    """Return the beginning of a VTK file.

    Args:
        kind: type of the data set, such as `ImageData`.
    """
    return (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" '
        'header_type="UInt64">\n'
    ).encode()


def writable(name: str, values: np.ndarray, size: int) -> np.ndarray:
    """Return a field in a type of VTK, little-endian and contiguous.

    VTK has neither booleans nor half floats.

    Args:
        name: name of the field.
        values: shape (size,) or (size, 3).
        size: number of points or cells.

    Raises:
        ValueError: the field has another length.
    """
    if len(values) != size:
        raise ValueError(f"field {name!r} has {len(values)} entries for {size} points or cells")
    if values.dtype == np.bool_:
        values = values.astype(np.uint8)
    elif values.dtype == np.float16:
        values = values.astype(np.float32)
    return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))


def writable_fields(part: Points | Cells | Surface) -> tuple[int, dict[str, np.ndarray]]:
    """Return the number of points or cells of a part, and its writable fields."""
    size = len(part.index if isinstance(part, Cells) else part.points)
    return size, {name: writable(name, values, size) for name, values in part.fields.items()}


def attributes(name: str, values: np.ndarray) -> str:
    """Return the attributes of a data array, except its offset."""
    kind = {"f": "Float", "i": "Int", "u": "UInt"}[values.dtype.kind] + str(
        8 * values.dtype.itemsize
    )
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    return f'type="{kind}" Name="{name}"{components}'


def length(values: np.ndarray) -> bytes:
    """Return the length prefix of an array's bytes."""
    return values.nbytes.to_bytes(LENGTH_BYTES, "little")


def raw(values: np.ndarray) -> memoryview:
    """Return the bytes of a contiguous array, without a copy."""
    return values.reshape(-1).view(np.uint8).data


def inline(name: str, values: np.ndarray) -> Iterator[bytes]:
    """Yield a data array with base64 text inside.

    Every reader of VTK's files supports it, including meshio.

    Args:
        name: name of the array.
        values: little-endian and contiguous, shape (n,) or (n, components).
    """
    data = raw(values)
    yield f'<DataArray {attributes(name, values)} format="binary">'.encode()
    head = -LENGTH_BYTES % 3  # bytes of the array that complete the length to groups of 3
    yield base64.b64encode(length(values) + bytes(data[:head]))
    for begin in range(head, len(data), ENCODED):
        yield base64.b64encode(data[begin : begin + ENCODED])
    yield b"</DataArray>\n"


@contextmanager
def read_back(path: Path) -> Iterator[None]:
    """Convert errors while a file is read into one that names it.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not a file of a run.
    """
    try:
        yield
    except (
        ValueError,
        LookupError,
        TypeError,
        OverflowError,
        MemoryError,
        AttributeError,
        ElementTree.ParseError,
    ) as error:
        raise ValueError(
            f"{path}: is not a readable frame: {str(error) or type(error).__name__}"
        ) from error


def root(text: bytes, kind: str) -> ElementTree.Element:
    """Return the data set of a file that starts with `opening`.

    Raises:
        ValueError: it is another type, or declares entities, which can expand a few bytes without
            limit.
        ParseError: it is not XML.
    """
    if b"<!" in text:
        raise ValueError("declares a document type, which is not allowed")
    try:
        file = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"not XML: {error}") from error
    data = file.find(kind)
    if (
        data is None
        or (file.get("byte_order"), file.get("header_type")) != ("LittleEndian", "UInt64")
        or file.get("compressor")
    ):
        raise ValueError(
            f"not a {kind} as a run writes it: little-endian, 64-bit lengths, uncompressed"
        )
    return data


def data_type(array: ElementTree.Element) -> np.dtype:
    """Return the type of a data array.

    Raises:
        ValueError: VTK has no such type.
    """
    match = TYPE.fullmatch(array.get("type", ""))
    if match is None or (match["kind"], match["bits"]) in (("Float", "8"), ("Float", "16")):
        raise ValueError(f"{array.get('Name')!r} is of the type {array.get('type')!r}")
    return np.dtype(f"<{match['kind'][0].lower()}{int(match['bits']) // 8}")


def array_values(array: ElementTree.Element, data: bytes, at: int = 0) -> np.ndarray:
    """Return a data array, shape (n,) or (n, components), from length and bytes.

    Args:
        array: its attributes.
        data: the bytes.
        at: offset of the length in the bytes.

    Raises:
        ValueError: there are fewer bytes than the length says, or no whole rows.
    """
    dtype, components = data_type(array), int(array.get("NumberOfComponents", "1"))
    size = int.from_bytes(data[at : at + LENGTH_BYTES], "little")
    held = len(data) - at - LENGTH_BYTES
    if at < 0 or not 0 <= size <= held or components < 1 or size % (components * dtype.itemsize):
        raise ValueError(
            f"{array.get('Name')!r} of {size} bytes is cut short, or not a multiple of "
            f"{components} values"
        )
    found = np.frombuffer(data, dtype, size // dtype.itemsize, at + LENGTH_BYTES)
    return found.reshape(-1, components) if components > 1 else found


def inline_values(array: ElementTree.Element) -> np.ndarray:
    """Return a data array written by `inline`.

    Raises:
        ValueError: it is no such array.
    """
    if array.get("format") != "binary":
        raise ValueError(f"{array.get('Name')!r} is not base64 text")
    return array_values(array, base64.b64decode((array.text or "").strip(), validate=True))
