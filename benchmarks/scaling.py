"""Cost of a solve against grid size, with its growth exponent.

The figures are set-up, iterations, seconds to three tolerances, and bytes per cell. A second part
measures the attainable accuracy: solves in each precision with a tolerance of 0 end at their floor.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.cases import TOLERANCES, SolverCase
from warp_lcp.benchmarks.harness.machine import COPIED, machine
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    Chart,
    RecordLines,
    RecordTable,
    RecordTarget,
    Results,
    shown,
    spread,
    table_of_targets,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.benchmarks.problems import BOUNDS, Splash, natural, splash
from warp_lcp.run.devices import free_memory

TITLE = "Cost of a solve against the size of the grid"
CPU_SIZES, CUDA_SIZES = (32, 64, 128, 256), (32, 64, 128, 256, 512, 1024)
# Bytes of a cell: operator, problem, workspace, b, bounds, result and temporaries; 59 at 128^3.
SOLVE_BYTES = 60
# Bytes of a cell in host memory: the scene, the fields that it is made from (41 at 128^3), the
# bounds.
SCENE_BYTES = 60
# Cells along a side from which on the growth is fitted: below, launches cost more than cells.
ASYMPTOTIC = 64
FIGURES = tuple(f"to_{t:.0e}" for t in TOLERANCES)
PRECISIONS = ("single", "mixed", "double")
REACHED = 1e-8  # relative residual that mixed precision must reach on every grid
ENDLESS = wl.StoppingCriteria(rtol=0.0, max_iterations=60, patience=6)
FIELD_BYTES = 8  # bytes per cell of a copy of a float32 field: a read and a write


@dataclass
class ScalingCase:
    """One kind of bounds at one size."""

    scene: Splash  # the problem
    bounds: str  # `linear`, `walls`, `everywhere`
    device: str  # Warp device
    samples: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    counts: dict[str, float] = field(default_factory=dict)

    @property
    def unknowns(self) -> int:
        """Number of FLUID cells."""
        return int((self.scene.cells == wl.FLUID).sum())

    def sample(self, *, keep: bool) -> None:
        """Solve from the arrays of cells and b to the tightest tolerance.

        The history shows when the looser tolerances were met. The method has no inner tolerance, so
        that a solve with a looser one takes the same steps.
        """
        lower, solver = self.scene.lower(self.bounds), wl.ProjectedMultigrid()
        begun = time.perf_counter()
        problem = wl.LCP(wl.GridPoisson(self.scene.cells, device=self.device), self.scene.b, lower)
        work = solver.init(problem)
        wp.synchronize_device(self.device)
        setup = time.perf_counter() - begun
        result = wl.solve(
            problem, solver, stopping=wl.StoppingCriteria(rtol=TOLERANCES[-1]), workspace=work
        )
        reference = result.residual / result.relative_residual if result.relative_residual else 1.0
        self.counts |= {"residual": result.relative_residual, "converged": float(bool(result))}
        if keep:
            self.samples["setup"].append(setup)
        for name, tolerance in zip(FIGURES, TOLERANCES, strict=True):
            met = next((r for r in result.history if r.residual <= tolerance * reference), None)
            if met is not None:
                self.counts[f"iterations_{name}"] = met.iteration
                if keep:
                    self.samples[name].append(setup + met.seconds)

    def record(self, copying: float) -> BenchmarkRecord:
        """Return the figures; `copying` is the machine's copy bandwidth [GB/s]."""
        n = self.scene.n
        case = SolverCase("unit", self.scene, self.bounds, wl.ProjectedMultigrid(), self.device)
        case.memory()
        figures = {
            name: Figure.of(samples, "s") for name, samples in self.samples.items() if samples
        }
        figures |= {name: Figure(value) for name, value in self.counts.items()}
        figures |= {
            "unknowns": Figure(self.unknowns),
            "bytes_per_cell": Figure(case.counts["bytes_per_cell"], "B"),
        }
        samples = self.samples["to_1e-06"]
        if samples:
            figures["per_cell"] = Figure.of([1e9 * t / n**3 for t in samples], "ns")
            figures["in_copies"] = Figure.of(
                [t * copying * 1e9 / (FIELD_BYTES * n**3) for t in samples]
            )
        return BenchmarkRecord(f"{n}^3 {self.bounds}", figures, {"n": n, "bounds": self.bounds})


def measure(options: Options, out: Path) -> Results:
    """Measure the sizes that fit, one sample of each in every round."""
    asked = sorted(
        options.sizes or (CUDA_SIZES if wp.get_device(options.device).is_cuda else CPU_SIZES)
    )
    sizes, left_out = fitting(asked, options.device)
    if not sizes:
        raise MemoryError(f"no size fits: {next(iter(left_out.values()))}")
    where = machine(
        options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat
    )
    cases = [
        ScalingCase(scene, bounds, options.device)
        for scene in map(splash, sizes)
        for bounds in BOUNDS
    ]
    for turn in range(options.repeat + 1):  # the first turn loads kernels
        options.say(f"scaling to {max(sizes)}^3, round {turn} of {options.repeat}")
        for case in cases:
            case.sample(keep=turn > 0)
    copying = where.value("copy") or 0.0
    records = [case.record(copying) for case in cases]
    growth = [_growth(bounds, [c for c in cases if c.bounds == bounds]) for bounds in BOUNDS]
    floors = [
        floor(scene, bounds, p, options.device)
        for scene in map(splash, sizes)
        for bounds in BOUNDS[:2]
        for p in PRECISIONS
    ]
    skipped = [BenchmarkRecord(f"{n}^3", {}, {"left out": why}) for n, why in left_out.items()]
    tables = [
        _targets(growth, floors),
        _growth_table(growth),
        _table(records),
        _floor_table(floors),
    ]
    if left_out:
        rows = [[f"{n}^3", why] for n, why in left_out.items()]
        tables.append(RecordTable("Sizes that were not measured", ["cells", "why"], rows))
    return Results(
        [where, *records, *growth, *floors, *skipped],
        tables,
        _charts(records, growth, floors),
        _failures(floors),
    )


def floor(scene: Splash, bounds: str, precision: str, device: str) -> BenchmarkRecord:
    """Solve until no step reduces the residual further.

    Return that residual over the residual at 0, recomputed and as the solve reports it.
    """
    result = wl.solve(
        scene.lcp(bounds, device=device),
        wl.ProjectedMultigrid(precision=precision),
        stopping=ENDLESS,
    )
    x = result.x.numpy().astype(np.float64).reshape(scene.b.shape)
    norms = [
        float(np.linalg.norm(natural(scene.cells, scene.b, scene.lower(bounds), p)))
        for p in (x, np.zeros_like(x))
    ]
    figures = {
        "floor": Figure(norms[0] / norms[1]),
        "told": Figure(result.relative_residual),
        "iterations": Figure(result.iterations),
    }
    facts = {
        "n": scene.n,
        "floor of": f"{precision}, {bounds}",
        "precision": precision,
        "status": result.status.name,
    }
    return BenchmarkRecord(f"floor {scene.n}^3 {bounds} {precision}", figures, facts)


def fitting(requested: Sequence[int], device: str) -> tuple[list[int], dict[int, str]]:
    """Return the sizes that fit into free memory, and why the others do not."""
    on_device, on_host = free_memory(device), free_memory("cpu")
    sizes, left_out = list[int](), dict[int, str]()
    for n in requested:
        solve, scene = SOLVE_BYTES * n**3, SCENE_BYTES * n**3
        needs = (
            {device: (solve, on_device), "cpu": (scene, on_host)}
            if device != "cpu"
            else {"cpu": (solve + scene, on_host)}
        )
        lacking = [
            (name, need, free)
            for name, (need, free) in needs.items()
            if free is not None and need > free
        ]
        if not lacking:
            sizes.append(n)
            continue
        name, need, free = lacking[0]
        left_out[n] = (
            f"{n}^3 needs about {need / 2**30:.1f} GiB on {name}, where {free / 2**30:.1f} GiB are "
            "free"
        )
    return sizes, left_out


def exponent(unknowns: Sequence[float], seconds: Sequence[float]) -> float:
    """Return the growth exponent of seconds over unknowns.

    The fit is by least squares of the logarithms.
    """
    return float(np.polyfit(np.log(unknowns), np.log(seconds), 1)[0])


def _growth(bounds: str, cases: Sequence[ScalingCase]) -> BenchmarkRecord:
    """Return the growth exponents of each round."""
    large = (
        [c for c in cases if c.scene.n >= ASYMPTOTIC]
        if sum(c.scene.n >= ASYMPTOTIC for c in cases) > 1
        else list(cases)
    )
    figures = {}
    for name in ("setup", *FIGURES):
        rounds = list(zip(*(c.samples[name] for c in large), strict=False))
        if len(large) > 1 and rounds:
            figures[f"exponent_{name}"] = Figure.of(
                [exponent([c.unknowns for c in large], taken) for taken in rounds]
            )
    return BenchmarkRecord(
        f"growth {bounds}",
        figures,
        {"bounds": bounds, "from": large[0].scene.n, "to": large[-1].scene.n},
    )


def _targets(growth: Sequence[BenchmarkRecord], floors: Sequence[BenchmarkRecord]) -> RecordTable:
    targets = []
    for g in growth:
        figure = g.figures.get("exponent_to_1e-06") if g.facts["from"] >= ASYMPTOTIC else None
        what = (
            f"exponent of the seconds to 1e-6, {g.facts['bounds']}, {g.facts['from']}^3 to "
            f"{g.facts['to']}^3"
        )
        targets.append(RecordTarget(what, 1.05, figure))
    worst = max(r.figures["floor"].value for r in floors if r.facts["precision"] == "mixed")
    return table_of_targets(
        "figure",
        [
            *targets,
            RecordTarget("mixed precision: largest floor of any grid", REACHED, Figure(worst)),
        ],
    )


def _growth_table(growth: Sequence[BenchmarkRecord]) -> RecordTable:
    names = [f"exponent_{name}" for name in ("setup", *FIGURES)]
    rows = [
        [
            g.facts["bounds"],
            *("" if (f := g.figures.get(name)) is None else str(f) for name in names),
        ]
        for g in growth
    ]
    remark = (
        "Exponents of the number of unknowns, fitted in each round; seconds include the set-up."
    )
    return RecordTable(
        "Growth", ["problem", "set-up", *(f"to {t:g}" for t in TOLERANCES)], rows, remark
    )


def _table(records: Sequence[BenchmarkRecord]) -> RecordTable:
    columns = [
        "cells",
        "problem",
        "unknowns",
        "set-up [ms]",
        *(f"to {t:g} [ms]" for t in TOLERANCES),
        "range of 1e-6",
        "iterations",
    ]
    columns += ["ns a cell", "in copies of a field", "bytes a cell"]
    rows = []
    for r in records:
        row = [
            f"{r.facts['n']}^3",
            r.facts["bounds"],
            *shown(r, ["unknowns"], ".0f"),
            *shown(r, ("setup", *FIGURES), ".1f", 1e3),
        ]
        row += [
            spread(r.figures.get("to_1e-06", Figure(0.0)), 1e3),
            " / ".join(shown(r, [f"iterations_{name}" for name in FIGURES], ".0f")),
        ]
        rows.append([*row, *shown(r, ("per_cell", "in_copies", "bytes_per_cell"), ".1f")])
    remark = (
        "Seconds from the arrays of cells and b to each tolerance, cold, set-up included. In "
        "copies of a field: the seconds to 1e-6 over "
        "those that this machine takes to copy one float32 field of the grid. Bytes: of operator, "
        "problem and workspace, b and the bounds "
        "included."
    )
    return RecordTable("Sizes", columns, rows, remark)


def _floor_table(floors: Sequence[BenchmarkRecord]) -> RecordTable:
    columns = ["cells", "precision, problem", "floor", "as the solve tells it", "steps", "status"]
    rows = [
        [
            f"{r.facts['n']}^3",
            r.facts["floor of"],
            *shown(r, ("floor", "told"), ".2e"),
            *shown(r, ["iterations"]),
            r.facts["status"],
        ]
        for r in floors
    ]
    remark = (
        "Solves that are asked for a residual of 0. The floor is the norm of min(x - l, A x + b) "
        "over that at x = 0, computed in float64 "
        "with NumPy from cells, b and the x that came back; single precision returns x in float32."
    )
    return RecordTable("Floors", columns, rows, remark)


def _failures(floors: Sequence[BenchmarkRecord]) -> list[str]:
    """Return failures of mixed precision, and solves with a wrong reported residual."""
    lines = []
    for r in floors:
        own_floor, reported = r.figures["floor"].value, r.figures["told"].value
        if r.facts["precision"] == "mixed" and own_floor > REACHED:
            lines.append(f"{r.name}: ends at {own_floor:.2e}")
        # At the floor x has few significant digits: rounding errors of two orders of summation
        # differ by a share of the floor itself.
        if not math.isclose(own_floor, reported, rel_tol=0.5):
            lines.append(f"{r.name}: the solve tells {reported:.2e}, x has {own_floor:.2e}")
    return lines


def _charts(
    records: Sequence[BenchmarkRecord],
    growth: Sequence[BenchmarkRecord],
    floors: Sequence[BenchmarkRecord],
) -> list[Chart]:
    """Return the charts of seconds to 1e-6 over the unknowns, and of the floors."""
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for g in growth:
        own_records = [
            r for r in records if r.facts["bounds"] == g.facts["bounds"] and "to_1e-06" in r.figures
        ]
        fitted = g.value("exponent_to_1e-06")
        label = g.facts["bounds"] + ("" if fitted is None else f", exponent {fitted:.2f}")
        curves[label] = (
            [r.value("unknowns") or 0.0 for r in own_records],
            [r.value("to_1e-06") or 0.0 for r in own_records],
        )
    ends: dict[str, tuple[list[float], list[float]]] = {}
    for r in floors:
        x, y = ends.setdefault(r.facts["floor of"], ([], []))
        x.append(r.facts["n"])
        y.append(r.figures["floor"].value)
    # It would hide the other curves.
    double = frozenset(label for label in ends if label.startswith("double"))
    return [
        RecordLines("seconds", "Cold solves to 1e-6, set-up included", "unknowns", "s", curves),
        RecordLines(
            "floors",
            "Smallest relative residual",
            "cells a side",
            "residual / residual at 0",
            ends,
            marked=double,
        ),
    ]
