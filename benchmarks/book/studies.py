"""[Book] figures C.5 and C.6, and problems with zero eigenvalues.

The studies are cost against size, warm starts and semi-definite problems.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy.optimize

import warp_lcp as wl
from warp_lcp.benchmarks.book.appendix_c import (
    APPROXIMATION,
    FISCHER,
    METHODS,
    MINIMUM_MAP,
    PGS,
    Method,
)
from warp_lcp.benchmarks.book.outcome import RTOL, BookLimits, Merit, outcome, spread
from warp_lcp.benchmarks.book.problems import RULES, SEED, ProblemScale, dense
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    Panels,
    RecordLines,
    RecordTable,
    Results,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.gallery import Problem, contact, splash
from warp_lcp.problem.method_protocol import Solver

STEPS = 10  # steps that figure C.5 times
# Fewest unknowns for fitted exponents on grids: below, launches cost as much as the work.
LEAST = 3000
GRID: dict[str, tuple[Solver, int]] = {  # method, most steps
    "ProjectedMultigrid": (wl.ProjectedMultigrid(), 100),
    "FischerNewton": (wl.FischerNewton(), 100),
    "MinimumMapNewton": (wl.MinimumMapNewton(), 100),
    "InteriorPoint": (wl.InteriorPoint(), 100),
    "PSOR 1.9": (wl.ProjectedSOR(omega=1.9), 400),
    "PGS": (PGS, STEPS),
}
DENSE: dict[str, tuple[Solver, int]] = {
    "FischerNewton": (wl.FischerNewton(), 100),
    "MinimumMapNewton": (wl.MinimumMapNewton(), 200),
    "InteriorPoint": (wl.InteriorPoint(), 100),
    "Lemke": (wl.Lemke(), 1000),
}
SWEPT = 10  # PGS sweeps before a warm start
ZEROS = (0.0, 0.2, 0.4, 0.6, 0.8)
SEMIDEFINITE: dict[str, Method] = {
    "Fischer-Newton, approximation": (APPROXIMATION, Merit.FISCHER),
    **{
        name: METHODS[name]
        for name in ("minimum map", "PGS", "PSOR 1.4", "FischerNewton()", "MinimumMapNewton()")
    },
}


def measure(results: Results, scale: ProblemScale, options: Options) -> None:
    """Run the three experiments."""
    _cost(results, scale, options)
    _warm(results, scale, options)
    _zeros(results, scale, options)


def _cost(results: Results, scale: ProblemScale, options: Options) -> None:
    """Time solves against the number of unknowns (figure C.5)."""
    panels = list[RecordLines]()
    fluids = {
        int((splash(n).cells == wl.FLUID).sum()): splash(n).lcp("everywhere", device=options.device)
        for n in scale.grids
    }
    contacts = {6 * k: contact(k, seed=SEED).lcp(device=options.device) for k in scale.rows}
    for what, problems, methods, least in (
        ("splash, p >= 0", fluids, GRID, LEAST),
        ("contacts of rigid bodies", contacts, DENSE, 0),
    ):
        rows, curves, sizes = (
            list[list[str]](),
            dict[str, tuple[Sequence[float], Sequence[float]]](),
            np.array(list(problems), dtype=float),
        )
        for method, (solver, most) in methods.items():
            cells, steps, solves = list[str](), list[float](), list[float]()
            for unknowns, problem in problems.items():
                options.say(f"book: cost, {what}, {method}, {unknowns} unknowns")
                result, seconds = _timed(problem, solver, most, options.repeat)
                steps.append(seconds / max(1, result.iterations))
                solves.append(seconds if result else math.nan)
                figures = {
                    "seconds of a step": Figure(steps[-1], "s"),
                    "steps": Figure(result.iterations),
                }
                figures |= {f"seconds to {RTOL:g}": Figure(seconds, "s")} if result else {}
                results.records.append(
                    BenchmarkRecord(
                        f"cost: {what}: {method}: {unknowns}",
                        figures,
                        {"status": result.status.name},
                    )
                )
                cells.append(
                    f"{1e3 * seconds:.3g} in {result.iterations}"
                    if result
                    else f"{1e3 * steps[-1]:.3g} a step"
                )
            exponents = [exponent(sizes, solves, least), exponent(sizes, steps, least)]
            rows.append([method, *cells, *("" if np.isnan(p) else f"{p:.2f}" for p in exponents)])
            unsolved = np.isnan(solves).any()
            curves[f"{method}, {STEPS} steps" if unsolved else method] = (
                list(sizes),
                [STEPS * t for t in steps] if unsolved else solves,
            )
        panels.append(RecordLines(what, what, "unknowns", "s", curves))
        remark = (
            f"ms to {RTOL:g} and steps, the least of the samples, with a workspace that has solved "
            "before; ms of a step where the limit of "
            f"steps came first. Exponents are of the time to {RTOL:g} and of a step's, over "
            f"unknowns{f' from {least} on' if least else ''}."
        )
        columns = ["method", *(f"{n} unknowns" for n in problems), "exponent", "of a step"]
        results.tables.append(
            RecordTable(f"Figure C.5: cost against size, {what}", columns, rows, remark)
        )
    results.charts.append(
        Panels("c5-cost", f"Figure C.5: time to {RTOL:g} against unknowns", panels)
    )


def _timed(problem: wl.LCP, solver: Solver, most: int, repeat: int) -> tuple[wl.SolveResult, float]:
    """Return a solve and its least time [s]; the first solve only loads kernels."""
    work, stopping = (
        solver.init(problem),
        wl.StoppingCriteria(rtol=RTOL, max_iterations=most, patience=most),
    )
    wl.solve(problem, solver, stopping=wl.StoppingCriteria(max_iterations=3), workspace=work)
    results = [
        wl.solve(problem, solver, stopping=stopping, workspace=work) for _ in range(min(repeat, 3))
    ]
    return results[0], min(r.history[-1].seconds for r in results)


def exponent(sizes: np.ndarray, seconds: Sequence[float], least: int) -> float:
    """Return p of seconds = c sizes^p, a least-squares fit of the logarithms.

    The result is NaN if there are fewer than two sizes or a problem is unsolved.
    """
    kept = sizes >= least if (sizes >= least).sum() > 1 else sizes > 0
    if np.isnan(seconds).any() or kept.sum() < 2:
        return math.nan
    return float(np.polyfit(np.log(sizes[kept]), np.log(np.array(seconds)[kept]), 1)[0])


def _warm(results: Results, scale: ProblemScale, options: Options) -> None:
    """Count Newton iterations from zero and from ten PGS sweeps (figure C.6)."""
    rows, panels = list[list[str]](), list[RecordLines]()
    limits = BookLimits(rtol=1e-6, atol=1e-2, most=30)
    for rule in RULES:
        options.say(f"book: warm starts, {rule}")
        problems, curves = (
            [dense(rule, scale, k) for k in range(scale.problems)],
            dict[str, tuple[list[float], list[float]]](),
        )
        stopping = wl.StoppingCriteria(rtol=0.0, max_iterations=SWEPT)
        swept = [
            wl.solve(p.lcp(device=options.device), PGS, stopping=stopping).x.numpy()
            for p in problems
        ]
        methods: dict[str, Method] = {
            "Fischer-Newton": (FISCHER, Merit.FISCHER),
            "minimum map": (MINIMUM_MAP, Merit.MINIMUM),
        }
        for method, (solver, merit) in methods.items():
            for start, starts in (("from 0", None), (f"from {SWEPT} sweeps", swept)):
                name = f"{method} {start}"
                solves = outcome(
                    f"warm: {rule}: {name}",
                    problems,
                    solver,
                    merit,
                    options.device,
                    limits=limits,
                    starts=starts,
                )
                results.records.append(solves.record())
                rows.append(
                    [rule, method, start, solves.states, spread(solves.accepted), solves.share]
                )
                shown = range(1, 8)
                curves[name] = (
                    [float(k) for k in shown],
                    [float(solves.accepted.count(k)) for k in shown],
                )
        panels.append(RecordLines(rule, rule, "iterations", "problems", curves, log=""))
    remark = (
        f"{scale.problems} dense positive definite problems of {scale.dense} unknowns, eigenvalues "
        "evenly spaced in (0, 1]. Iterations to "
        "an absolute merit of 1e-2, counted as Num4LCP does: the first test is number 1, so that a "
        "start that is good enough counts 1. "
        f"Solved: to {RTOL:g} of the natural residual of the start, within 30 steps."
    )
    columns = ["problems", "method", "start", "book's test", "iterations", "solved, steps"]
    results.tables.append(RecordTable("Figure C.6: warm starts", columns, rows, remark))
    results.charts.append(Panels("c6-warm", "Figure C.6: warm starts", panels))


def solvable(problem: Problem) -> bool:
    """Return whether some x >= 0 has A x + b >= 0.

    If A is positive semi-definite, the LCP then has a solution.
    """
    n = len(problem.b)
    assert isinstance(problem.A, np.ndarray)
    return bool(
        scipy.optimize.linprog(
            np.zeros(n), A_ub=-problem.A, b_ub=problem.b, bounds=(0, None), method="highs"
        ).status
        == 0
    )


def _zeros(results: Results, scale: ProblemScale, options: Options) -> None:
    """Solve problems with a growing number of zero eigenvalues."""
    rows, panels = list[list[str]](), list[RecordLines]()
    few, limits = max(2, scale.problems // 10), BookLimits(rtol=1e-4, atol=1e-2)
    for rule in RULES:
        curves = {name: (list[float](), list[float]()) for name in ("solvable", *SEMIDEFINITE)}
        for zeros in ZEROS:
            options.say(f"book: zero eigenvalues, {rule}, {zeros:.0%}")
            problems = [dense(rule, scale, k, zeros) for k in range(few)]
            able = sum(map(solvable, problems))
            results.records.append(
                BenchmarkRecord(
                    f"zeros: {rule}: {zeros:.0%}",
                    {"solvable": Figure(able), "problems": Figure(few)},
                )
            )
            shares = {"solvable": able}
            for method, (solver, merit) in SEMIDEFINITE.items():
                solves = outcome(
                    f"zeros: {rule}: {zeros:.0%}: {method}",
                    problems,
                    solver,
                    merit,
                    options.device,
                    limits=limits,
                )
                results.records.append(solves.record())
                ends = results.records[-1].facts["statuses"]
                rows.append([rule, f"{zeros:.0%}", f"{able} of {few}", method, *solves.row(), ends])
                shares[method] = len(solves.solved)
            for name, count in shares.items():
                curves[name][0].append(100 * zeros)
                curves[name][1].append(100 * count / few)
        panels.append(RecordLines(rule, rule, "zero eigenvalues [%]", "solved [%]", curves, log=""))
    remark = (
        f"{few} dense positive semi-definite problems of {scale.dense} unknowns for each share of "
        "zero eigenvalues. Book's test: relative "
        "1e-4, absolute 1e-2, at most 100. Solvable: a linear program finds x >= 0 with A x + b >= "
        "0."
    )
    columns = [
        "problems",
        "zeros",
        "solvable",
        "method",
        "book's test",
        "iterations",
        "residual there",
        "solved",
        "steps",
        "the library says",
    ]
    results.tables.append(RecordTable("Zero eigenvalues", columns, rows, remark))
    results.charts.append(
        Panels("zeros", f"Zero eigenvalues: problems solved to {RTOL:g} in 100 steps", panels)
    )
