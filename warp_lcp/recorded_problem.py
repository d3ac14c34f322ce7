"""Recorded grid problems, `problem_<step>.npz`: pressure problems of a run."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.files import Tables
from warp_lcp.files.archive import Archive
from warp_lcp.files.size_limits import check_claim
from warp_lcp.host_problem import Problem
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.grid_poisson import AXES, FLUID, GridPoisson
from warp_lcp.problem.lcp import LCP

FORMAT = 1
PROBLEM_FILE = re.compile(r"problem_(?P<step>\d{6,})\.npz")
NUMBERS = ("step", "time", "dt", "spacing", "tolerance", "absolute_tolerance")
REQUIRED = frozenset({"format", "cells", "b", "lower", "upper", "x0", *NUMBERS})
FIELDS = frozenset({"cells", "b", "lower", "upper", "x0", "face_x", "face_y", "face_z", "shift"})
PLACED = ("cells", "b", "lower", "upper", "shift")  # of the shape of `cells`, or a number
KNOWN = REQUIRED | FIELDS  # further arrays of a file are ignored
DESCRIPTION = """\
# Complementarity problems of a simulation

`problem_<step>.npz` is the problem of the step from <step> to <step> + 1: find x with y = A x + b,
lower <= x <= upper, and y > 0 only where x = lower, y < 0 only where x = upper. Of a step that was
tried again it is the last attempt; a step without liquid cells has none. The files are NumPy
archives of plain arrays (`numpy.load`, no pickles). Cells are indexed [z, y, x], or [y, x] in 2-D.

| key | type | shape | meaning |
|---|---|---|---|
| `format` | int64 | () | 1 |
| `cells` | int8 | (nz, ny, nx) or (ny, nx) | 0 AIR: x = 0; 1 FLUID: an unknown; 2 SOLID: closed, as all beyond the grid is |
| `face_x`, `face_y`, `face_z` | float32 or float64 | one more along the axis | coefficients of the faces; 1 where there is no such key |
| `shift` | float32 or float64 | as `cells` | added to the diagonal; 0 where there is no such key |
| `b`, `x0` | float64 | as `cells` | right-hand side, and where the simulation started; 0 off FLUID |
| `lower`, `upper` | float64 | () or as `cells` | bounds; -inf or inf where there is none |
| `step`, `time`, `dt`, `spacing` | int64, float64 | () | steps done before; their time [s]; length of the step [s]; edge of a cell [m] |
| `tolerance`, `absolute_tolerance` | float64 | () | what the solve was held to: r <= max(absolute, tolerance r at clip(0, lower, upper)) |

(A x)_i = shift_i x_i + sum of face (x_i - x_neighbor) over the faces of FLUID cell i that no SOLID
cell touches. r is the 2-norm of d (x - clip(x - y / d, lower, upper)) with d the diagonal of A.
`absolute_tolerance` has the unit of y.

`warp_lcp.recorded_problem.load(file)` gives the problem to Python;
`warp-lcp solve FILE --method NAME` solves it.
"""


@dataclass(frozen=True, eq=False)
class RecordedProblem(Problem):
    """Problem recorded by a simulation.

    Args:
        x0: first guess of the simulation, a field like b.
        step: number of steps before.
        time: time after them [s].
        dt: length of the step [s].
        spacing: cell size [m].
        tolerance: relative residual that the simulation required.
        absolute_tolerance: residual that it counted as 0, in the units of y.
    """

    x0: np.ndarray
    step: int
    time: float
    dt: float
    spacing: float
    tolerance: float
    absolute_tolerance: float


def arrays(problem: LCP, x0: DeviceArray) -> dict[str, np.ndarray]:
    """Return the arrays of a recorded problem, on the host.

    The caller adds `NUMBERS`.

    Args:
        problem: the problem, whose operator is a GridPoisson.
        x0: first guess, float64 in the padded layout.

    Raises:
        ValueError: the operator is no GridPoisson, or an axis is periodic.
    """
    A = problem.A
    if not isinstance(A, GridPoisson) or any(A.periodic):
        raise ValueError("only problems of a GridPoisson without periodic axes can be recorded")
    cells = _inner(A.cells, A)
    fluid = cells == FLUID
    saved: dict[str, np.ndarray] = {"format": np.array(FORMAT), "cells": cells}
    for name, field in (("b", problem.b), ("x0", x0)):
        saved[name] = np.where(fluid, _inner(field, A), 0.0)
    for name, bound, none in (("lower", problem.lower, -np.inf), ("upper", problem.upper, np.inf)):
        host = _inner(bound, A)
        first = host[fluid][0]
        saved[name] = (
            np.array(first) if (host[fluid] == first).all() else np.where(fluid, host, none)
        )
    for axis in range(len(A.shape)):
        if A.faces[axis].size:
            saved[f"face_{AXES[axis]}"] = _inner(A.faces[axis], A, axis)
        elif A.uniform[axis] != 1.0:
            faces = [n + (a == len(A.shape) - 1 - axis) for a, n in enumerate(A.shape)]
            saved[f"face_{AXES[axis]}"] = np.full(faces, A.uniform[axis])
    if A.shift.size:
        host = _inner(A.shift, A)
        saved["shift"] = np.where(fluid, host, host.dtype.type(0))
    return saved


def _inner(field: DeviceArray, A: GridPoisson, axis: int | None = None) -> np.ndarray:
    """Return a stored field without its ring.

    A field of faces includes the upper faces of the last cells.
    """
    host = field.numpy().reshape(A.layout.stored_shape)
    inner = host[
        tuple(slice(1, None if axis is not None and a == 2 - axis else -1) for a in range(3))
    ]
    return np.ascontiguousarray(inner if len(A.shape) == 3 else inner[0])


def files(folder: Path) -> list[Path]:
    """Return the problem files of a folder by step; empty if there is no folder."""
    found = [
        (int(match["step"]), path)
        for path in folder.glob("problem_*.npz")
        if (match := PROBLEM_FILE.fullmatch(path.name))
    ]
    return [path for _, path in sorted(found)]


def load(path: Path, *, device: wp.DeviceLike = None, dtype: type = wp.float32) -> RecordedProblem:
    """Read a recorded problem.

    Args:
        path: the file.
        device: Warp device of its operator; the default device if None.
        dtype: storage type of the operator's coefficients.

    Raises:
        ValueError: the file is not a recorded problem, or is damaged or of a later version; the
            message names it.
    """
    with opened(path) as archive:
        saved = archive.read(sorted(KNOWN & archive.headers.keys()))
        coefficients: Tables = {
            name: saved[name] for name in ("face_x", "face_y", "face_z", "shift") if name in saved
        }
        A = GridPoisson(saved["cells"], device=device, dtype=dtype, **coefficients)
        b, lower, upper, x0 = (
            np.broadcast_to(saved[name], A.shape).astype(np.float64)
            for name in ("b", "lower", "upper", "x0")
        )
        numbers: Tables = {name: saved[name].item() for name in NUMBERS}
        facts = {"symmetric", "semidefinite"} | (
            {"mixed"} if np.isneginf(lower[saved["cells"] == FLUID]).any() else set()
        )
        return RecordedProblem(
            Path(path).stem, A, b, lower, upper, None, frozenset(facts), x0, **numbers
        )


def check(path: Path) -> None:
    """Check that a file holds a recorded problem, without reading its fields.

    Raises:
        ValueError: it does not, or is truncated or of a later version; the message names it.
    """
    with opened(path):
        pass


@contextmanager
def opened(path: Path) -> Iterator[Archive]:
    """Open a recorded problem and check it, without reading its fields.

    Raises:
        ValueError: it is not one, is damaged, of a later version, or larger than the free memory;
            the message names it. Errors of the block about the content of the file are reported in
            the same way.
    """
    try:
        with Archive(Path(path)) as archive:
            _check(archive)
            yield archive
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: is not a recorded problem: {error}") from error


def _check(archive: Archive) -> None:
    """Raise an error if the arrays of an archive are not those of a problem."""
    headers = archive.headers
    if (
        "format" in headers
        and not headers["format"].shape
        and (version := archive.read(["format"])["format"].item()) != FORMAT
    ):
        raise ValueError(f"its format is {version!r}, this version reads {FORMAT}")
    missing = sorted(REQUIRED - headers.keys())
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    shape = headers["cells"].shape
    if len(shape) not in (2, 3) or headers["cells"].dtype != np.int8:
        raise ValueError(f"cells is {headers['cells']}: must be int8 of 2 or 3 axes")
    faces = {
        f"face_{axis}": tuple(n + (a == number) for a, n in enumerate(reversed(shape)))[::-1]
        for number, axis in enumerate(AXES)
    }
    for name in KNOWN & headers.keys() - {"cells"}:
        header, allowed = headers[name], [faces.get(name, shape)] if name in FIELDS else [()]
        if name in ("lower", "upper"):
            allowed = [(), shape]
        if header.shape not in allowed or header.dtype.kind not in "fi":
            raise ValueError(
                f"{name} is {header}: must be numbers of shape {' or '.join(map(str, allowed))}"
            )
    values = prod(shape) * len(FIELDS & headers.keys())
    check_claim(
        f"fields of {' x '.join(map(str, reversed(shape)))} cells",
        values * np.dtype(np.float64).itemsize,
    )


def cell_counts(path: Path) -> tuple[int, ...]:
    """Return the shape of a recorded problem's cells, (nz, ny, nx) or (ny, nx).

    Raises:
        ValueError: the file is not a recorded problem, or is damaged or of a later version; the
            message names it.
    """
    with opened(path) as archive:
        return archive.headers["cells"].shape


def load_part(path: Path, part: tuple[slice, ...]) -> dict[str, np.ndarray]:
    """Return the arrays of a recorded problem in a box of cells.

    `cells`, `b`, bounds, face coefficients (upper faces included) and shift. The file is read from
    its start to the end of the box, one plane of cells (in 2-D one row) at a time.

    Args:
        path: the file.
        part: the cells, a slice for each axis of `cells`.

    Raises:
        ValueError: the file is not a recorded problem, or is damaged or of a later version; the
            message names it.
    """
    faces = {f"face_{AXES[axis]}": len(part) - 1 - axis for axis in range(len(part))}
    with opened(path) as archive:
        return {
            name: archive.read_box(
                name,
                tuple(
                    slice(s.start, s.stop + (faces.get(name) == axis))
                    for axis, s in enumerate(part)
                ),
            )
            for name in (*PLACED, *faces)
            if name in archive.headers
        }
