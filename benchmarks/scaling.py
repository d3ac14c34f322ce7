"""What a solve costs as the grid grows: set-up, iterations, seconds to three tolerances, bytes a cell, and the exponent of the growth."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.cases import TOLERANCES, Case
from warp_lcp.benchmarks.machine import COPIED, machine
from warp_lcp.benchmarks.problems import BOUNDS, Splash, splash
from warp_lcp.benchmarks.record import Chart, Lines, Record, Results, Table
from warp_lcp.benchmarks.targets import Target
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.run.devices import free_memory

TITLE = "Cost of a solve against the size of the grid"
CPU_SIZES, CUDA_SIZES = (32, 64, 128, 256), (32, 64, 128, 256, 512, 1024)
SOLVE_BYTES = 60  # a cell: operator, problem, workspace, b, bounds, the result and what making them takes; 59 at 128^3
SCENE_BYTES = 60  # a cell, in the memory of the host: the scene, the fields that it is made with (41 at 128^3) and the bounds
ASYMPTOTIC = 64  # cells a side from which on the growth is fitted: below, launches cost more than cells
FIGURES = tuple(f"to_{t:.0e}" for t in TOLERANCES)
FIELD_BYTES = 8  # of copying a float32 field: a read and a write


@dataclass
class Growing:
    """One kind of bounds at one size.

    Args:
        scene: the problem.
        bounds: `linear`, `walls`, `everywhere`.
        device: Warp device.
    """

    scene: Splash
    bounds: str
    device: str
    samples: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    counts: dict[str, float] = field(default_factory=dict)

    @property
    def unknowns(self) -> int:
        """FLUID cells."""
        return int((self.scene.cells == wl.FLUID).sum())

    def sample(self, *, keep: bool) -> None:
        """Solve from the arrays of cells and b to the tightest tolerance; the history tells when the others were met.

        The method has no tolerance within, so that a solve that is asked for less takes the same steps.
        """
        lower, solver = self.scene.lower(self.bounds), wl.ProjectedMultigrid()
        begun = time.perf_counter()
        problem = wl.LCP(wl.GridPoisson(self.scene.cells, device=self.device), self.scene.b, lower)
        work: Any = solver.init(problem)
        wp.synchronize_device(self.device)
        setup = time.perf_counter() - begun
        result = wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=TOLERANCES[-1]), workspace=work)
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

    def record(self, copying: float) -> Record:
        """Return the figures; `copying` is the machine's copy bandwidth [GB/s]."""
        n = self.scene.n
        case = Case("unit", self.scene, self.bounds, wl.ProjectedMultigrid(), self.device)
        case.memory()
        figures = {name: Figure.of(taken, "s") for name, taken in self.samples.items() if taken}
        figures |= {name: Figure(value) for name, value in self.counts.items()}
        figures |= {"unknowns": Figure(self.unknowns), "bytes_per_cell": Figure(case.counts["bytes_per_cell"], "B")}
        taken = self.samples["to_1e-06"]
        if taken:
            figures["per_cell"] = Figure.of([1e9 * t / n**3 for t in taken], "ns")
            figures["in_copies"] = Figure.of([t * copying * 1e9 / (FIELD_BYTES * n**3) for t in taken])
        return Record(f"{n}^3 {self.bounds}", figures, {"n": n, "bounds": self.bounds})


def measure(options: Options, out: Path) -> Results:
    """Measure the sizes that fit, one sample of each in every round."""
    asked = sorted(options.sizes or (CUDA_SIZES if wp.get_device(options.device).is_cuda else CPU_SIZES))
    sizes, left_out = fitting(asked, options.device)
    if not sizes:
        raise MemoryError(f"no size fits: {next(iter(left_out.values()))}")
    where = machine(options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat)
    cases = [Growing(scene, bounds, options.device) for scene in map(splash, sizes) for bounds in BOUNDS]
    for turn in range(options.repeat + 1):  # the first one loads kernels
        options.say(f"scaling to {max(sizes)}^3, round {turn} of {options.repeat}")
        for case in cases:
            case.sample(keep=turn > 0)
    copying = where.value("copy") or 0.0
    records = [case.record(copying) for case in cases]
    growth = [_growth(bounds, [c for c in cases if c.bounds == bounds]) for bounds in BOUNDS]
    skipped = [Record(f"{n}^3", {}, {"left out": why}) for n, why in left_out.items()]
    tables = [_targets(growth), _growth_table(growth), _table(records), *([_left_out(left_out)] if left_out else [])]
    return Results([where, *records, *growth, *skipped], tables, _charts(records, growth))


def fitting(asked: Sequence[int], device: str) -> tuple[list[int], dict[int, str]]:
    """Return the sizes that fit into free memory, and why the others do not."""
    on_device, on_host = free_memory(device), free_memory("cpu")
    sizes, left_out = list[int](), dict[int, str]()
    for n in asked:
        solve, scene = SOLVE_BYTES * n**3, SCENE_BYTES * n**3
        needs = {device: (solve, on_device), "cpu": (scene, on_host)} if device != "cpu" else {"cpu": (solve + scene, on_host)}
        lacking = [(name, need, free) for name, (need, free) in needs.items() if free is not None and need > free]
        if not lacking:
            sizes.append(n)
            continue
        name, need, free = lacking[0]
        left_out[n] = f"{n}^3 needs about {need / 2**30:.1f} GiB on {name}, where {free / 2**30:.1f} GiB are free"
    return sizes, left_out


def exponent(unknowns: Sequence[float], seconds: Sequence[float]) -> float:
    """Return the exponent of unknowns that seconds grow with, by least squares of the logarithms."""
    return float(np.polyfit(np.log(unknowns), np.log(seconds), 1)[0])


def _growth(bounds: str, cases: Sequence[Growing]) -> Record:
    """Return the exponents of each round."""
    large = [c for c in cases if c.scene.n >= ASYMPTOTIC] if sum(c.scene.n >= ASYMPTOTIC for c in cases) > 1 else list(cases)
    figures = {}
    for name in ("setup", *FIGURES):
        rounds = list(zip(*(c.samples[name] for c in large), strict=False))
        if len(large) > 1 and rounds:
            figures[f"exponent_{name}"] = Figure.of([exponent([c.unknowns for c in large], taken) for taken in rounds])
    return Record(f"growth {bounds}", figures, {"bounds": bounds, "from": large[0].scene.n, "to": large[-1].scene.n})


def _targets(growth: Sequence[Record]) -> Table:
    rows = [
        Target(f"exponent of the seconds to 1e-6, {g.facts['bounds']}, {g.facts['from']}^3 to {g.facts['to']}^3", 1.05, figure).row()
        for g in growth
        for figure in [g.figures.get("exponent_to_1e-06") if g.facts["from"] >= ASYMPTOTIC else None]
    ]
    return Table("Figures to reach", ["figure", "target", "measured", "met?"], rows)


def _growth_table(growth: Sequence[Record]) -> Table:
    names = [f"exponent_{name}" for name in ("setup", *FIGURES)]
    rows = [[g.facts["bounds"], *("" if (f := g.figures.get(name)) is None else str(f) for name in names)] for g in growth]
    remark = "Exponents of the number of unknowns, fitted in each round; seconds include the set-up."
    return Table("Growth", ["problem", "set-up", *(f"to {t:g}" for t in TOLERANCES)], rows, remark)


def _table(records: Sequence[Record]) -> Table:
    columns = ["cells", "problem", "unknowns", "set-up [ms]", *(f"to {t:g} [ms]" for t in TOLERANCES), "range of 1e-6", "iterations"]
    columns += ["ns a cell", "in copies of a field", "bytes a cell"]
    rows = []
    for r in records:
        times = ["" if (v := r.value(name)) is None else f"{1e3 * v:.1f}" for name in ("setup", *FIGURES)]
        middle = r.figures.get("to_1e-06", Figure(0.0))
        spread = f"{1e3 * (middle.low or 0):.1f} to {1e3 * (middle.high or 0):.1f}"
        counts = " / ".join("" if (v := r.value(f"iterations_{name}")) is None else f"{v:.0f}" for name in FIGURES)
        rest = ["" if (v := r.value(name)) is None else f"{v:.1f}" for name in ("per_cell", "in_copies", "bytes_per_cell")]
        rows.append([f"{r.facts['n']}^3", r.facts["bounds"], f"{r.value('unknowns'):.0f}", *times, spread, counts, *rest])
    remark = (
        "Seconds from the arrays of cells and b to each tolerance, cold, set-up included. In copies of a field: the seconds to 1e-6 over "
        "those that this machine takes to copy one float32 field of the grid. Bytes: of operator, problem and workspace, b and the bounds "
        "included."
    )
    return Table("Sizes", columns, rows, remark)


def _left_out(left_out: dict[int, str]) -> Table:
    return Table("Sizes that were not measured", ["cells", "why"], [[f"{n}^3", why] for n, why in left_out.items()])


def _charts(records: Sequence[Record], growth: Sequence[Record]) -> list[Chart]:
    """Return the seconds to 1e-6 over the unknowns, and those a cell."""
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for g in growth:
        here = [r for r in records if r.facts["bounds"] == g.facts["bounds"] and "to_1e-06" in r.figures]
        fitted = g.value("exponent_to_1e-06")
        label = g.facts["bounds"] + ("" if fitted is None else f", exponent {fitted:.2f}")
        curves[label] = [r.value("unknowns") or 0.0 for r in here], [r.value("to_1e-06") or 0.0 for r in here]
    per_cell: dict[str, tuple[list[float], list[float]]] = {}
    for bounds in BOUNDS:
        here = [r for r in records if r.facts["bounds"] == bounds and "per_cell" in r.figures]
        per_cell[bounds] = [r.facts["n"] for r in here], [r.value("per_cell") or 0.0 for r in here]
    title = "Cold solves to 1e-6, set-up included"
    return [Lines("seconds", title, "unknowns", "s", curves), Lines("per-cell", title, "cells a side", "ns a cell", per_cell)]
