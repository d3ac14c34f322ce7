"""Solve a recorded grid problem: `warp-lcp solve FILE.npz`.

The file is written by `run --record-problems`; one process or several ranks solve it.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.cli.solve_file import FileOutcome, criteria, method_named
from warp_lcp.default_chain import default_chain
from warp_lcp.files import Tables
from warp_lcp.files.atomic import replacing, replacing_by_name
from warp_lcp.method_selection import solve
from warp_lcp.operators import GridPoisson
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import FLOAT32_ROUNDING
from warp_lcp.recorded_problem import cell_counts, load_part
from warp_lcp.run.problem_folder import ProblemError
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid

if TYPE_CHECKING:
    from warp_lcp.distributed.decomposition import Decomposition
    from warp_lcp.distributed.ranks import Ranks

SUFFIX = ".npz"  # suffix of recorded problems
FIELD = ".npy"  # suffix of their solutions


@dataclass(frozen=True)
class GridOutcome(FileOutcome):
    """Result of a solve and the grid problem solved.

    Attributes:
        shape: shape of the whole grid's cells, (nz, ny, nx) or (ny, nx).
        unknowns: number of unknowns of the whole grid.
        decomposition: decomposition if the result has x of a rank's box; None for the whole grid.
    """

    shape: tuple[int, ...]
    unknowns: int
    decomposition: Decomposition | None

    def heading(self) -> str:
        """Return a line about the problem."""
        cells = " x ".join(map(str, reversed(self.shape)))
        line = (
            f"{self.unknowns} unknowns, {cells} cells, by {self.methods} on {self.problem.device}"
        )
        if self.decomposition is None:
            return line
        boxes = " x ".join(map(str, self.decomposition.processes))
        return f"{line}, ranks: {self.decomposition.ranks.size}, {boxes} boxes"

    def write(self, path: Path) -> None:
        """Write x as a NumPy array of the shape of the cells; collective.

        The first rank writes the parts of all ranks.

        Raises:
            ProblemError: the file cannot be written.
        """
        try:
            x = self.result.x.numpy()
            if self.decomposition is None:
                with replacing(path) as stream:
                    np.save(stream, x)
            else:
                _write_boxes(path, x, self.shape, self.decomposition)
        except OSError as error:
            raise ProblemError(f"--out {path}: {error.strerror or error}") from error


def solve_recorded(
    path: Path,
    *,
    method: str | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 1000,
    max_seconds: float = math.inf,
    device: str = "cpu",
    ranks: Ranks | None = None,
) -> GridOutcome:
    """Solve a recorded problem, from x = clip(0, lower, upper).

    Args:
        path: the file.
        method: a name in `METHODS`; the default method for grids if None.
        tolerance: residual, relative to the one at clip(0, lower, upper).
        max_iterations: limit of steps.
        max_seconds: limit of the wall time.
        device: a Warp device.
        ranks: ranks that solve it together, each with its own box of cells; collective. None for
            one process.

    Raises:
        ProblemError: the file or an option is invalid.
    """
    stopping = criteria(tolerance, max_iterations, max_seconds)
    solver = default_chain(ProjectedMultigrid())
    if method is not None:
        solver = method_named(method, "grid", shared=ranks is not None and ranks.size > 1)
    try:
        shape = cell_counts(path)
        decomposition = None if ranks is None else _decomposition(shape, ranks)
        problem = _problem(path, shape, decomposition, device, tolerance)
        result = solve(problem, solver, stopping=stopping)
    except ValueError as error:
        raise ProblemError(str(error)) from error
    return GridOutcome(
        problem,
        solver,
        method or str(result.method),
        result,
        shape,
        problem.A.unknowns,  # type: ignore[attr-defined]
        decomposition,
    )


def check_recorded(
    path: Path, *, right_side: Path | None, lower: str | None, upper: str | None, out: Path | None
) -> None:
    """Raise an error for options that are only for matrices.

    Raises:
        ProblemError: one was given; the message names it.
    """
    if right_side is not None:
        raise ProblemError(f"{right_side}: {path} has a right-hand side of its own")
    for option, value in (("lower", lower), ("upper", upper)):
        if value is not None:
            raise ProblemError(f"--{option} {value}: {path} has bounds of its own")
    if out is not None and out.suffix != FIELD:
        raise ProblemError(
            f"--out {out}: x of a grid is written as a NumPy array: the name must end in {FIELD}"
        )


def file_digest(path: Path) -> str | None:
    """Return a digest of a file's content; None if it cannot be read."""
    if not path.is_file():
        return None
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "blake2b").hexdigest()[:16]
    except OSError:
        return None


def _decomposition(shape: tuple[int, ...], ranks: Ranks) -> Decomposition:
    """Return the decomposition of a grid into boxes of cells."""
    from warp_lcp.distributed.decomposition import Decomposition

    nx, ny, nz = (*reversed(shape), 1)[:3]
    return Decomposition((nx, ny, nz), ranks)


def _problem(
    path: Path,
    shape: tuple[int, ...],
    decomposition: Decomposition | None,
    device: str,
    tolerance: float,
) -> LCP:
    """Return the problem, or this rank's part of it."""
    part = (
        tuple(slice(0, n) for n in shape)
        if decomposition is None
        else decomposition.box.slices[-len(shape) :]
    )
    kept = load_part(path, part)
    cells, b, lower, upper = (kept.pop(name) for name in ("cells", "b", "lower", "upper"))
    # Tolerances below the accuracy of float32 need the file's own precision.
    kind = wp.float64 if tolerance < FLOAT32_ROUNDING else wp.float32
    coefficients: Tables = {**kept}
    return LCP(
        GridPoisson(cells, decomposition=decomposition, device=device, dtype=kind, **coefficients),
        b,
        _bound(lower),
        _bound(upper),
    )


def _bound(values: np.ndarray) -> float | np.ndarray:
    """Return a bound as a number if it is constant, else as a field."""
    return values if values.ndim else float(values)


def _write_boxes(
    path: Path, x: np.ndarray, shape: tuple[int, ...], decomposition: Decomposition
) -> None:
    """Gather the ranks' boxes of x in one file.

    The root rank holds one box at a time in memory.
    """
    from warp_lcp.distributed.interruptible_wait import waiting

    comm, boxes = decomposition.ranks.comm, decomposition.boxes
    if not decomposition.ranks.is_root:
        with waiting("writing by the root rank"):
            comm.Send(np.ascontiguousarray(x, dtype=np.float64), dest=0)
        return
    with replacing_by_name(path) as temporary:
        solution = np.lib.format.open_memmap(temporary, mode="w+", dtype=np.float64, shape=shape)
        for rank, box in enumerate(boxes):
            part = box.slices[-len(shape) :]
            mine = x if rank == 0 else np.empty([s.stop - s.start for s in part])
            if rank:
                with waiting(f"the box of rank {rank}"):
                    comm.Recv(mine, source=rank)
            solution[part] = mine
        solution.flush()
        del solution
