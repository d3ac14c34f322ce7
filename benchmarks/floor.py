"""How far a solve can get: the smallest residual that each precision reaches, against the size of the grid.

Solves are asked for a residual of 0 and end at their floor. Residuals are computed here from x, cells and b, in float64, by nothing that
the solvers use.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks.machine import COPIED, machine
from warp_lcp.benchmarks.problems import Splash, splash
from warp_lcp.benchmarks.record import Chart, Lines, Record, Results, Table
from warp_lcp.benchmarks.targets import Target
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.run.devices import free_memory

TITLE = "The smallest residual of each precision against the size of the grid"
SIZES = (16, 32, 64, 128, 256)
PRECISIONS = ("single", "mixed", "double")
BOUNDS = ("linear", "walls")
ASKED = 1e-8  # relative residual that mixed precision must reach on every grid
STOPPING = wl.StoppingCriteria(rtol=0.0, max_iterations=60, patience=6)
BYTES = 220  # a cell: the scene, its fields, operator, problem and workspace in float64, and the arrays of the check


@dataclass(frozen=True)
class Floor:
    """How a solve without a tolerance ended.

    Attributes:
        n: cells along a side.
        bounds: `linear` or `walls`.
        precision: of the method.
        relative: smallest residual over that of the start, computed here.
        told: the same, as the solve tells it.
        status: how it ended.
        iterations: steps.
        seconds: of set-up and solve [s].
        history: relative residuals of the steps, as the solve tells them.
    """

    n: int
    bounds: str
    precision: str
    relative: float
    told: float
    status: wl.SolveStatus
    iterations: int
    seconds: float
    history: list[float] = field(default_factory=list)

    def record(self) -> Record:
        """Return what the file keeps."""
        figures = {"floor": Figure(self.relative), "told": Figure(self.told), "iterations": Figure(self.iterations)}
        facts = {"n": self.n, "bounds": self.bounds, "precision": self.precision, "status": self.status.name}
        return Record(f"{self.n}^3 {self.bounds} {self.precision}", figures | {"seconds": Figure(self.seconds, "s")}, facts)


def measure(options: Options, out: Path) -> Results:
    """Solve at every size that fits, in every precision."""
    free = free_memory("cpu")
    sizes = [n for n in sorted(options.sizes or SIZES) if free is None or BYTES * n**3 <= free]
    if not sizes:
        raise MemoryError(f"{min(options.sizes or SIZES)}^3 cells need about {BYTES} bytes each")
    floors = []
    for n in sizes:
        scene = splash(n)
        for bounds in BOUNDS:
            for precision in PRECISIONS:
                floors.append(reach(scene, bounds, precision, options.device))
                options.say(f"{n}^3, {bounds}, {precision}: {floors[-1].relative:.2e}, {floors[-1].status.name}")
    where = machine(options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat)
    return Results([where, *(f.record() for f in floors)], [_targets(floors), _table(floors)], _charts(floors), _failures(floors))


def reach(scene: Splash, bounds: str, precision: str, device: str) -> Floor:
    """Solve until no step makes the residual smaller."""
    begun = time.perf_counter()
    problem = scene.problem(bounds, device)
    result = wl.solve(problem, wl.ProjectedMultigrid(precision=precision), stopping=STOPPING)
    seconds = time.perf_counter() - begun
    reference = residual(scene, bounds, np.zeros(scene.b.shape))
    relative = residual(scene, bounds, result.x.numpy().astype(np.float64).reshape(scene.b.shape)) / reference
    history = [record.residual / reference for record in result.history if record.residual > 0.0]
    return Floor(
        scene.n, bounds, precision, relative, result.relative_residual, result.status, result.iterations, seconds, history
    )  # fmt: skip


def residual(scene: Splash, bounds: str, x: np.ndarray) -> float:
    """Return the norm of min(x - l, A x + b) over the FLUID cells, the 7-point Laplacian summed face by face.

    Args:
        scene: cells and b; coefficients of 1.
        bounds: of x.
        x: shape (n, n, n), float64; what it holds outside of FLUID cells does not matter.
    """
    return float(np.linalg.norm(natural(scene.cells, scene.b, scene.lower(bounds), x)))


def natural(cells: np.ndarray, b: np.ndarray, lower: float | np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return min(x - l, A x + b) on FLUID cells and 0 elsewhere, with coefficients of 1; b, x and l are of the shape of `cells`."""
    fluid, air = cells == wl.FLUID, cells == wl.AIR
    p, y = np.where(fluid, x, 0.0), b.copy()
    for axis in range(3):
        below, above = ([slice(None)] * 3 for _ in range(2))
        below[axis], above[axis] = slice(None, -1), slice(1, None)
        i, j = tuple(below), tuple(above)
        open_ = (fluid[i] & (fluid[j] | air[j])) | (fluid[j] & air[i])  # SOLID cells, and the box around all, let nothing through
        flux = np.where(open_, p[i] - p[j], 0.0)
        y[i] += flux
        y[j] -= flux
    return np.where(fluid, np.minimum(p - lower, y), 0.0)


def _of(floors: list[Floor], bounds: str, precision: str) -> list[Floor]:
    return [f for f in floors if (f.bounds, f.precision) == (bounds, precision)]


def _charts(floors: list[Floor]) -> list[Chart]:
    """Return the floors over the sizes, and how the residuals fell on the largest grid."""
    curves: dict[str, Any] = {}
    for bounds in BOUNDS:
        for precision in PRECISIONS:
            found = _of(floors, bounds, precision)
            curves[f"{precision}, {bounds}"] = [f.n for f in found], [f.relative for f in found]
    sizes = sorted({f.n for f in floors})
    curves[f"{ASKED:g}"] = sizes, [ASKED] * len(sizes)
    marked = frozenset(label for label in curves if label.startswith("double"))  # it would hide the others
    largest = {
        f"{f.precision}, {f.bounds}": (list(range(len(f.history))), f.history) for f in floors if f.n == max(sizes)
    }  # fmt: skip
    return [
        Lines("sizes", "Smallest relative residual", "cells a side", "residual / residual at 0", curves, marked=marked),
        Lines("history", f"Residuals at {max(sizes)}^3", "steps", "residual / residual at 0", largest, logarithmic_x=False, marked=marked),
    ]


def _targets(floors: list[Floor]) -> Table:
    rows = []
    for bounds in BOUNDS:
        worst = max(f.relative for f in _of(floors, bounds, "mixed"))
        rows.append(Target(f"mixed precision, {bounds}: largest floor of any grid", ASKED, Figure(worst)).row())
        least = min(f.relative for f in _of(floors, bounds, "single"))
        rows.append(Target(f"single precision, {bounds}: smallest floor of any grid", ASKED, Figure(least), at_least=True).row())
    return Table("Figures to reach", ["figure", "target", "measured", "met?"], rows)


def _table(floors: list[Floor]) -> Table:
    columns = ["cells", "problem", "precision", "floor", "as the solve tells it", "status", "steps", "s"]
    rows = [
        [f"{f.n}^3", f.bounds, f.precision, f"{f.relative:.2e}", f"{f.told:.2e}", f.status.name, str(f.iterations), f"{f.seconds:.2f}"]
        for f in floors
    ]  # fmt: skip
    remark = (
        "Solves that are asked for a residual of 0. The floor is the norm of min(x - l, A x + b) over that at x = 0, computed in float64 "
        "with NumPy from cells, b and the x that came back; single precision returns x in float32. Seconds include set-up."
    )
    return Table("Floors", columns, rows, remark)


def _failures(floors: list[Floor]) -> list[str]:
    """Return where mixed precision does not get there, or a solve tells another residual than x has."""
    lines = [
        f"{f.n}^3, {f.bounds}: mixed precision ends at {f.relative:.2e}" for f in floors if f.precision == "mixed" and f.relative > ASKED
    ]
    for f in floors:
        # at the floor x has few digits that count: rounding in two orders of summation differs by a share of the floor itself
        if not math.isclose(f.relative, f.told, rel_tol=0.5):
            lines.append(f"{f.n}^3, {f.bounds}, {f.precision}: the solve tells {f.told:.2e}, x has {f.relative:.2e}")
    return lines
