"""VTI files: cells as an image with hidden cells."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from warp_lcp.files.atomic import replacing
from warp_lcp.files.size_limits import read_whole
from warp_lcp.frames.vtk_xml import (
    LENGTH_BYTES,
    array_values,
    attributes,
    length,
    opening,
    raw,
    read_back,
    root,
    writable_fields,
)
from warp_lcp.simulation import Cells

HIDDEN = 32  # vtkDataSetAttributes::HIDDENCELL
GHOSTS = "vtkGhostType"  # name of VTK's array of hidden cells
APPENDED = b'<AppendedData encoding="raw">\n_'
XML_BYTES = 1000


def write_vti(path: Path, cells: Cells) -> None:
    """Write cells as a VTI file, atomically.

    Fields cover the whole grid (0 in hidden cells), as raw bytes after the text.

    Args:
        path: the file.
        cells: the shown cells; without `counts` the image is the box around them.

    Raises:
        OSError: the file cannot be written.
        ValueError: a field has another length than the cells, or a cell lies outside the grid.
    """
    _, fields = writable_fields(cells)
    low, counts = image_box(cells)
    columns = cells.index.T
    if len(cells.index) and any(
        c.min() < a or c.max() >= a + n for c, a, n in zip(columns, low, counts, strict=True)
    ):
        raise ValueError(
            f"the grid of {' x '.join(map(str, counts))} cells does not hold all cells of "
            f"{cells.name!r}"
        )
    x, y, z = (column - first for column, first in zip(columns, low, strict=True))
    flat = (z * counts[1] + y) * counts[0] + x
    end = image_end(low, counts, cells.dimension)
    with replacing(path) as file:
        file.writelines(_vti(low, end, cells.spacing, fields, flat, int(counts.prod())))


def image_end(low: np.ndarray, counts: np.ndarray, dimension: int) -> np.ndarray:
    """Return the last corner of an image [cells] from its first corner `low`.

    An image of pixels has no extent along z.
    """
    return low + np.where(np.arange(3) < dimension, counts, 0)


def extent_of(low: np.ndarray, end: np.ndarray) -> str:
    """Return an image's first and last corner in VTK's format."""
    return " ".join(f"{a} {b}" for a, b in zip(low, end, strict=True))


def vti_bytes(cells: Cells) -> int:
    """Return an upper estimate of the size of the file of cells [bytes]."""
    each = sum(
        values.itemsize * values[:1].size if len(values) else 8 for values in cells.fields.values()
    )
    return XML_BYTES + int(image_box(cells)[1].prod()) * (each + 1)


def read_vti(path: Path) -> Cells:
    """Return the shown cells of a file of `write_vti`, without `counts`.

    The file does not tell `counts` from the box around the cells.

    Args:
        path: the file; its name up to the last _ is that of the cells.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no such file, or truncated.
    """
    with read_back(path):
        text, mark, data = read_whole(path).partition(APPENDED)
        if not mark:
            raise ValueError("has no cells stored as raw bytes")
        image = root(text + b"</VTKFile>", "ImageData")
        extent = [int(number) for number in image.get("WholeExtent", "").split()]
        low, end = np.array(extent[::2], dtype=np.int64), np.array(extent[1::2], dtype=np.int64)
        spacing = float(image.get("Spacing", "").split()[0])
        counts = [
            max(last - first, 1) for first, last in zip(extent[::2], extent[1::2], strict=True)
        ]
        arrays = {
            str(array.get("Name")): array_values(array, data, int(array.get("offset", "0")))
            for array in image.iter("DataArray")
        }
        fits = all(len(array) == math.prod(counts) for array in arrays.values()) and sum(
            array.nbytes for array in arrays.values()
        ) <= len(data)
        if len(extent) != 6 or not 0.0 < spacing < math.inf or not fits:
            raise ValueError(f"its arrays do not match its {' x '.join(map(str, counts))} cells")
        shown = np.flatnonzero(arrays.pop(GHOSTS) == 0)
        index = np.stack(np.unravel_index(shown, counts, order="F"), axis=-1) + low
        fields = {name: array[shown] for name, array in arrays.items()}
        return Cells(
            path.stem.rpartition("_")[0], index, spacing, 2 if low[2] == end[2] else 3, fields
        )


def image_box(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
    """Return the first cell of the image, and its cells along x, y and z."""
    if cells.box is not None:
        low, high = np.array(cells.box)
        return low, high - low
    if cells.counts is not None:
        return np.zeros(3, dtype=int), np.array(cells.counts)
    if len(cells.index) == 0:
        return np.zeros(3, dtype=int), np.ones(3, dtype=int)  # VTK has no image without a cell
    low = cells.index.min(axis=0)
    return low, cells.index.max(axis=0) - low + 1


def _vti(
    low: np.ndarray,
    end: np.ndarray,
    spacing: float,
    fields: dict[str, np.ndarray],
    flat: np.ndarray,
    size: int,
) -> Iterator[bytes | memoryview]:
    """Yield the parts of a VTI file, with one field at a time in memory.

    Args:
        low: first corner of the image [cells].
        end: its last corner.
        spacing: cell size [m].
        fields: values in the shown cells.
        flat: flat indices of the shown cells in the image.
        size: number of cells of the image.
    """
    hidden = np.zeros(1, dtype=np.uint8)
    extent = extent_of(low, end)
    yield opening("ImageData")
    yield (
        f'<ImageData WholeExtent="{extent}" Origin="0 0 0" Spacing="{spacing} {spacing} '
        f'{spacing}">\n'
    ).encode()
    yield f'<Piece Extent="{extent}">\n<CellData>\n'.encode()
    offset = 0
    for name, values in {**fields, GHOSTS: hidden}.items():
        yield (
            f'<DataArray {attributes(name, values)} format="appended" offset="{offset}"/>\n'
        ).encode()
        offset += LENGTH_BYTES + size * math.prod(values.shape[1:]) * values.itemsize
    yield b"</CellData>\n</Piece>\n</ImageData>\n" + APPENDED
    for values in fields.values():
        dense = np.zeros((size, *values.shape[1:]), dtype=values.dtype)
        dense[flat] = values
        yield length(dense)
        yield raw(dense)
    hidden = np.full(size, HIDDEN, dtype=np.uint8)
    hidden[flat] = 0
    yield length(hidden)
    yield raw(hidden)
    yield b"\n</AppendedData>\n</VTKFile>\n"
