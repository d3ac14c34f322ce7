"""Robustness over many problems: final states and iterations beside the book's tables C.1 and C.2, and what is behind them."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

import warp_lcp as wl
from warp_lcp.benchmarks.book.problems import Scale, contacts, fluids
from warp_lcp.benchmarks.book.traces import Merit, Trace, Verdict, counted, follow, judge, spread
from warp_lcp.benchmarks.record import Record, Results, Sheet, Table
from warp_lcp.benchmarks.timing import Figure
from warp_lcp.gallery import Problem

# the book's methods: no search with a memory, no cycles first, linear systems solved
FISCHER = wl.FischerNewton(share=1.0, safeguard=False, monotone_cycles=0, eta=1e-8)
PENALIZED = wl.FischerNewton(share=0.95, safeguard=False, monotone_cycles=0, eta=1e-8)
MINIMUM_MAP = wl.MinimumMapNewton(monotone_cycles=0, eta=1e-8, memory=1)
Method = tuple[Any, Merit]
FLUID_METHODS: dict[str, Method] = {
    "Fischer-Newton, book": (FISCHER, Merit.FISCHER),
    "minimum map, book": (MINIMUM_MAP, Merit.MINIMUM),
    "PGS": (wl.ProjectedSOR(omega=1.0), Merit.PRODUCT),
    "PSOR 1.4": (wl.ProjectedSOR(omega=1.4), Merit.PRODUCT),
    "FischerNewton()": (wl.FischerNewton(), Merit.FISCHER),
    "MinimumMapNewton()": (wl.MinimumMapNewton(), Merit.MINIMUM),
    "InteriorPoint()": (wl.InteriorPoint(), Merit.MINIMUM),
    "MPRGP()": (wl.MPRGP(), Merit.MINIMUM),
}
CONTACT_METHODS: dict[str, Method] = {
    "Fischer-Newton, book": (FISCHER, Merit.FISCHER),
    "Fischer-Newton, penalized": (PENALIZED, Merit.FISCHER),
    "minimum map, book": (MINIMUM_MAP, Merit.MINIMUM),
    "interior point, book": (wl.InteriorPoint(mehrotra=False), Merit.MINIMUM),
    "PGS": (wl.ProjectedSOR(omega=1.0), Merit.PRODUCT),
    "FischerNewton()": (wl.FischerNewton(), Merit.FISCHER),
    "InteriorPoint()": (wl.InteriorPoint(), Merit.MINIMUM),
    "Lemke()": (wl.Lemke(), Merit.MINIMUM),
}
# state and iterations: tables C.1 and C.2; Num4LCP run on GNU Octave, 100 problems each
PUBLISHED: dict[tuple[str, str], tuple[str, str]] = {
    ("fluid, recipe", "Fischer-Newton, book"): ("100 absolute, 5.00 (5 to 5, 0.00)", "100 absolute, 5.64 (5 to 6, 0.48)"),
    ("fluid, recipe", "minimum map, book"): ("100 absolute, 4.07 (3 to 5, 0.29)", "100 absolute, 3.53 (3 to 4, 0.50)"),
    ("fluid, recipe", "PGS"): ("100 absolute, 49.38 (9 to 83, 17.48)", "100 absolute, 46.6 (19 to 86)"),
    ("fluid, recipe", "PSOR 1.4"): ("100 absolute, 25.29 (16 to 35, 3.77)", "100 absolute, 24.7 (19 to 37)"),
    ("fluid, 7-point, planted", "Fischer-Newton, book"): ("", "6.00"),
    ("fluid, 7-point, planted", "minimum map, book"): ("", "4.90 (4 to 5)"),
    ("fluid, 7-point, planted", "PGS"): ("", "26.3 (23 to 31)"),
    ("fluid, 7-point, planted", "PSOR 1.4"): ("", "19.7 (19 to 20)"),
    ("contact, recipe", "Fischer-Newton, book"): ("100 absolute, 14.54 (9 to 26, 2.79)", "100 absolute, 10.40 (7 to 13, 1.39)"),
    ("contact, recipe", "Fischer-Newton, penalized"): ("", "100 absolute, 7.13 (6 to 14, 1.42)"),
    ("contact, recipe", "interior point, book"): ("", "100 absolute, 57.6 (56 to 60)"),
    ("contact, recipe", "minimum map, book"): ("100 non-descent", "100 non-descent"),
}
REMARKS = {
    "fluid, recipe": (
        "Num4LCP's problems. Its x is no solution: where x = 0 it sets b = 0, and y = A x is negative there, since A has no positive "
        "entries off its diagonal. The true solution has the share of active unknowns given below, almost none, so "
        "these are linear systems, and the matrix is a random banded one, no Poisson operator. Sweeps end by x'|y| < 1e-3, which says "
        "nothing about y < 0 where x = 0. A matrix is shifted only if it is not positive definite: one of the first hundred is left "
        "with eigenvalues from 0.002 to 1.8, too wide a range for 100 sweeps."
    ),
    "fluid, recipe's matrix, planted": (
        "The same matrices with a solution that is one, a quarter of it active. Active unknowns hold x fast all over the domain: sweeps "
        "need fewer iterations than without any, and Newton methods find the active set instead of having none to find."
    ),
    "fluid, 7-point, planted": (
        "The Poisson operator on 10^3 cells with x = 0 outside, a quarter active. The active cells are scattered, which is kind to sweeps; "
        "in liquids they lie together at walls, and sweeps need hundreds of iterations (see the relaxation factors)."
    ),
    "contact, recipe": (
        "Num4LCP's problems: blocks of a random positive definite matrix with the pattern of Stewart and Trinkle written over them. The "
        "book has no line for PGS. Its test x'|y| < 1e-3 accepts iterates whose natural residual is far from 0: y < 0 where x = 0 costs "
        "nothing there. Newton on the minimum map often leads nowhere: its steps do not descend (non-descent), or are cut until the merit "
        "no longer changes, which the book's relative test takes for an end; Num4LCP tests the descent first."
    ),
    "contact, recipe's matrix, planted": "The same matrices with a solution that is one, a quarter of it active, y = 0 on the others.",
    "contact, rigid bodies": "Impulses of random rigid bodies that touch: `warp_lcp.gallery.contact`. A = J M^-1 J' with its beta rows.",
}
GENERAL = (
    "Book's test: states and iterations by Num4LCP's rules (relative 1e-6, absolute 1e-3, at most 100), which test the merit or x'|y|. "
    "Residual there: the largest natural residual at that moment over the first one. To 1e-6: problems whose natural residual fell below "
    "1e-6 of the first one within 100 steps, and those steps. 'Book' methods have a monotone search and no cycles first; minimum map is "
    "called non-descent where its steps lead nowhere and the library's goes on by other means. Names with () are defaults. Why iterations "
    "differ from Num4LCP's: this library's Fischer map is of A_ii x and y, so that units do not matter, Num4LCP's of x and y. Programmed "
    "with dense matrices, the first takes 7, the second 6 iterations on the planted 7-point problems, 6 to 7 and 5 to 6 on the recipe's, "
    "8 to 11 and 10 to 11 on the recipe's contacts. Newton on the minimum map takes 4 there with exact steps; Num4LCP's are 20 "
    "iterations of GMRES."
)


def measure(scale: Scale, device: str, say: Callable[[str], object]) -> Results:
    """Solve all problems by all methods."""
    kinds = {**dict.fromkeys(fluids(scale).items(), FLUID_METHODS), **dict.fromkeys(contacts(scale).items(), CONTACT_METHODS)}
    records, tables, rows = list[Record](), list[Table](), list[list[str]]()
    for (kind, make), methods in kinds.items():
        say(f"book: robustness, {kind}, {scale.problems} problems")
        problems = [make(k) for k in range(scale.problems)]
        of_kind = []
        for name, (solver, merit) in methods.items():
            traces = [follow(p, solver, merit, device=device) for p in problems]
            verdicts = [judge(t, merit) for t in traces]
            of_kind.append(_record(kind, name, traces, verdicts))
            rows += [_row(kind, k, name, t, v) for k, (t, v) in enumerate(zip(traces, verdicts, strict=True))]
        records += of_kind
        tables.append(_table(kind, of_kind, _active(problems, device)))
    columns = ["problems", "number", "method", "state", "iterations", "residual there", "steps to 1e-6", "status", "last residual"]
    return Results(records, tables, [], sheets=[Sheet("robustness", columns, rows)])


def _active(problems: Sequence[Problem], device: str) -> float:
    """Return the mean share of unknowns at zero in the solutions."""
    shares = []
    for p in problems[:10]:
        solver = wl.FischerNewton()
        x = wl.solve(p.lcp(device=device), solver, stopping=wl.StoppingCriteria(rtol=1e-8)).x.numpy().ravel()
        y = p.A @ x + p.b
        shares.append(float((x < y).mean()))
    return statistics.fmean(shares)


def _row(kind: str, k: int, name: str, trace: Trace, verdict: Verdict) -> list[str]:
    solved = "" if trace.solved is None else str(trace.solved)
    last = f"{min(trace.residuals) / trace.residuals[0]:.1e}"
    return [kind, str(k), name, verdict.state, str(verdict.iterations), f"{verdict.residual:.1e}", solved, trace.status.name, last]


def _record(kind: str, name: str, traces: Sequence[Trace], verdicts: Sequence[Verdict]) -> Record:
    accepted = [v for v in verdicts if v.state in ("relative", "absolute")]
    solved = [float(t.solved) for t in traces if t.solved is not None]
    figures = {"solved": Figure(len(solved)), "problems": Figure(len(traces)), "accepted": Figure(len(accepted))}
    if accepted:
        figures["iterations"] = Figure(statistics.fmean(v.iterations for v in accepted))
    if solved:
        figures["steps"] = Figure(statistics.fmean(solved))
    figures["residual"] = Figure(max(v.residual for v in verdicts))
    facts = {
        "problems of": kind,
        "method": name,
        "states": counted([v.state for v in verdicts]),
        "iterations spread": spread([v.iterations for v in accepted]),
        "steps spread": spread(solved),
    }
    return Record(f"robustness: {kind}: {name}", figures, facts)


def _table(kind: str, records: Sequence[Record], active: float) -> Table:
    columns = ["method", "book's test", "iterations", "residual there", "to 1e-6", "steps", "[Book] C.1, C.2", "Num4LCP"]
    rows = []
    for r in records:
        published = PUBLISHED.get((kind, r.facts["method"]), ("", ""))
        solved = f"{r.value('solved'):.0f} of {r.value('problems'):.0f}"
        cells = [r.facts["method"], r.facts["states"], r.facts["iterations spread"], f"{r.value('residual'):.1e}", solved]
        rows.append([*cells, r.facts["steps spread"], *published])
    remark = (
        f"{REMARKS[kind]} Share of unknowns at zero in the solution: {active:.1%}. {GENERAL if kind == 'fluid, recipe' else ''}".rstrip()
    )
    return Table(f"Robustness: {kind}", columns, rows, remark)
