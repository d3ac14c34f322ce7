"""Linear and LCP solves of the splash: set-up, iterations, seconds, memory; against PyAMG and SciPy in the same process, in turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks.cases import RTOL, Case
from warp_lcp.benchmarks.host import host_overhead
from warp_lcp.benchmarks.machine import COPIED, machine, present
from warp_lcp.benchmarks.peers.linear import pyamg_aggregation, scipy_cg
from warp_lcp.benchmarks.peers.peer import Answer, Question
from warp_lcp.benchmarks.problems import BOUNDS, anisotropic, cut_cells, splash
from warp_lcp.benchmarks.record import Bars, Lines, Record, Results, Table
from warp_lcp.benchmarks.targets import targets
from warp_lcp.benchmarks.timing import Figure, Options, ratios

TITLE = "Linear and LCP pressure solves"
SIZES = (64, 128)
PEER_SECONDS = 60.0  # [s] after which a peer is not asked again: at 256^3 PyAMG needs that for one solve
LARGE = 192  # cells a side beyond which only the engine on unit coefficients is measured: the rest takes minutes a round
SCIPY_CELLS = 64  # cells a side up to which plain CG is waited for
ENGINE = "ProjectedMultigrid"
OTHERS = {
    "MPRGP": wl.MPRGP(),
    "FischerNewton": wl.FischerNewton(),
    "InteriorPoint": wl.InteriorPoint(),
    "InteriorPoint, crossover": wl.InteriorPoint(crossover=1e-2),
}


@dataclass(frozen=True)
class PeerSolve:
    """One solve of a peer: seconds of set-up and solve [s], iterations, and the relative residual, recomputed."""

    setup: float
    solve: float
    iterations: int
    residual: float

    @property
    def total(self) -> float:
        """Set-up and solve [s]."""
        return self.setup + self.solve


def measure(options: Options, out: Path) -> Results:
    """Measure all cases at the sizes asked for."""
    sizes = options.sizes or SIZES
    records = [machine(options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat)]
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for n in sizes:
        cases, peers = _measure_size(n, options)
        records += _records(n, cases, peers)
        if n == max(sizes):
            curves |= _curves(cases)
    records.append(host_overhead(min(64, max(sizes)), options.device, options.repeat))
    charts: list[Bars | Lines] = [
        Bars("cold", "Cold solves to 1e-6, set-up included", "s", _cold(records, max(sizes)), logarithmic=True),
        Lines("convergence", f"Cold solves at {max(sizes)}^3", "s", "relative residual", curves, logarithmic_x=False),
    ]
    return Results(records, [targets(records, out), *_tables(sizes, records)], charts)


def _measure_size(n: int, options: Options) -> tuple[list[Case], dict[str, list[PeerSolve]]]:
    """Measure one sample of every case and peer in each round."""
    cases = _cases(n, options.device)
    question = Question(splash(n), "linear")
    solves: dict[str, Callable[[Question, float], Answer]] = {}
    if present("pyamg"):
        solves["PyAMG SA-CG"] = pyamg_aggregation
    if n <= SCIPY_CELLS:
        solves["SciPy CG"] = scipy_cg
    peers: dict[str, list[PeerSolve]] = {name: [] for name in solves}
    for turn in range(options.repeat + 1):  # the first one loads kernels
        options.say(f"solvers at {n}^3, round {turn} of {options.repeat}")
        for case in cases:
            case.cold(keep=turn > 0)
            if case.full:
                case.again(keep=turn > 0)
            elif case.reused:
                case.cold_again(keep=turn > 0)
        if turn > 0:
            for name, solve in solves.items():
                if sum(p.total for p in peers[name]) < PEER_SECONDS:
                    answer = solve(question, RTOL)
                    peers[name].append(PeerSolve(answer.setup, answer.solve, answer.iterations, question.residual(answer.x)))
    for case in cases:
        if case.full:
            case.to_tolerances()
        case.memory()
    return cases, peers


def _cases(n: int, device: str) -> list[Case]:
    """Return the cases of a size: the engine and other methods on unit coefficients, the engine on what is harder."""
    scene = splash(n)
    if n > LARGE:
        return [Case("unit", scene, bounds, wl.ProjectedMultigrid(), device) for bounds in BOUNDS]
    flat = anisotropic(scene)
    arrays = {f"face_{a}": np.full([n + (i == j) for j in range(3)], flat.faces.get(f"face_{a}", 1.0)) for i, a in enumerate("zyx")}
    both = [wl.ProjectedMultigrid(), wl.MinimumMapNewton()]
    cases = [Case("unit", scene, bounds, solver, device) for bounds in BOUNDS for solver in both]
    cases += [
        Case("unit", scene, bounds, solver, device, full=False, label=label, reused=True)
        for label, solver in OTHERS.items()
        for bounds in BOUNDS[1:]
    ]
    cases += [Case("faces", cut_cells(scene), bounds, both[0], device) for bounds in BOUNDS]
    harder = {"cells 1:100": flat, "arrays 1:100": type(scene)(n, scene.cells, scene.b, scene.wall, arrays)}
    return cases + [Case(form, s, bounds, both[0], device, full=False) for form, s in harder.items() for bounds in BOUNDS[:2]]


def _records(n: int, cases: list[Case], peers: dict[str, list[PeerSolve]]) -> list[Record]:
    """Return the records of a size, with ratios of samples that were taken in the same round."""
    by_name = {case.name: case for case in cases}
    pyamg = [p.total for p in peers.get("PyAMG SA-CG", [])]
    records = []
    for case in cases:
        figures, method = case.figures(), case.method
        linear = by_name.get(f"{n}^3 {case.form} linear {method}", case)
        unit = by_name.get(f"{n}^3 unit {case.bounds} {method}", case)
        for label, other in (("over_linear", linear), ("over_unit", unit)):
            if other is not case:
                figures[label] = ratios(case.samples["total"], other.samples["total"])
        engine = by_name.get(f"{n}^3 {case.form} linear {ENGINE}", case)
        if case.bounds != "linear" and case.samples["reuse"] and engine is not case:
            figures["reuse_over_engine"] = ratios(case.samples["reuse"], engine.samples["reuse"])
        if linear is not case and case.samples["warm"]:
            figures["warm_over_linear"] = ratios(case.samples["warm"], linear.samples["warm"])
            figures["reuse_over_linear"] = ratios(case.samples["reuse"], linear.samples["reuse"])
        if unit is not case:
            figures["iterations_over_unit"] = Figure(case.counts["iterations"] / unit.counts["iterations"])
        if pyamg and case.form == "unit":
            figures["pyamg_over_this"] = ratios(pyamg, case.samples["total"][: len(pyamg)])
        records.append(Record(case.name, figures, {"form": case.form, "bounds": case.bounds, "method": method, "n": n}))
    for name, solves in peers.items():
        figures = {"setup": Figure.of([p.setup for p in solves], "s"), "solve": Figure.of([p.solve for p in solves], "s")}
        figures |= {"total": Figure.of([p.total for p in solves], "s"), "iterations": Figure(solves[-1].iterations)}
        figures |= {"residual": Figure(solves[-1].residual)}
        records.append(Record(f"{n}^3 unit linear {name}", figures, {"form": "unit", "bounds": "linear", "method": name, "n": n}))
    return records


def _cold(records: Sequence[Record], n: int) -> dict[str, float]:
    shown = [r for r in records if r.facts.get("n") == n and not r.facts["form"].endswith("1:100")]
    return {r.name.partition(" ")[2]: v for r in shown if (v := r.value("total"))}


def _curves(cases: list[Case]) -> dict[str, tuple[list[float], list[float]]]:
    """Return relative residual over seconds of the histories."""
    curves = {}
    for case in cases:
        if case.history and case.form == "unit":
            first = case.history[0].residual
            points = [(r.seconds, r.residual / first) for r in case.history if r.residual > 0]
            curves[f"{case.bounds}, {case.method}"] = ([t for t, _ in points], [r for _, r in points])
    return curves


def _tables(sizes: Sequence[int], records: Sequence[Record]) -> list[Table]:
    tables = []
    for n in sizes:
        here = [r for r in records if r.facts.get("n") == n]
        tables += [_times(n, here), _quality(n, here)]
    return tables


def _times(n: int, records: list[Record]) -> Table:
    """Seconds, as medians with the range of the cold total."""
    parts = ("setup", "solve", "total", "reuse", "warm", "to_1e-04", "to_1e-06", "to_1e-08")
    columns = ["case", *(f"{p.replace('_', ' ')} [ms]" for p in parts), "range of total", "x faster than PyAMG"]
    rows = []
    for r in records:
        total, ratio = r.figures["total"], r.figures.get("pyamg_over_this")
        cells = ["" if (v := r.value(p)) is None else f"{1e3 * v:.1f}" for p in parts]
        spread = f"{1e3 * (total.low or 0):.1f} to {1e3 * (total.high or 0):.1f}"
        rows.append([r.name.partition(" ")[2], *cells, spread, "" if ratio is None else f"{ratio.value:.1f}"])
    remark = (
        "setup: GridPoisson, LCP and init from host arrays; solve: the first one; total: both. reuse: again with the workspace, cold; "
        "warm: from the last solution after b changed by 1 %. to 1e-4 ...: seconds of one solve to 1e-8, set-up not included."
    )
    return Table(f"Seconds at {n}^3", columns, rows, remark)


def _quality(n: int, records: list[Record]) -> Table:
    """Iterations, memory and ratios."""
    ratio_names = ("over_linear", "reuse_over_engine", "warm_over_linear", "over_unit", "iterations_over_unit", "loop_over_bare")
    names = ("iterations", "linear_iterations", "warm_iterations", "residual", "bytes_per_cell", "resident_per_cell", *ratio_names)
    rows = [[r.name.partition(" ")[2], *("" if (v := r.value(f)) is None else f"{v:.3g}" for f in names)] for r in records]
    remark = (
        "bytes per cell: Warp arrays of operator, problem, workspace, b and bounds; resident: growth of the process's peak memory. "
        "over linear: to the same method's linear solve, set-up included; reuse over engine: to the linear solve by ProjectedMultigrid, "
        "both cold with a workspace that has solved before."
    )
    return Table(f"Iterations, memory and ratios at {n}^3", ["case", *(f.replace("_", " ") for f in names)], rows, remark)
