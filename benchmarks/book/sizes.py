"""Cost against the number of unknowns ([Book] fig. C.5): grids up to 10^6 unknowns, contacts with dense matrices."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.book.convergence import RTOL
from warp_lcp.benchmarks.book.problems import SEED, Scale
from warp_lcp.benchmarks.record import Chart, Lines, Record, Results, Sheet, Table
from warp_lcp.benchmarks.timing import Figure
from warp_lcp.gallery import contact, splash

STEPS = 10  # the book measures the time of so many
LEAST = 20_000  # unknowns from which on exponents of grids are fitted: below, launches cost as much as the work
MOST_SWEEPS = 1500
GRID: dict[str, Any] = {
    "ProjectedMultigrid": wl.ProjectedMultigrid(),
    "MinimumMapNewton": wl.MinimumMapNewton(),
    "MPRGP": wl.MPRGP(),
    "FischerNewton": wl.FischerNewton(),
    "InteriorPoint": wl.InteriorPoint(),
    "PSOR 1.9": wl.ProjectedSOR(omega=1.9),
    "PSOR 1.4": wl.ProjectedSOR(omega=1.4),
}
SWEPT = 300_000  # unknowns up to which sweeps are waited for; beyond, STEPS of them are timed
DENSE: dict[str, Any] = {
    "FischerNewton": wl.FischerNewton(),
    "InteriorPoint": wl.InteriorPoint(),
    "MinimumMapNewton": wl.MinimumMapNewton(),
    "Lemke": wl.Lemke(),
}


@dataclass(frozen=True)
class Cost:
    """What a solve cost.

    Args:
        method: its name.
        unknowns: how many.
        solve: seconds to 1e-6 and steps, None if that was not reached.
        step: seconds of a step.
    """

    method: str
    unknowns: int
    solve: tuple[float, int] | None
    step: float


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Return p of seconds = c sizes^p by least squares of logarithms; NaN for fewer than two sizes."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0]) if len(sizes) > 1 else float("nan")


def measure(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Measure grids and contacts."""
    grids, dense = list[Cost](), list[Cost]()
    for n in scale.sizes:
        say(f"book: cost against size, {n}^3")
        scene = splash(n)
        unknowns = int((scene.cells == wl.FLUID).sum())
        for name, solver in GRID.items():
            problem = scene.problem("everywhere", device)
            most = STEPS if name.startswith("PSOR") and (unknowns > SWEPT or name.endswith("1.4")) else MOST_SWEEPS
            grids.append(_cost(name, problem, solver, unknowns, most, scale.repeat))
    for rows in scale.rows:
        say(f"book: cost against size, {rows} contacts")
        for name, solver in DENSE.items():
            problems = [contact(rows, seed=SEED + k).lcp(device=device) for k in range(scale.repeat)]
            costs = [_cost(name, p, solver, 6 * rows, 100, 1) for p in problems]
            done = [c.solve for c in costs if c.solve is not None]
            solve = (
                (float(np.median([t for t, _ in done])), round(float(np.median([k for _, k in done])))) if len(done) == len(costs) else None
            )
            dense.append(Cost(name, 6 * rows, solve, float(np.median([c.step for c in costs]))))
    fluid = "Cost against size: splash, p >= 0 in all cells (fig. C.5a)"
    fluid_remark = (
        "Seconds to 1e-6 with a workspace that has solved before, the least of the samples; step: of one iteration of the method. "
        f"The exponent of seconds over unknowns is fitted from {LEAST} unknowns on. "
        f"PSOR 1.4, and 1.9 beyond {SWEPT} unknowns, are timed for {STEPS} sweeps as in the book: to 1e-6 they need hundreds or thousands, "
        "a number that grows with the cells along a side, so that their cost to a tolerance grows faster than their step's. The "
        "largest grid does not fit into the caches, the others do: exponents above 1 of steps come from that."
    )
    contacts = "Cost against size: contacts of rigid bodies (fig. C.5b)"
    contacts_remark = (
        "Dense matrices of 6 unknowns a contact, factored anew in each step; the median of the problems. Exponents over all sizes: below "
        "500 unknowns the cubic part does not dominate yet. Without iterations: not all of the problems were solved."
    )
    parts = [("grid", fluid, fluid_remark, grids, LEAST), ("contact", contacts, contacts_remark, dense, 0)]
    records, tables, charts = list[Record](), list[Table](), list[Chart]()
    for key, title, remark, costs, least in parts:
        records += _records(key, costs, least)
        tables.append(_table(title, remark, costs, least))
        charts.append(_chart(key, title, costs))
    rows_of_sheet = [[key, c.method, str(c.unknowns), *_cells(c)] for key, _, _, costs, _ in parts for c in costs]
    columns = ["problem", "method", "unknowns", "seconds to 1e-6", "steps", "seconds of a step"]
    return Results(records, tables, charts, sheets=[Sheet("sizes", columns, rows_of_sheet)])


def _cost(name: str, problem: wl.LCP, solver: Any, unknowns: int, most: int, repeat: int) -> Cost:
    """Solve once to load kernels, then `repeat` times."""
    work = solver.init(problem)
    first = wl.StoppingCriteria(rtol=RTOL, max_iterations=min(most, STEPS))
    criteria = wl.StoppingCriteria(rtol=RTOL, max_iterations=most, patience=most)
    wl.solve(problem, solver, stopping=first, workspace=work)
    samples = []
    for _ in range(repeat):
        begun = time.perf_counter()
        result = wl.solve(problem, solver, stopping=criteria, workspace=work)
        wp.synchronize_device(problem.device)
        samples.append(time.perf_counter() - begun)
    least, steps = min(samples), max(1, result.iterations)
    return Cost(name, unknowns, (least, steps) if result else None, least / steps)


def _cells(c: Cost) -> list[str]:
    solve = ["", ""] if c.solve is None else [f"{c.solve[0]:.4g}", str(c.solve[1])]
    return [*solve, f"{c.step:.4g}"]


def _by_method(costs: Sequence[Cost]) -> dict[str, list[Cost]]:
    found: dict[str, list[Cost]] = {}
    for c in costs:
        found.setdefault(c.method, []).append(c)
    return found


def _exponents(costs: Sequence[Cost], least: int) -> tuple[float, float]:
    """Return the exponents of the time to 1e-6 (NaN unless every size was solved) and of a step's."""
    large = [c for c in costs if c.unknowns >= least]
    if len(large) < 2:
        large = list(costs)
    sizes = [float(c.unknowns) for c in large]
    solves = [c.solve[0] for c in large if c.solve is not None]
    return exponent(sizes, solves) if len(solves) == len(sizes) else float("nan"), exponent(sizes, [c.step for c in large])


def _records(key: str, costs: Sequence[Cost], least: int) -> list[Record]:
    records = []
    for method, of_method in _by_method(costs).items():
        for c in of_method:
            figures = {"step": Figure(c.step, "s")}
            if c.solve is not None:
                figures |= {"solve": Figure(c.solve[0], "s"), "steps": Figure(c.solve[1])}
            records.append(Record(f"cost: {key}: {method}: {c.unknowns}", figures))
        solve, step = _exponents(of_method, least)
        figures = {name: Figure(p) for name, p in (("solve exponent", solve), ("step exponent", step)) if np.isfinite(p)}
        records.append(Record(f"cost: {key}: {method}", figures))
    return records


def _table(title: str, remark: str, costs: Sequence[Cost], least: int) -> Table:
    sizes = sorted({c.unknowns for c in costs})
    rows = []
    for method, of_method in _by_method(costs).items():
        cells = {c.unknowns: c for c in of_method}
        shown = []
        for n in sizes:
            c = cells[n]
            shown.append(f"{1e3 * c.step:.3g} a step" if c.solve is None else f"{1e3 * c.solve[0]:.3g} in {c.solve[1]}")
        exponents = ["" if np.isnan(p) else f"{p:.2f}" for p in _exponents(of_method, least)]
        rows.append([method, *shown, *exponents])
    return Table(title, ["method", *(f"{n} unknowns [ms]" for n in sizes), "exponent to 1e-6", "exponent of a step"], rows, remark)


def _chart(key: str, title: str, costs: Sequence[Cost]) -> Lines:
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for method, of_method in _by_method(costs).items():
        solved = [c for c in of_method if c.solve is not None]
        if solved:
            curves[f"{method}, to 1e-6"] = ([float(c.unknowns) for c in solved], [c.solve[0] for c in solved if c.solve is not None])
        if len(solved) < len(of_method):
            curves[f"{method}, {STEPS} steps"] = ([float(c.unknowns) for c in of_method], [STEPS * c.step for c in of_method])
    return Lines(f"sizes-{key}", title, "unknowns", "s", curves)
