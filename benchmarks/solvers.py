"""Linear and LCP solves of the splash: time, iterations and memory.

The solves take turns with those of PyAMG and SciPy in the same process. Then every method of the
library solves a small problem of each kind on which [Book] appendix C compares methods.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np

import warp_lcp as wl
from warp_lcp import gallery
from warp_lcp.benchmarks.cases import RTOL, SolverCase
from warp_lcp.benchmarks.harness.machine import COPIED, machine, present
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    Chart,
    RecordLines,
    RecordTable,
    Results,
    shown,
    spread,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options, ratios
from warp_lcp.benchmarks.peers.libraries import pyamg, scipy_cg
from warp_lcp.benchmarks.peers.peer import PeerAnswer, PeerProblem
from warp_lcp.benchmarks.problems import BOUNDS, anisotropic, cut_cells, splash
from warp_lcp.files import Tables
from warp_lcp.operators.grid_poisson import PoissonArguments
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.solvers.fallback import Progress

TITLE = "Linear and LCP pressure solves"
SIZES = (64, 128)
# [s] after which a peer gets no more rounds: PyAMG needs that for one solve at 256^3.
PEER_SECONDS = 60.0
# Cells along a side beyond which only ProjectedMultigrid on unit coefficients is measured; the
# other cases take minutes per round.
LARGE = 192
SCIPY_CELLS = 64  # cells along a side up to which plain CG is measured
ENGINE = "ProjectedMultigrid"


def is_near(progress: Progress) -> bool:
    """Return whether the residual is a hundredth, where the active set is known."""
    return progress.norms[-1] <= 1e-2 * progress.norms[0]


OTHERS: dict[str, Solver] = {
    "MPRGP": wl.MPRGP(),
    "FischerNewton": wl.FischerNewton(),
    "InteriorPoint": wl.InteriorPoint(),
    "InteriorPoint, crossover": wl.Fallback(wl.InteriorPoint(), (wl.MinimumMapNewton(), is_near)),
}
# [Book] appendix C: fluids, contacts, and random matrices.
BOOK: dict[str, Callable[[], gallery.Problem]] = {
    "fluid 12^3": lambda: gallery.splash(12).named("walls", device="cpu"),
    "contacts of 12 bodies": lambda: gallery.contact(12, seed=2015),
    "definite 100": lambda: gallery.definite(100, condition=100.0, seed=2015),
}
BOOK_STOPPING = wl.StoppingCriteria(rtol=1e-8, max_iterations=1000, patience=1000)


def measure(options: Options, out: Path) -> Results:
    """Measure all cases at the requested sizes, then all methods on small problems."""
    sizes = options.sizes or SIZES
    where = machine(
        options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat
    )
    records, tables = list[BenchmarkRecord](), list[RecordTable]()
    for n in sizes:
        cases, answers, question = _measure_size(n, options)
        found = _records(n, cases, answers, question)
        records += found
        tables += [_times(n, found), _quality(n, found)]
    curves = _curves(cases)
    book, residuals = _book(options)
    charts: list[Chart] = [
        RecordLines(
            "convergence",
            f"Cold solves at {sizes[-1]}^3",
            "s",
            "relative residual",
            curves,
            log="y",
        )
    ]
    charts += [
        RecordLines(f"book-{name.split()[0]}", name, "iterations", "relative residual", c)
        for name, c in residuals.items()
    ]
    return Results([where, *records, *book], [*tables, _book_table(book)], charts)


def _measure_size(
    n: int, options: Options
) -> tuple[list[SolverCase], dict[str, list[PeerAnswer]], PeerProblem]:
    """Measure one sample of every case and peer in each round."""
    cases, question = _cases(n, options.device), PeerProblem(splash(n), "linear")
    solves: dict[str, Callable[[PeerProblem, float], PeerAnswer]] = (
        {"PyAMG SA-CG": pyamg} if present("pyamg") else {}
    )
    solves |= {"SciPy CG": scipy_cg} if n <= SCIPY_CELLS else {}
    answers: dict[str, list[PeerAnswer]] = {name: [] for name in solves}
    for turn in range(options.repeat + 1):  # the first turn loads kernels
        options.say(f"solvers at {n}^3, round {turn} of {options.repeat}")
        for case in cases:
            case.cold(keep=turn > 0)
            if case.full:
                case.again(keep=turn > 0)
        for name, solve in solves.items() if turn > 0 else ():
            if sum(a.total for a in answers[name]) < PEER_SECONDS:
                answers[name].append(solve(question, RTOL))
    for case in cases:
        if case.full:
            case.to_tolerances()
        case.memory()
    return cases, answers, question


def _cases(n: int, device: str) -> list[SolverCase]:
    """Return the cases of a size.

    ProjectedMultigrid and other methods run on unit coefficients. Only ProjectedMultigrid runs on
    harder scenes.
    """
    scene, engine = splash(n), wl.ProjectedMultigrid()
    if n > LARGE:
        return [SolverCase("unit", scene, bounds, engine, device) for bounds in BOUNDS]
    flat = anisotropic(scene)
    arrays: Tables = {
        f"face_{a}": np.full([n + (i == j) for j in range(3)], flat.faces.get(f"face_{a}", 1.0))
        for i, a in enumerate("zyx")
    }
    cases = [
        SolverCase("unit", scene, bounds, solver, device)
        for bounds in BOUNDS
        for solver in (engine, wl.MinimumMapNewton())
    ]
    cases += [
        SolverCase("unit", scene, b, solver, device, full=False, label=label)
        for label, solver in OTHERS.items()
        for b in BOUNDS[1:]
    ]
    cases += [SolverCase("faces", cut_cells(scene), bounds, engine, device) for bounds in BOUNDS]
    harder = {
        "cells 1:100": flat,
        "arrays 1:100": type(scene)(
            n, scene.cells, scene.b, scene.wall, cast(PoissonArguments, arrays)
        ),
    }
    return cases + [
        SolverCase(form, s, bounds, engine, device, full=False)
        for form, s in harder.items()
        for bounds in BOUNDS[:2]
    ]


def _records(
    n: int, cases: list[SolverCase], answers: dict[str, list[PeerAnswer]], question: PeerProblem
) -> list[BenchmarkRecord]:
    """Return the records of a size, with ratios of samples of the same rounds."""
    by_name = {case.name: case for case in cases}
    pyamg = [a.total for a in answers.get("PyAMG SA-CG", [])]
    records = []
    for case in cases:
        figures, method = case.figures(), case.method
        linear = by_name.get(f"{n}^3 {case.form} linear {method}", case)
        unit = by_name.get(f"{n}^3 unit {case.bounds} {method}", case)
        for label, other, sample in (
            ("over_linear", linear, "total"),
            ("over_unit", unit, "total"),
            ("warm_over_linear", linear, "warm"),
        ):
            if other is not case and case.samples[sample]:
                figures[label] = ratios(case.samples[sample], other.samples[sample])
        if unit is not case:
            figures["iterations_over_unit"] = Figure(
                case.counts["iterations"] / unit.counts["iterations"]
            )
        if pyamg and case.form == "unit":
            figures["pyamg_over_this"] = ratios(pyamg, case.samples["total"][: len(pyamg)])
        records.append(
            BenchmarkRecord(
                case.name,
                figures,
                {"form": case.form, "bounds": case.bounds, "method": method, "n": n},
            )
        )
    for name, solutions in answers.items():
        figures = {
            part: Figure.of([getattr(a, part) for a in solutions], "s")
            for part in ("setup", "solve", "total")
        }
        figures |= {
            "iterations": Figure(solutions[-1].iterations),
            "residual": Figure(question.residual(solutions[-1].x)),
        }
        records.append(
            BenchmarkRecord(
                f"{n}^3 unit linear {name}",
                figures,
                {"form": "unit", "bounds": "linear", "method": name, "n": n},
            )
        )
    return records


def _curves(cases: list[SolverCase]) -> dict[str, tuple[list[float], list[float]]]:
    """Return the curves of relative residual over seconds."""
    curves = {}
    for case in cases:
        if case.history and case.form == "unit":
            points = [
                (r.seconds, r.residual / case.history[0].residual)
                for r in case.history
                if r.residual > 0
            ]
            curves[f"{case.bounds}, {case.method}"] = (
                [t for t, _ in points],
                [r for _, r in points],
            )
    return curves


def _times(n: int, records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return the table of seconds: medians, and the range of the cold total."""
    parts = ("setup", "solve", "total", "reuse", "warm", "to_1e-04", "to_1e-06", "to_1e-08")
    columns = [
        "case",
        *(f"{p.replace('_', ' ')} [ms]" for p in parts),
        "range of total",
        "x faster than PyAMG",
    ]
    rows = []
    for r in records:
        rows.append(
            [
                r.name.partition(" ")[2],
                *shown(r, parts, ".1f", 1e3),
                spread(r.figures["total"], 1e3),
            ]
        )
        rows[-1] += shown(r, ["pyamg_over_this"], ".1f")
    remark = (
        "setup: GridPoisson, LCP and init from host arrays; solve: the first one; total: both. "
        "reuse: again with the workspace, cold; "
        "warm: from the last solution after b changed by 1 %. to 1e-4 ...: seconds of one solve to "
        "1e-8, set-up not included."
    )
    return RecordTable(f"Seconds at {n}^3", columns, rows, remark)


def _quality(n: int, records: Sequence[BenchmarkRecord]) -> RecordTable:
    names = [
        "iterations",
        "linear_iterations",
        "warm_iterations",
        "residual",
        "bytes_per_cell",
        "resident_per_cell",
    ]
    names += ["over_linear", "warm_over_linear", "over_unit", "iterations_over_unit"]
    rows = [[r.name.partition(" ")[2], *shown(r, names)] for r in records]
    remark = (
        "bytes per cell: Warp arrays of operator, problem, workspace, b and bounds; resident: "
        "growth of the process's peak memory. "
        "over linear: to the same method's linear solve, set-up included."
    )
    return RecordTable(
        f"Iterations, memory and ratios at {n}^3",
        ["case", *(f.replace("_", " ") for f in names)],
        rows,
        remark,
    )


def _book(
    options: Options,
) -> tuple[list[BenchmarkRecord], dict[str, dict[str, tuple[list[float], list[float]]]]]:
    """Solve each small problem by every applicable method.

    The result is records, and residuals over iterations by problem and method.
    """
    records, curves = (
        list[BenchmarkRecord](),
        dict[str, dict[str, tuple[list[float], list[float]]]](),
    )
    for what, make in BOOK.items():
        curves[what] = {}
        for name, method in wl.METHODS.items():
            problem = make().lcp(device=options.device)
            try:
                # Loads the kernels.
                wl.solve(problem, method(), stopping=wl.StoppingCriteria(max_iterations=1))
                begun = time.perf_counter()
                result = wl.solve(problem, method(), stopping=BOOK_STOPPING)
            except ValueError:  # the method refuses the problem
                continue
            figures = {
                "seconds": Figure(time.perf_counter() - begun, "s"),
                "iterations": Figure(result.iterations),
            }
            figures["residual"] = Figure(result.relative_residual)
            records.append(
                BenchmarkRecord(
                    f"{what}: {name}",
                    figures,
                    {"problem": what, "method": name, "status": result.status.name},
                )
            )
            first = result.history[0].residual
            points = [
                (r.iteration, r.residual / first)
                for r in result.history
                if r.iteration > 0 and r.residual > 0
            ]
            curves[what][name] = [float(n) for n, _ in points], [r for _, r in points]
    return records, curves


def _book_table(records: Sequence[BenchmarkRecord]) -> RecordTable:
    columns = ["problem", "method", "status", "iterations", "relative residual", "ms"]
    rows = [
        [
            r.facts["problem"],
            r.facts["method"],
            r.facts["status"],
            *shown(r, ["iterations", "residual"]),
            *shown(r, ["seconds"], ".1f", 1e3),
        ]
        for r in records
    ]
    remark = (
        f"To {BOOK_STOPPING.rtol:g} in {BOOK_STOPPING.max_iterations} steps at most, set-up "
        "included; who is not listed refuses."
    )
    return RecordTable(
        "Every method on small problems of [Book] appendix C's kinds", columns, rows, remark
    )
