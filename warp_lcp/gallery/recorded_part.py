"""A part of a recorded problem, read without holding the rest in memory: each of several processes reads its own box of cells."""

from __future__ import annotations

import zipfile
import zlib
from math import prod
from pathlib import Path
from typing import IO

import numpy as np

from warp_lcp.gallery.recorded import check
from warp_lcp.operators.grid_poisson import AXES

FIELDS = ("cells", "b", "lower", "upper", "shift")  # of the shape of `cells`, or a number
SUFFIX = ".npy"  # of an archive's members


def cell_counts(path: Path) -> tuple[int, ...]:
    """Return the shape of a recorded problem's cells, (nz, ny, nx) or (ny, nx).

    Raises:
        ValueError: the file is none of a problem, or is damaged or of a later version; the message names it.
    """
    check(path)
    try:
        with zipfile.ZipFile(path) as archive, archive.open("cells" + SUFFIX) as stream:
            shape = _header(stream)[0]
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: no recorded problem: {error}") from error
    if len(shape) not in (2, 3):
        raise ValueError(f"{path}: no recorded problem: cells has {len(shape)} axes")
    return shape


def load_part(path: Path, part: tuple[slice, ...]) -> dict[str, np.ndarray]:
    """Return the arrays of a recorded problem in a box of cells: `cells`, `b`, bounds, coefficients of its faces (upper ones too), shift.

    The file is read from its start to the box's end, one plane of cells (in 2-D one row) at a time.

    Args:
        path: the file.
        part: which cells, a slice of each axis of `cells`.

    Raises:
        ValueError: the file is none of a problem, or is damaged or of a later version; the message names it.
    """
    faces = {f"face_{AXES[axis]}": len(part) - 1 - axis for axis in range(len(part))}
    found = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in (*FIELDS, *faces):
                if name + SUFFIX in archive.namelist():
                    with archive.open(name + SUFFIX) as stream:
                        wanted = tuple(slice(s.start, s.stop + (faces.get(name) == axis)) for axis, s in enumerate(part))
                        found[name] = _read(stream, wanted)
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: no recorded problem: {error}") from error
    return found


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return an array's shape, whether its first axis is the fastest, and its type."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    return np.lib.format.read_array_header_2_0(stream)


def _read(stream: IO[bytes], part: tuple[slice, ...]) -> np.ndarray:
    """Return a part of an array; all of one without axes."""
    shape, fastest_first, kind = _header(stream)
    if kind.hasobject:
        raise ValueError("it holds objects")
    if shape and len(shape) != len(part):
        raise ValueError(f"an array has {len(shape)} axes, cells {len(part)}")
    if not shape:
        return np.frombuffer(_exactly(stream, kind.itemsize), dtype=kind).reshape(())
    if fastest_first:
        whole = np.frombuffer(_exactly(stream, prod(shape) * kind.itemsize), dtype=kind)
        return np.ascontiguousarray(whole.reshape(shape, order="F")[part])
    plane = prod(shape[1:]) * kind.itemsize
    for _ in range(part[0].start):
        _exactly(stream, plane)
    rows = range(part[0].start, min(part[0].stop, shape[0]))
    planes = [np.frombuffer(_exactly(stream, plane), dtype=kind).reshape(shape[1:])[part[1:]].copy() for _ in rows]
    return np.stack(planes)


def _exactly(stream: IO[bytes], count: int) -> bytes:
    """Return so many bytes.

    Raises:
        ValueError: there are fewer.
    """
    read = stream.read(count)
    if len(read) != count:
        raise ValueError("it is cut short")
    return read
