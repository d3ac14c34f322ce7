"""A part of a recorded problem, read without holding the rest in memory: each of several processes reads its own box of cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_lcp.gallery.recorded import opened
from warp_lcp.operators.grid_poisson import AXES

FIELDS = ("cells", "b", "lower", "upper", "shift")  # of the shape of `cells`, or a number


def cell_counts(path: Path) -> tuple[int, ...]:
    """Return the shape of a recorded problem's cells, (nz, ny, nx) or (ny, nx).

    Raises:
        ValueError: the file is none of a problem, or is damaged or of a later version; the message names it.
    """
    with opened(path) as archive:
        return archive.headers["cells"].shape


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
    with opened(path) as archive:
        return {
            name: archive.read_box(name, tuple(slice(s.start, s.stop + (faces.get(name) == axis)) for axis, s in enumerate(part)))
            for name in (*FIELDS, *faces)
            if name in archive.headers
        }
