"""[Book] figures C.1 to C.4, tables C.1 and C.2.

The experiments cover sparsity patterns, convergence, final states, kinks of the Fischer map, and
the factors lambda and omega.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks.book.outcome import RTOL, BookOutcome, Merit, outcome
from warp_lcp.benchmarks.book.problems import ProblemScale, kinds
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    Panels,
    RecordLines,
    RecordTable,
    Results,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.gallery import Problem, splash
from warp_lcp.problem.method_protocol import Solver

# The book's methods: monotone searches without fallbacks, no preceding cycles, linear systems
# solved. Num4LCP's default at kinks, "random", leaves their rows of the Jacobian empty, as "zero"
# does.
FISCHER = wl.FischerNewton(
    fischer_weight=1.0, kink="zero", safeguard=False, scaled=False, monotone_cycles=0, eta=1e-8
)
APPROXIMATION = replace(FISCHER, kink="approximation", max_linear_iterations=50)
MINIMUM_MAP = wl.MinimumMapNewton(safeguard=False, monotone_cycles=0, eta=1e-8)
INTERIOR = wl.InteriorPoint(mehrotra=False, monotone_cycles=0, precision="double")
PGS, PSOR = wl.ProjectedSOR(omega=1.0), wl.ProjectedSOR(omega=1.4)
Method = tuple[Solver, Merit]
METHODS: dict[str, Method] = {
    "Fischer-Newton": (FISCHER, Merit.FISCHER),
    "minimum map": (MINIMUM_MAP, Merit.MINIMUM),
    "interior point": (INTERIOR, Merit.MINIMUM),
    "PGS": (PGS, Merit.PRODUCT),
    "PSOR 1.4": (PSOR, Merit.PRODUCT),
    "FischerNewton()": (wl.FischerNewton(), Merit.FISCHER),
    "MinimumMapNewton()": (wl.MinimumMapNewton(), Merit.MINIMUM),
    "InteriorPoint()": (wl.InteriorPoint(), Merit.MINIMUM),
}
# Final states and iterations of tables C.1 and C.2.
PUBLISHED = {
    "fluid, recipe: Fischer-Newton": "100 absolute, 5.00 (5 to 5, 0.00)",
    "fluid, recipe: minimum map": "100 absolute, 4.07 (3 to 5, 0.29)",
    "fluid, recipe: PGS": "100 absolute, 49.38 (9 to 83, 17.48)",
    "fluid, recipe: PSOR 1.4": "100 absolute, 25.29 (16 to 35, 3.77)",
    "contact, recipe: Fischer-Newton": "100 absolute, 14.54 (9 to 26, 2.79)",
    "contact, recipe: minimum map": "100 non-descent",
}
# The book's problems and the corrected ones.
COMPARED = ("fluid, recipe", "fluid, 7-point, planted", "contact, recipe", "contact, rigid bodies")
KINKS = {
    **{kink: replace(FISCHER, kink=kink) for kink in ("random", "zero", "perturbation")},
    "approximation": APPROXIMATION,
}
SHARES = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)  # lambda
FACTORS = (0.6, 0.8, 1.0, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 1.9)  # omega
SWEEPS = 2000
SHOWN = 50  # iterations shown in figure C.2
NEAR = 1e-9  # relative residual at which the convergence rate is measured
UNIT = "residual / residual at x = 0"


def measure(results: Results, scale: ProblemScale, options: Options) -> None:
    """Run the experiments on random problems."""
    problems = {
        kind: [make(k) for k in range(scale.problems)] for kind, make in kinds(scale).items()
    }
    _patterns(results, problems)
    _states(results, problems, options)
    few = {kind: problems[kind][: max(2, scale.problems // 2)] for kind in COMPARED}
    _kinks(results, few, options)
    _lambda(results, few, options)
    _omega(
        results,
        {kind: of_kind[0] for kind, of_kind in problems.items() if kind.startswith("fluid")},
        scale,
        options,
    )


def _patterns(results: Results, problems: dict[str, list[Problem]]) -> None:
    """Draw figure C.1 and check the solutions that the recipes plant."""
    rows, panels = list[list[str]](), list[RecordLines]()
    for kind, of_kind in problems.items():
        infeasible, worst, at_bound_shares = 0, 0.0, list[float]()
        for p in of_kind:
            y = p.A @ p.solution + p.b if p.solution is not None else np.zeros(1)
            infeasible += bool(y.min() < -1e-9)
            worst = max(worst, float(-y.min()))
        for p in of_kind[:10]:
            result = wl.solve(
                p.lcp(device="cpu"), wl.FischerNewton(), stopping=wl.StoppingCriteria(rtol=1e-9)
            )
            x = result.x.numpy().ravel()
            at_bound_shares.append(float((x < p.A @ x + p.b).mean()))
        figures = {
            "infeasible": infeasible,
            "problems": len(of_kind),
            "worst": worst,
            "held": statistics.fmean(at_bound_shares),
        }
        results.records.append(
            BenchmarkRecord(
                f"planted: {kind}", {name: Figure(value) for name, value in figures.items()}
            )
        )
        planted = "none" if of_kind[0].solution is None else f"{infeasible} of {len(of_kind)}"
        rows.append([kind, planted, f"{worst:.2g}", f"{statistics.fmean(at_bound_shares):.1%}"])
        if kind in COMPARED:
            A = of_kind[0].A
            assert not isinstance(A, wl.GridPoisson)
            i, j = np.nonzero(A[:60, :60] if isinstance(A, np.ndarray) else A[:60, :60].toarray())
            panels.append(
                RecordLines(
                    kind,
                    f"{kind}: {len(i)} entries",
                    "column",
                    "- row",
                    {"": (j.tolist(), (-i).tolist())},
                    log="",
                    marked=frozenset({""}),
                )
            )
    remark = (
        "Whether the x that a problem is made from breaks y >= 0, by how much at most, and "
        "how many unknowns the solution holds at 0."
    )
    columns = [
        "problems",
        "planted x infeasible",
        "most negative y",
        "held in the solution (mean of 10)",
    ]
    results.tables.append(RecordTable("Planted solutions", columns, rows, remark))
    results.charts.append(
        Panels("c1-patterns", "Figure C.1: entries of the first 60 rows and columns", panels, 4)
    )


def _states(results: Results, problems: dict[str, list[Problem]], options: Options) -> None:
    """Make tables C.1 and C.2, and figure C.2 from the first problem of each kind."""
    rows, panels = list[list[str]](), list[RecordLines]()
    for kind, of_kind in problems.items():
        outcomes = dict[str, BookOutcome]()
        for method, (solver, merit) in METHODS.items():
            options.say(f"book: {kind}, {method}")
            try:
                outcomes[method] = outcome(
                    f"{kind}: {method}", of_kind, solver, merit, options.device
                )
            except ValueError as error:
                options.say(f"refused: {error}")
                continue
            results.records.append(outcomes[method].record())
            results.records[-1].figures["rate"] = Figure(rate := _rate(outcomes[method]))
            rows.append(
                [
                    kind,
                    method,
                    *outcomes[method].row(),
                    f"{rate:.3g}",
                    PUBLISHED.get(f"{kind}: {method}", ""),
                ]
            )
        if kind in COMPARED:
            curves = {
                name: _curve(o.traces[0].residuals[: SHOWN + 1]) for name, o in outcomes.items()
            }
            panels.append(RecordLines(kind, kind, "iterations", UNIT, curves, log="y"))
    remark = (
        "Book's test: states and iterations by Num4LCP's rules (relative 1e-6, absolute 1e-3, at "
        "most 100) on the merit or, for sweeps, "
        "on x'|y|. Residual there: the largest natural residual where that test ended a solve, "
        "over the one of x = 0. Solved: natural "
        f"residual below {RTOL:g} of that within 100 steps. Rate: the factor by which the residual "
        "falls in the step that takes it below "
        f"{NEAR:g}, or in the last one (median). Names with () are the library's methods as they "
        "come."
    )
    columns = [
        "problems",
        "method",
        "book's test",
        "iterations",
        "residual there",
        "solved",
        "steps",
        "rate",
        "[Book] C.1, C.2",
    ]
    results.tables.append(
        RecordTable("Tables C.1 and C.2: final states and iterations", columns, rows, remark)
    )
    results.charts.append(
        Panels(
            "c2-convergence",
            "Figure C.2: convergence, the book's problems (left) and planted ones",
            panels,
        )
    )


def _rate(of_method: BookOutcome) -> float:
    """Return the median factor by which the residual falls in a late step.

    The step is the one that takes the residual below NEAR, or the last one.
    """
    factors = []
    for trace in of_method.traces:
        last = next(
            (k for k, r in enumerate(trace.residuals) if r <= NEAR), len(trace.residuals) - 1
        )
        if last > 0:
            factors.append(trace.residuals[last - 1] / max(trace.residuals[last], 1e-16))
    return statistics.median(factors) if factors else 1.0


def _curve(residuals: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return iterations and residuals that a logarithmic axis can show."""
    points = [(float(k), r) for k, r in enumerate(residuals) if r > 0]
    return [k for k, _ in points], [r for _, r in points]


def _kinks(results: Results, problems: dict[str, list[Problem]], options: Options) -> None:
    """Compare derivatives of the Fischer map at a kink, in the book's loop (fig. C.3)."""
    rows, panels = list[list[str]](), list[RecordLines]()
    for kind, few in problems.items():
        row, curves = [kind], {}
        for kink, solver in KINKS.items():
            options.say(f"book: kinks, {kind}, {kink}")
            found = outcome(f"kinks: {kind}: {kink}", few, solver, Merit.FISCHER, options.device)
            results.records.append(found.record())
            row.append(found.share)
            curves[kink] = _curve(found.traces[0].residuals[: SHOWN + 1])
        rows.append(row)
        panels.append(RecordLines(kind, kind, "iterations", UNIT, curves, log="y"))
    remark = (
        f"Problems solved to {RTOL:g} within 100 steps, and the mean of their steps, of the "
        "book's Fischer-Newton."
    )
    results.tables.append(
        RecordTable("Figure C.3: strategies at kinks", ["problems", *KINKS], rows, remark)
    )
    results.charts.append(
        Panels(
            "c3-kinks", "Figure C.3: strategies at kinks, the first problem of each kind", panels
        )
    )


def _lambda(results: Results, problems: dict[str, list[Problem]], options: Options) -> None:
    """Vary lambda of the penalized Fischer map.

    The method runs with the book's loop, and with the safeguards of this library.
    """
    rows = list[list[str]]()
    solved, steps = (
        dict[str, tuple[Sequence[float], list[float]]](),
        dict[str, tuple[list[float], list[float]]](),
    )
    for kind, few in list(problems.items())[1:]:
        for label, solver in (
            ("book's loop", FISCHER),
            ("safeguarded", wl.FischerNewton(monotone_cycles=0)),
        ):
            options.say(f"book: lambda, {kind}, {label}")
            row, name = [kind, label], f"{kind}, {label}"
            for share in SHARES:
                solves = outcome(
                    f"lambda: {name}: {share:g}",
                    few,
                    replace(solver, fischer_weight=share),
                    Merit.FISCHER,
                    options.device,
                )
                results.records.append(solves.record())
                row.append(solves.share)
                solved.setdefault(name, (SHARES, []))[1].append(100 * len(solves.solved) / len(few))
                if solves.solved:
                    steps.setdefault(name, ([], []))[0].append(share)
                    steps[name][1].append(statistics.fmean(solves.solved))
            rows.append(row)
    remark = (
        f"Problems solved to {RTOL:g} within 100 steps, and the mean of their steps. 1 is the "
        "plain Fischer map."
    )
    panels = [
        RecordLines("solved", "solved", "lambda", "%", solved, log=""),
        RecordLines("steps", "steps of those", "lambda", "steps", steps, log=""),
    ]
    title = "Lambda of the penalized Fischer map"
    results.tables.append(RecordTable(title, ["problems", "loop", *map(str, SHARES)], rows, remark))
    results.charts.append(Panels("lambda", title, panels))


def _omega(
    results: Results, problems: dict[str, Problem], scale: ProblemScale, options: Options
) -> None:
    """Vary the relaxation factor of PSOR (figure C.4)."""
    problems = problems | {
        f"splash {n}^3, p >= 0": splash(n).named("everywhere", device=options.device)
        for n in (2 * scale.side, 4 * scale.side)
    }
    stopping = wl.StoppingCriteria(rtol=RTOL, max_iterations=SWEEPS, patience=SWEEPS)
    rows, curves = list[list[str]](), dict[str, tuple[list[float], list[float]]]()
    for label, problem in problems.items():
        options.say(f"book: omega, {label}")
        lcp, done = problem.lcp(device=options.device), dict[float, int]()
        for omega in FACTORS:
            result = wl.solve(lcp, wl.ProjectedSOR(omega=omega), stopping=stopping)
            if result:
                done[omega] = result.iterations
        best = min(done, key=lambda omega: done[omega], default=0.0)
        figures = {f"sweeps at {omega:g}": Figure(sweeps) for omega, sweeps in done.items()} | {
            "best": Figure(best)
        }
        results.records.append(BenchmarkRecord(f"omega: {label}", figures))
        rows.append(
            [label, f"{best:g}", *(str(done.get(omega, f"> {SWEEPS}")) for omega in FACTORS)]
        )
        curves[label] = [*done], [float(sweeps) for sweeps in done.values()]
    remark = "Matrices are swept row by row, grids red-black."
    title = f"Figure C.4: relaxation factors of PSOR, sweeps to {RTOL:g}"
    results.tables.append(
        RecordTable(title, ["problem", "best", *(f"{w:g}" for w in FACTORS)], rows, remark)
    )
    results.charts.append(RecordLines("c4-omega", title, "omega", "sweeps", curves, log="y"))
