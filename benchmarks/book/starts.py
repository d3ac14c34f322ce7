"""Newton methods from zero and from ten sweeps ([Book] fig. C.6), and on semi-definite problems: overdetermined systems."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.optimize

import warp_lcp as wl
from warp_lcp.benchmarks.book.problems import SEED, Scale, definite_matrix, properly, recipe
from warp_lcp.benchmarks.book.robustness import FISCHER, MINIMUM_MAP
from warp_lcp.benchmarks.book.traces import Merit, counted, follow, judge, spread
from warp_lcp.benchmarks.record import Bars, Chart, Lines, Record, Results, Sheet, Table
from warp_lcp.benchmarks.timing import Figure
from warp_lcp.gallery import Problem

PGS_SWEEPS = 10
SHARES = (0.0, 0.2, 0.4, 0.6, 0.8)
RULES: dict[str, Callable[[Any, np.random.Generator, str], Problem]] = {"recipe": recipe, "planted": properly}
NEWTON: dict[str, tuple[Any, Merit]] = {
    "Fischer-Newton, book": (FISCHER, Merit.FISCHER),
    "minimum map, book": (MINIMUM_MAP, Merit.MINIMUM),
}


def measure(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Make both experiments."""
    parts = [_warm(scale, device, say), _overdetermined(scale, device, say)]
    return Results(
        [r for p in parts for r in p.records],
        [t for p in parts for t in p.tables],
        [c for p in parts for c in p.charts],
        sheets=[s for p in parts for s in p.sheets],
    )


def _dense(rule: str, scale: Scale, k: int, zeros: float = 0.0) -> Problem:
    rng = np.random.default_rng([SEED + 2, k, int(1000 * zeros)])
    return RULES[rule](definite_matrix(scale.dense, rng, zeros), rng, f"{rule} {k}")


def _warm(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Count iterations to the book's tolerances without and with sweeps first."""
    say("book: warm starting")
    counts: dict[tuple[str, str, str], list[int]] = {}
    rows = []
    for rule in RULES:
        for k in range(scale.problems):
            problem = _dense(rule, scale, k)
            lcp = problem.lcp(device=device)
            sweeps = wl.StoppingCriteria(rtol=0.0, max_iterations=PGS_SWEEPS)
            start = wl.solve(lcp, wl.ProjectedSOR(omega=1.0), stopping=sweeps).x.numpy()
            for name, (solver, merit) in NEWTON.items():
                for label, x0 in (("cold", None), ("warm", start)):
                    trace = follow(problem, solver, merit, device=device, max_iterations=30, x0=x0)
                    verdict = judge(trace, merit, rtol=1e-6, atol=1e-2, most=30)
                    counts.setdefault((rule, name, label), []).append(verdict.iterations)
                    rows.append([rule, str(k), name, label, verdict.state, str(verdict.iterations)])
    records, cells = [], []
    for (rule, name, label), found in counts.items():
        records.append(Record(f"warm starting: {rule}: {name}: {label}", {"iterations": Figure(statistics.fmean(found))}))
        cells.append([rule, name, label, spread(found), ", ".join(f"{n} at {k}" for k, n in sorted(Counter(found).items()))])
    remark = (
        f"{scale.problems} dense positive definite problems of {scale.dense} unknowns, eigenvalues evenly spaced in "
        f"(0, 1]; from x = 0, and "
        f"from {PGS_SWEEPS} sweeps of PGS. Relative 1e-6, absolute 1e-2, at most 30 iterations, counted as Num4LCP does: the first test is "
        "number 1, so a start that is good enough counts 1. Num4LCP's rule leaves nearly no active unknowns here either."
    )
    columns = ["b", "method", "start", "iterations", "problems of a count"]
    shown = {
        f"{name}, {label}: {k}": float(n)
        for (rule, name, label), found in counts.items()
        if rule == "planted"
        for k, n in sorted(Counter(found).items())
    }
    charts: list[Chart] = [Bars("warm", f"Iterations from zero (cold) and from {PGS_SWEEPS} sweeps (warm), planted", "problems", shown)]
    sheet = Sheet("warm", ["b", "number", "method", "start", "state", "iterations"], rows)
    return Results(records, [Table("Warm starting (fig. C.6)", columns, cells, remark)], charts, sheets=[sheet])


def _feasible(problem: Problem) -> bool:
    """Return whether some x >= 0 has A x + b >= 0, which for a positive semi-definite A makes the LCP solvable."""
    n = len(problem.b)
    return bool(scipy.optimize.linprog(np.zeros(n), A_ub=-problem.A, b_ub=problem.b, bounds=(0, None), method="highs").status == 0)


def _overdetermined(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Solve problems with more and more zero eigenvalues."""
    methods: dict[str, tuple[Any, Merit]] = {
        "Fischer-Newton, approximation": (replace(FISCHER, kink="approximation"), Merit.FISCHER),
        "minimum map, book": (MINIMUM_MAP, Merit.MINIMUM),
        "PGS": (wl.ProjectedSOR(omega=1.0), Merit.PRODUCT),
        "PSOR 1.4": (wl.ProjectedSOR(omega=1.4), Merit.PRODUCT),
        "FischerNewton()": (wl.FischerNewton(), Merit.FISCHER),
    }
    records, rows, cells = list[Record](), list[list[str]](), list[list[str]]()
    curves: dict[str, tuple[list[float], list[float]]] = {}
    few = max(1, scale.problems // 10)
    for rule in RULES:
        for zeros in SHARES:
            say(f"book: overdetermined, {rule}, {zeros:.0%} zero eigenvalues")
            problems = [_dense(rule, scale, k, zeros) for k in range(few)]
            solvable = sum(_feasible(p) for p in problems)
            records.append(Record(f"overdetermined: {rule}: {zeros:.0%}: solvable", {"problems": Figure(solvable)}))
            for name, (solver, merit) in methods.items():
                traces = [follow(p, solver, merit, device=device) for p in problems]
                verdicts = [judge(t, merit, rtol=1e-4, atol=1e-2) for t in traces]
                solved = [float(t.solved) for t in traces if t.solved is not None]
                states = counted([v.state for v in verdicts])
                worst = max(v.residual for v in verdicts)
                facts = {"states": states, "steps spread": spread(solved)}
                label = f"overdetermined: {rule}: {zeros:.0%}: {name}"
                records.append(Record(label, {"solved": Figure(len(solved)), "problems": Figure(few), "residual": Figure(worst)}, facts))
                cells.append(
                    [rule, f"{zeros:.0%}", str(solvable), name, states, f"{worst:.1e}", f"{len(solved)} of {few}", facts["steps spread"]]
                )
                for k, (t, v) in enumerate(zip(traces, verdicts, strict=True)):
                    steps = "" if t.solved is None else str(t.solved)
                    rows.append([rule, f"{zeros:g}", str(k), name, v.state, str(v.iterations), f"{v.residual:.1e}", steps, t.status.name])
                if rule == "planted":
                    curve = curves.setdefault(name, ([], []))
                    curve[0].append(zeros)
                    curve[1].append(100 * len(solved) / few)
    remark = (
        f"{few} dense positive semi-definite problems of {scale.dense} unknowns for each share of zero eigenvalues. "
        "Book's test: relative 1e-4, absolute 1e-2, at most 100. Solvable: a linear program finds x >= 0 with A x + b >= 0, which is "
        "enough where A is positive semi-definite. Planted problems are; Num4LCP's x is no solution, and nothing sees to it that its "
        "problems have another one: with many zero eigenvalues they have none, so that where the "
        "book's Newton methods 'get into trouble' it is the problem that has no solution."
    )
    columns = ["b", "zero eigenvalues", "solvable", "method", "book's test", "residual there", "to 1e-6", "steps"]
    charts: list[Chart] = [
        Lines("zeros", "Semi-definite problems solved to 1e-6 in 100 steps (planted)", "zero eigenvalues", "%", curves, False, False)
    ]
    sheet = Sheet("zeros", ["b", "zeros", "number", "method", "state", "iterations", "residual there", "steps to 1e-6", "status"], rows)
    return Results(records, [Table("Overdetermined systems", columns, cells, remark)], charts, sheets=[sheet])
