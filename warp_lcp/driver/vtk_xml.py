"""Arrays as VTK's XML files hold them: their types, and their bytes as base64 text."""

from __future__ import annotations

import base64
from collections.abc import Iterator

import numpy as np

ENCODED = 3 * 2**18  # bytes encoded at a time, a multiple of 3: memory stays small, and other threads go on in between
LENGTH_BYTES = 8  # before each array, as header_type says


def opening(kind: str) -> bytes:
    """Return what a VTK file begins with.

    Args:
        kind: of the data set, such as `ImageData`.
    """
    return f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'.encode()


def writable(name: str, values: np.ndarray, size: int) -> np.ndarray:
    """Return a field in a type that VTK has (there are no booleans and no half floats), little-endian and contiguous.

    Args:
        name: of the field.
        values: shape (size,) or (size, 3).
        size: points or cells.

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


def attributes(name: str, values: np.ndarray) -> str:
    """Return the attributes of a data array that do not depend on where its bytes are."""
    kind = {"f": "Float", "i": "Int", "u": "UInt"}[values.dtype.kind] + str(8 * values.dtype.itemsize)
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    return f'type="{kind}" Name="{name}"{components}'


def length(values: np.ndarray) -> bytes:
    """Return what stands before an array's bytes: how many they are."""
    return values.nbytes.to_bytes(LENGTH_BYTES, "little")


def raw(values: np.ndarray) -> memoryview:
    """Return the bytes of an array that is contiguous, without copying them."""
    return values.reshape(-1).view(np.uint8).data


def inline(name: str, values: np.ndarray) -> Iterator[bytes]:
    """Yield a data array whose bytes stand in it as base64 text: what every reader of VTK's files understands, meshio among them.

    Args:
        name: of the array.
        values: little-endian and contiguous, shape (n,) or (n, components).
    """
    data = raw(values)
    yield f'<DataArray {attributes(name, values)} format="binary">'.encode()
    head = -LENGTH_BYTES % 3  # with so many bytes of the array the length fills whole groups of 3
    yield base64.b64encode(length(values) + bytes(data[:head]))
    for begin in range(head, len(data), ENCODED):
        yield base64.b64encode(data[begin : begin + ENCODED])
    yield b"</DataArray>\n"
