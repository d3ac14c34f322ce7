"""Convergence per iteration and per second ([Book] fig. C.2), kink strategies (C.3), relaxation factors of PSOR (C.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.book.problems import SEED, ZEROS, Scale, contacts, fluids
from warp_lcp.benchmarks.book.robustness import FISCHER, PENALIZED
from warp_lcp.benchmarks.book.traces import RTOL
from warp_lcp.benchmarks.record import Chart, Lines, Record, Results, Sheet, Table
from warp_lcp.benchmarks.timing import Figure
from warp_lcp.gallery import Plant, Problem, contact, poisson, splash
from warp_lcp.protocol import families

MOST = 300  # steps
DEEP = 1e-10  # tolerance of the curves: far enough to see how fast a method is at its end
DIRECT = 600  # unknowns up to which dense methods are waited for: at 1,000 pivoting takes half a minute
FACTORS = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 1.9)
SWEEPS = 2000
QUICK = 0.3  # [s] up to which a solve is repeated: other programs disturb short ones most
ALL = 40  # iterations whose rows are all kept; of later ones, one in so many
KINKS = ("random", "zero", "perturbation", "approximation")
COLUMNS = ["experiment", "problem", "method", "iteration", "seconds", "relative residual", "step"]


@dataclass(frozen=True)
class Curve:
    """One solve: `name` of the method, its result, and rows for the sheet."""

    name: str
    result: wl.SolveResult

    @property
    def residuals(self) -> list[float]:
        """Relative natural residuals of all iterates."""
        first = self.result.history[0].residual
        return [r.residual / first for r in self.result.history]

    @property
    def solved(self) -> int | None:
        """Steps to RTOL."""
        return next((k for k, r in enumerate(self.residuals) if r <= RTOL), None)

    @property
    def seconds(self) -> float | None:
        """Seconds to RTOL, set-up not included."""
        return None if self.solved is None else self.result.history[self.solved].seconds

    def rows(self, experiment: str, problem: str) -> list[list[str]]:
        """Return the rows of the sheet: all of the first iterations, some of those after them, the last one and the one that met RTOL."""
        last, rows = len(self.residuals) - 1, []
        for k, (h, r) in enumerate(zip(self.result.history, self.residuals, strict=True)):
            if k <= ALL or k % ALL == 0 or k in (last, self.solved):
                rows.append([experiment, problem, self.name, str(h.iteration), f"{h.seconds:.3e}", f"{r:.3e}", h.step])
        return rows


def measure(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Make the three experiments."""
    parts = [_methods(scale, device, say), _kinks(scale, device, say), _factors(scale, device, say)]
    records = [r for p in parts for r in p.records]
    tables, charts = [t for p in parts for t in p.tables], [c for p in parts for c in p.charts]
    rows = [row for p in parts for sheet in p.sheets for row in sheet.rows]
    return Results(records, tables, charts, sheets=[Sheet("convergence", COLUMNS, rows)])


def _fluid(scale: Scale, device: str) -> Problem:
    return poisson((scale.side,) * 3, plant=Plant(active=ZEROS), seed=SEED, device=device, dtype=wp.float64)


def applicable(problem: Problem) -> dict[str, Any]:
    """Return the methods that take a problem, with their defaults, PGS beside PSOR."""
    methods: dict[str, Any] = {"psor, omega 1": wl.ProjectedSOR(omega=1.0)}
    for name, method in wl.METHODS.items():
        small = getattr(method, "most_unknowns", None)
        if problem.kind in families(method) and (small is None or problem.b.size <= min(small, DIRECT)):
            methods[name] = method()
    return methods


def solved(problem: Problem, solver: Any, device: str, samples: int, *, most: int = MOST, rtol: float = DEEP) -> wl.SolveResult:
    """Solve after a few steps that load kernels; where that is quick, so many times, and return the fastest.

    Raises:
        ValueError: the method does not take the problem.
    """
    lcp = problem.lcp(device=device)
    work = solver.init(lcp)
    wl.solve(lcp, solver, stopping=wl.StoppingCriteria(max_iterations=3, rtol=rtol), workspace=work)
    stopping = wl.StoppingCriteria(max_iterations=most, patience=most, rtol=rtol)
    results = [wl.solve(lcp, solver, stopping=stopping, workspace=work)]
    if results[0].history[-1].seconds < QUICK:
        results += [wl.solve(lcp, solver, stopping=stopping, workspace=work) for _ in range(samples - 1)]
    return min(results, key=lambda result: result.history[-1].seconds)


def _methods(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Compare all methods on a fluid and on contact problems."""
    problems = {
        f"fluid {scale.side}^3, planted": _fluid(scale, device),
        f"splash {2 * scale.side}^3, p >= 0": splash(2 * scale.side).named("everywhere", device=device),
        f"contact {6 * scale.contacts}": contact(scale.contacts, seed=SEED),
        f"contact {10 * scale.contacts}": contact(5 * scale.contacts // 3, seed=SEED + 1),
    }
    records, tables, charts, rows = list[Record](), list[Table](), list[Chart](), list[list[str]]()
    for number, (label, problem) in enumerate(problems.items()):
        say(f"book: convergence, {label}")
        curves, refused = list[Curve](), list[str]()
        for name, solver in applicable(problem).items():
            try:
                curves.append(Curve(name, solved(problem, solver, device, scale.repeat)))
            except ValueError:  # needs a symmetric A, say
                refused.append(name)
        records += [_record(f"convergence: {label}: {c.name}", c) for c in curves]
        rows += [row for c in curves for row in c.rows("methods", label)]
        tables.append(_table(label, curves, refused))
        key = f"{label.partition(' ')[0]}-{number}"
        charts.append(_per_iteration(f"iterations-{key}", f"Convergence per iteration: {label}", curves))
        per_second = {c.name: ([h.seconds for h in c.result.history], c.residuals) for c in curves}
        charts.append(Lines(f"seconds-{key}", f"Convergence per second: {label}", "s", "relative residual", _positive(per_second)))
    return Results(records, tables, charts, sheets=[Sheet("methods", COLUMNS, rows)])


def _positive(curves: dict[str, tuple[list[float], list[float]]]) -> dict[str, tuple[list[float], list[float]]]:
    """Return the curves without points that a logarithmic axis cannot show."""
    kept = {name: [(a, b) for a, b in zip(x, y, strict=True) if b > 0] for name, (x, y) in curves.items()}
    return {name: ([a for a, _ in points], [b for _, b in points]) for name, points in kept.items()}


def _per_iteration(name: str, title: str, curves: list[Curve]) -> Lines:
    shown = _positive({c.name: ([float(k) for k in range(len(c.residuals))], c.residuals) for c in curves})
    return Lines(name, title, "iterations", "relative residual", shown, logarithmic_x=False)


def _record(name: str, curve: Curve) -> Record:
    figures = {"residual": Figure(min(curve.residuals)), "iterations": Figure(curve.result.iterations)}
    if curve.solved is not None:
        figures["to 1e-6"] = Figure(curve.solved)
        figures["seconds to 1e-6"] = Figure(curve.seconds or 0.0, "s")
    return Record(name, figures, {"status": curve.result.status.name})


def _table(label: str, curves: list[Curve], refused: list[str]) -> Table:
    rows = []
    for c in sorted(curves, key=lambda c: (c.seconds is None, c.seconds)):
        to = ["", ""] if c.solved is None else [str(c.solved), f"{1e3 * (c.seconds or 0):.1f}"]
        rows.append([c.name, *to, f"{min(c.residuals):.1e}", c.result.status.name])
    remark = f"To 1e-10 of the natural residual, at most {MOST} steps; seconds without set-up, kernels loaded; the fastest first."
    if all(c.name != "lemke" for c in curves):
        remark += f" Dense methods are tried up to {DIRECT} unknowns: pivoting takes half a minute for 1,000."
    if refused:
        remark += f" Refused, A being not symmetric: {', '.join(refused)}."
    columns = ["method", "iterations to 1e-6", "ms to 1e-6", "smallest residual", "status"]
    return Table(f"Convergence: {label}", columns, rows, remark)


def _kinks(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Compare what stands for the Fischer map's derivative at a kink, in the book's loop."""
    say("book: kink strategies")
    problems: dict[str, Callable[[int], Problem]] = {**fluids(scale), **contacts(scale)}
    few = max(1, scale.problems // 5)
    records, rows, charts, cells = list[Record](), list[list[str]](), list[Chart](), list[list[str]]()
    for label, make in problems.items():
        curves: dict[str, list[Curve]] = {}
        for k in range(few):
            problem = make(k)
            for name, solver in {**{kink: replace(FISCHER, kink=kink) for kink in KINKS}, "penalized": PENALIZED}.items():
                curves.setdefault(name, []).append(Curve(name, solved(problem, solver, device, scale.repeat, most=100)))
        cells_of_kind = [label]
        for name, of_kink in curves.items():
            steps = [c.solved for c in of_kink if c.solved is not None]
            mean = sum(steps) / len(steps) if steps else 0.0
            figures = {"solved": Figure(len(steps)), "problems": Figure(few)} | ({"steps": Figure(mean)} if steps else {})
            records.append(Record(f"kinks: {label}: {name}", figures))
            cells_of_kind.append(f"{len(steps)} of {few}, {mean:.2f}" if steps else f"0 of {few}")
            rows += of_kink[0].rows("kinks", label)
        cells.append(cells_of_kind)
        if label in ("fluid, 7-point, planted", "contact, rigid bodies"):
            shown = [Curve(name, of_kink[0].result) for name, of_kink in curves.items()]
            charts.append(_per_iteration(f"kinks-{label.partition(',')[0]}", f"Kink strategies of Fischer-Newton: {label}", shown))
    remark = (
        f"The book's Fischer-Newton (projected Armijo search, no fallback) on {few} problems of each kind: how many reach 1e-6 within 100 "
        "steps, and the mean of their steps. A kink is met where x_i and y_i are both 0 to rounding; a start of 0 with b_i = 0 is one "
        "(the recipes make such rows), solutions that are strictly complementary have none."
    )
    table = Table("Kink strategies (fig. C.3)", ["problems", *KINKS, "penalized 0.95"], cells, remark)
    return Results(records, [table], charts, sheets=[Sheet("kinks", COLUMNS, rows)])


def _factors(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Vary the relaxation factor of PSOR."""
    say("book: relaxation factors of PSOR")
    side = scale.side
    problems = {
        **{label: make(0) for label, make in fluids(scale).items()},
        f"splash {2 * side}^3, p >= 0": splash(2 * side).named("everywhere", device=device),
        f"splash {4 * side}^3, p >= 0": splash(4 * side).named("everywhere", device=device),
    }
    records, rows, charts, cells = list[Record](), list[list[str]](), list[Chart](), list[list[str]]()
    for number, (label, problem) in enumerate(problems.items()):
        curves = [
            Curve(f"{w:g}", solved(problem, wl.ProjectedSOR(omega=w), device, scale.repeat, most=50 if w < 1 else SWEEPS, rtol=RTOL))
            for w in FACTORS
        ]
        done = {c.name: c.solved for c in curves if c.solved is not None}
        best = min(done, key=lambda name: done[name] or 0, default="")
        figures: dict[str, Figure] = {f"sweeps at {name}": Figure(steps or 0) for name, steps in done.items()}
        if best:
            figures["best"] = Figure(float(best))
        records.append(Record(f"PSOR: {label}", figures))
        counts = ["" if c.solved is None and float(c.name) < 1 else f"> {SWEEPS}" if c.solved is None else str(c.solved) for c in curves]
        cells.append([label, best, *counts])
        shown = [Curve(c.name, replace(c.result, history=c.result.history[:51])) for c in curves]
        rows += [row for c in shown for row in c.rows("relaxation factors", label)]
        charts.append(_per_iteration(f"psor-{number}", f"Relaxation factors of PSOR: {label}", shown))
    remark = (
        f"Sweeps to 1e-6 (at most 50 for factors below 1, {SWEEPS} for others). Matrices are swept row by row, grids red-"
        "black. The book's 1.4 is near the best on its matrices, and where active unknowns are scattered over the domain; where they lie "
        "together the best factor goes to 2 with the number of cells along a side, as without bounds."
    )
    table = Table("Relaxation factors of PSOR (fig. C.4)", ["problem", "best", *(f"{w:g}" for w in FACTORS)], cells, remark)
    return Results(records, [table], charts, sheets=[Sheet("factors", COLUMNS, rows)])
