"""Methods published for the pressure LCP from 2011 to 2023 on the splash, side by side: iterations and seconds to the same residual.

Each runs as published as far as that is known (`docs/published-methods.md` says what was read and what is reconstructed), cold from p = 0,
and then with what this library adds. All share kernels, precision, multigrid cycles and stopping criteria, so that methods are compared
and not implementations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.cases import RTOL, Case
from warp_lcp.benchmarks.harness.machine import COPIED, machine
from warp_lcp.benchmarks.harness.record import Record, Results, Table, shown, spread
from warp_lcp.benchmarks.harness.timing import Options, ratios
from warp_lcp.benchmarks.problems import BOUNDS, splash

TITLE = "Published methods for the pressure LCP"
SIZES = (64, 128)
PATIENCE = 20.0  # [s] of one solve, after which a method is neither repeated nor asked at larger sizes
ENGINE = "multigrid, default"


class ProductsOnly(wl.Operator):
    """The matrix of a grid without its stencil: what a method knows that needs matrix-vector products only.

    Args:
        cells: types of the cells.
        device: where fields live.
        faces: coefficients of faces, as `wl.GridPoisson` takes them.
    """

    symmetric = True

    def __init__(self, cells: np.ndarray, *, device: Any, **faces: Any) -> None:
        self._grid = wl.GridPoisson(cells, device=device, **faces)
        self.shape, self.dtype, self.device = self._grid.shape, self._grid.dtype, self._grid.device
        self.cells, self.layout = self._grid.cells, self._grid.layout

    def apply(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return A x."""
        return self._grid.apply(x, out)

    def diagonal(self) -> wp.array[Any]:
        """Return the diagonal of A."""
        return self._grid.diagonal()


@dataclass(frozen=True)
class Entry:
    """A row of the tables."""

    source: str  # authors and year; "here" for what this library makes of the method
    label: str
    solver: Any
    operator: Callable[..., Any] = wl.GridPoisson


ENTRIES = (
    Entry("Chentanez and Mueller 2011", "projected multigrid cycles", wl.ProjectedMultigrid(monotone_cycles=10_000)),
    Entry(
        "Andersen et al. 2017",
        "minimum map, CG by products",
        wl.MinimumMapNewton(safeguard=False, max_linear_iterations=2000),
        ProductsOnly,
    ),
    Entry("Macklin et al. 2019", "Fischer-Burmeister, r = A_ii", wl.FischerNewton(monotone_cycles=0)),
    Entry("Lai et al. 2020", "policy iteration", wl.PrimalDualActiveSet(monotone_cycles=0)),
    Entry("Lai et al. 2020", "penalty", wl.Penalty(monotone_cycles=0)),
    Entry("Takahashi and Batty 2023", "MPRGP, multilevel", wl.MPRGP(monotone_cycles=0)),
    Entry("here", "minimum map, default", wl.MinimumMapNewton()),
    Entry("here", "Fischer-Burmeister, default", wl.FischerNewton()),
    Entry("here", "policy iteration, default", wl.PrimalDualActiveSet()),
    Entry("here", "penalty, default", wl.Penalty()),
    Entry("here", "MPRGP, default", wl.MPRGP()),
    Entry("here", ENGINE, wl.ProjectedMultigrid()),
)


def measure(options: Options, out: Path) -> Results:
    """Measure every method at every size, with bounds at walls and everywhere."""
    sizes = options.sizes or SIZES
    where = machine(options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat)
    records, tables, slow = list[Record](), list[Table](), set[tuple[str, str]]()
    for n in sizes:
        found = _measure_size(n, options, slow)
        records += found
        tables += [_table(n, bounds, [r for r in found if r.facts["bounds"] == bounds]) for bounds in BOUNDS[1:]]
    failures = [f"{r.name}: not converged" for r in records if not r.figures["converged"].value]
    return Results([where, *records], tables, [], failures)


def _measure_size(n: int, options: Options, slow: set[tuple[str, str]]) -> list[Record]:
    """Measure one sample of every method in each round; who is slow is noted and left out from then on."""
    scene = splash(n)
    linear = Case("unit", scene, BOUNDS[0], wl.ProjectedMultigrid(), options.device, full=False, label="linear solve")
    cases = [
        (entry, Case("unit", scene, bounds, entry.solver, options.device, full=False, label=entry.label, operator=entry.operator))
        for bounds in BOUNDS[1:]
        for entry in ENTRIES
        if (entry.label, bounds) not in slow
    ]
    for turn in range(options.repeat + 1):  # the first one loads kernels
        options.say(f"published methods at {n}^3, round {turn} of {options.repeat}")
        linear.cold(keep=turn > 0)
        for entry, case in cases:
            if (entry.label, case.bounds) not in slow or turn == 1:
                case.cold(keep=turn > 0)
                last = case.samples["total"][-1:]
                slow |= {(entry.label, case.bounds) for seconds in last if seconds > PATIENCE}
    return [_record(n, linear, "here"), *(_record(n, case, entry.source, linear) for entry, case in cases)]


def _record(n: int, case: Case, source: str, linear: Case | None = None) -> Record:
    """Return the figures of a case, with ratios to the linear solves of the same rounds."""
    figures = case.figures()
    if linear is not None:
        figures["over_linear"] = ratios(case.samples["total"], linear.samples["total"][: len(case.samples["total"])])
    return Record(case.name, figures, {"source": source, "bounds": case.bounds, "method": case.method, "n": n})


def _table(n: int, bounds: str, records: Sequence[Record]) -> Table:
    columns = ["published", "method", "iterations", "linear iterations", "relative residual", "total [ms]", "range", "x linear solve"]
    rows = []
    for r in records:
        counts = shown(r, ["iterations", "linear_iterations", "residual"])
        rows.append([r.facts["source"], r.facts["method"], *counts, *shown(r, ["total"], ".1f", 1e3), spread(r.figures["total"], 1e3)])
        rows[-1] += shown(r, ["over_linear"], ".2f")
    remark = f"Cold solves to {RTOL:g}, set-up included; x linear solve: the default multigrid without bounds, same rounds."
    return Table(f"p >= 0 {'at the walls' if bounds == 'walls' else bounds}, {n}^3", columns, rows, remark)
