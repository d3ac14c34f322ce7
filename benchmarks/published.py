"""Published methods for the pressure LCP on the splash: iterations and seconds.

The methods are of 2011 to 2023 and solve to the same residual. Each runs as published, as far as
that is known: `docs/published-methods.md` says what was read and what is reconstructed. Each starts
cold from p = 0, and then runs again with the additions of this library. All share kernels,
precision, multigrid cycles and stopping criteria, so that methods are compared and not
implementations. `docs/generate/published_figures.py` puts the figures into that page.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.cases import RTOL, SolverCase
from warp_lcp.benchmarks.harness.machine import COPIED, machine
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordTable, Results, shown, spread
from warp_lcp.benchmarks.harness.timing import Options, ratios
from warp_lcp.benchmarks.problems import BOUNDS, Splash, plane, splash
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.grid_poisson import PoissonArguments
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.operator_protocol import HasStencil, has
from warp_lcp.subproblems.multigrid_workspace import MultigridWorkspace

TITLE = "Published methods for the pressure LCP"
SIZES = (64, 128)
FLAT = 4  # cells along a side in 2-D, in units of those in 3-D
REPEATED = 3.0  # [s] of one solve, above which only one sample is taken
PATIENCE = 20.0  # [s] of one solve, above which a method is not run at larger sizes
ENGINE = "multigrid, default"
# Figures of a case that are recorded.
FIGURES = ("total", "iterations", "linear_iterations", "residual", "converged")


class ProductsOnly(wl.Operator):
    """Matrix of a grid without its stencil.

    Methods that need matrix-vector products only see no more of it.

    Args:
        cells: types of the cells.
        device: where fields live.
        faces: coefficients of faces, as `wl.GridPoisson` takes them.
    """

    symmetric = True

    def __init__(
        self, cells: np.ndarray, *, device: wp.DeviceLike, **faces: Unpack[PoissonArguments]
    ) -> None:
        self._grid = wl.GridPoisson(cells, device=device, **faces)
        self.shape, self.dtype, self.device = self._grid.shape, self._grid.dtype, self._grid.device
        self.cells, self.layout = self._grid.cells, self._grid.layout

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x."""
        return self._grid.apply(x, out)

    def diagonal(self) -> DeviceArray:
        """Return the diagonal of A."""
        return self._grid.diagonal()


@dataclass(frozen=True, kw_only=True)
class TruncatedMultigrid(wl.ProjectedMultigrid):
    """Multigrid iterations whose coarse levels leave out the active set.

    The method has neither conjugate directions nor projected cycles. From x, unknowns at a bound
    with y = A x + b of the right sign are active. A linear cycle on the other unknowns gives a
    correction z; its Galerkin coarse levels and its interpolation leave the active ones out. Then x
    + t z is projected onto the bounds, where t minimizes the energy along z.
    """

    def init(self, problem: wl.LCP) -> TruncatedWorkspace:
        """Return a workspace."""
        assert has(problem.A, HasStencil)
        return TruncatedWorkspace(problem, problem.A, self, ahead=False)


class TruncatedWorkspace(MultigridWorkspace):
    """Workspace of the method for one problem."""

    def wants_monotone_cycle(self) -> bool:
        """Return False, and reset the direction.

        The next direction is then the cycle's correction.
        """
        self.forget_direction()
        return False

    def _needs_cycle(self) -> bool:
        self.judge()
        return False


@dataclass(frozen=True)
class PublishedEntry:
    """Row of the tables."""

    source: str  # authors and year; "here" for variants of this library
    label: str
    solver: Solver
    operator: Callable[..., wl.Operator] = wl.GridPoisson


ENTRIES = (
    PublishedEntry(
        "Chentanez and Mueller 2011",
        "projected multigrid cycles",
        wl.ProjectedMultigrid(monotone_cycles=10_000),
    ),
    PublishedEntry(
        "Andersen et al. 2017",
        "minimum map, CG by products",
        wl.MinimumMapNewton(safeguard=False, max_linear_iterations=2000),
        ProductsOnly,
    ),
    PublishedEntry(
        "Macklin et al. 2019", "Fischer-Burmeister, r = A_ii", wl.FischerNewton(monotone_cycles=0)
    ),
    PublishedEntry(
        "Lai et al. 2020", "policy iteration", wl.PrimalDualActiveSet(monotone_cycles=0)
    ),
    PublishedEntry("Lai et al. 2020", "penalty", wl.Penalty(monotone_cycles=0)),
    PublishedEntry(
        "Lai et al. 2020",
        "multigrid, active set off coarse levels",
        TruncatedMultigrid(monotone_cycles=0),
    ),
    PublishedEntry("Takahashi and Batty 2023", "MPRGP, multilevel", wl.MPRGP(monotone_cycles=0)),
    PublishedEntry("here", "minimum map, default", wl.MinimumMapNewton()),
    PublishedEntry("here", "Fischer-Burmeister, default", wl.FischerNewton()),
    PublishedEntry("here", "policy iteration, default", wl.PrimalDualActiveSet()),
    PublishedEntry("here", "penalty, default", wl.Penalty()),
    PublishedEntry("here", "MPRGP, default", wl.MPRGP()),
    PublishedEntry("here", ENGINE, wl.ProjectedMultigrid()),
)


def measure(options: Options, out: Path) -> Results:
    """Measure every method at every size in 3-D and 2-D.

    The bounds are at walls and everywhere.
    """
    sizes = options.sizes or SIZES
    where = machine(
        options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat
    )
    records, tables = list[BenchmarkRecord](), list[RecordTable]()
    for make, scale in ((splash, 1), (plane, FLAT)):
        slow = set[tuple[str, str]]()
        for n in sizes:
            found = _measure_scene(make(scale * n), options, slow, load=n == sizes[0])
            records += found
            for bounds in BOUNDS[1:]:
                own = [r for r in found if r.facts["bounds"] == bounds]
                tables += [_table(own, bounds)] if own else []
    failures = [f"{r.name}: not converged" for r in records if not r.figures["converged"].value]
    return Results([where, *records], tables, [], failures)


def _measure_scene(
    scene: Splash, options: Options, slow: set[tuple[str, str]], *, load: bool
) -> list[BenchmarkRecord]:
    """Measure one sample of every method in each round.

    Args:
        scene: the scene to solve.
        options: device and number of rounds.
        slow: pairs of method and bounds that are left out; those above PATIENCE are added.
        load: whether a first round without samples loads the kernels.
    """
    linear = SolverCase(
        "unit",
        scene,
        BOUNDS[0],
        wl.ProjectedMultigrid(),
        options.device,
        full=False,
        label="linear solve",
    )
    cases = [
        (
            entry,
            SolverCase(
                "unit",
                scene,
                bounds,
                entry.solver,
                options.device,
                full=False,
                label=entry.label,
                operator=entry.operator,
            ),
        )
        for bounds in BOUNDS[1:]
        for entry in ENTRIES
        if (entry.label, bounds) not in slow
    ]
    for turn in range(0 if load else 1, options.repeat + 1):
        options.say(f"published methods, {linear.size}, round {turn} of {options.repeat}")
        linear.cold(keep=turn > 0)
        for _, case in cases:
            if all(seconds <= REPEATED for seconds in case.samples["total"]):
                case.cold(keep=turn > 0)
    slow |= {(c.label, c.bounds) for _, c in cases if max(c.samples["total"]) > PATIENCE}
    return [
        _record(linear, "here"),
        *(_record(case, entry.source, linear) for entry, case in cases),
    ]


def _record(case: SolverCase, source: str, linear: SolverCase | None = None) -> BenchmarkRecord:
    """Return the figures of a case.

    They include ratios to the linear solves of the same rounds.
    """
    figures = {name: figure for name, figure in case.figures().items() if name in FIGURES}
    if linear is not None:
        of_linear = linear.samples["total"][: len(case.samples["total"])]
        figures["over_linear"] = ratios(case.samples["total"], of_linear)
    facts = {"source": source, "bounds": case.bounds, "method": case.method, "size": case.size}
    return BenchmarkRecord(case.name, figures, facts)


def _table(records: Sequence[BenchmarkRecord], bounds: str) -> RecordTable:
    columns = [
        "published",
        "method",
        "iterations",
        "linear iterations",
        "relative residual",
        "total [ms]",
        "range",
        "x linear solve",
    ]
    rows = []
    for r in records:
        counts = shown(r, ["iterations", "linear_iterations"], ".0f") + shown(r, ["residual"])
        rows.append(
            [
                r.facts["source"],
                r.facts["method"],
                *counts,
                *shown(r, ["total"], ".1f", 1e3),
                spread(r.figures["total"], 1e3),
            ]
        )
        rows[-1] += shown(r, ["over_linear"], ".2f")
    remark = (
        f"Cold solves to {RTOL:g}, set-up included; x linear solve: the default multigrid "
        "without bounds, same rounds."
    )
    where = "at the walls" if bounds == "walls" else bounds
    return RecordTable(f"p >= 0 {where}, {records[0].facts['size']}", columns, rows, remark)
