"""Suite `extremes`: hostile cases with a fixed expected outcome.

NumPy and SciPy judge the results in float64. `warp-lcp bench extremes` runs all cases. A case is
solved to its tolerance, refused before the start with a message that names the argument, or stopped
with a status that says why. Some solvers are wrong on purpose: the checks must catch each of them.
Random problems come last, new ones in each run.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from random import SystemRandom

from warp_lcp.benchmarks.extremes import (
    bounds,
    coefficients,
    matrices,
    rejected_input,
    shapes,
    simulations,
    wrong_methods,
)
from warp_lcp.benchmarks.extremes.case import (
    PRECISIONS,
    REFUSED,
    ExtremeCase,
    ExtremeVerdict,
    OutcomeKind,
    judge,
)
from warp_lcp.benchmarks.extremes.unseen import FRESH, judging
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordTable, Results, shown
from warp_lcp.benchmarks.harness.timing import Figure, Options

ORDINARY = ("CONVERGED", REFUSED, "done")  # statuses that the report does not list by case
TITLE = "Extremes: hostile problems and scenes, and what they come to"
FAMILIES = (
    shapes.sizes,
    shapes.masks,
    shapes.closed_pools,
    coefficients.slivers,
    coefficients.contrasts,
    coefficients.bodies,
    bounds.scales,
    bounds.degenerate,
    bounds.tolerances,
    matrices.singular,
    matrices.cycling,
    rejected_input.wrong_arguments,
    simulations.steps_and_forces,
    simulations.solids_and_depth,
    simulations.particles_anywhere,
    wrong_methods.wrong_solvers,
)


def cases(seed: int) -> Iterator[ExtremeCase]:
    """Yield all cases, family by family.

    Args:
        seed: first seed of the random problems.

    Raises:
        ValueError: two cases share a name.
    """
    seen = set[tuple[str, str]]()
    for case in chain(*(family() for family in FAMILIES), judging.cases(seed)):
        if (case.family, case.name) in seen:
            raise ValueError(f"two cases are called {case.family}: {case.name}")
        seen.add((case.family, case.name))
        yield case


def measure(options: Options, out: Path) -> Results:
    """Run every case in each of its precisions."""
    verdicts, family = list[ExtremeVerdict](), ""
    seed = SystemRandom().choice(FRESH) if options.seed is None else options.seed
    for case in cases(seed):
        if case.family != family:
            family = case.family
            options.say(
                f"{family} ..." + (f" seeds from {seed} on" if family in judging.FAMILIES else "")
            )
        for precision in case.precisions:
            verdicts.append(judge(case, precision, options.device))
            if verdicts[-1].wrong:
                options.say(f"{verdicts[-1].name}: {verdicts[-1].outcome}")
    family_records = by_family(verdicts)
    unseen, beyond = judging.summary(verdicts, seed)
    wrong = [v for v in verdicts if v.wrong]
    records = [
        machine(options.device, elements=1 << 22, repeat=options.repeat),
        *family_records,
        *map(record, wrong),
    ]
    failures = [f"{v.name}: {v.outcome} (expected: {v.promise})" for v in wrong] + beyond
    return Results(records, [families(family_records), unseen, table(verdicts)], failures=failures)


def record(verdict: ExtremeVerdict) -> BenchmarkRecord:
    """Return the record of a failed case."""
    attempt, case = verdict.attempt, verdict.case
    facts = {
        "family": case.family,
        "precision": verdict.precision,
        "expected": str(verdict.promise),
        "outcome": verdict.outcome,
    }
    more = {
        "status": attempt.status,
        "residual": attempt.residual,
        "message": attempt.message,
        **attempt.facts,
    }
    return BenchmarkRecord(verdict.name, {"seconds": Figure(attempt.seconds, "s")}, facts | more)


def by_family(verdicts: Sequence[ExtremeVerdict]) -> list[BenchmarkRecord]:
    """Return the number of passed cases of each family."""
    records = []
    for family in dict.fromkeys(v.case.family for v in verdicts):
        family_verdicts = [v for v in verdicts if v.case.family == family]
        counts = {
            "cases": len({v.case.name for v in family_verdicts}),
            "attempts": len(family_verdicts),
            "wrong": sum(bool(v.wrong) for v in family_verdicts),
        }
        counts |= {
            kind.value: n
            for kind in OutcomeKind
            if (n := sum(v.promise.expected is kind for v in family_verdicts))
        }
        seconds = [v.attempt.seconds for v in family_verdicts]
        figures = {name: Figure(count) for name, count in counts.items()}
        records.append(
            BenchmarkRecord(
                family,
                figures
                | {"slowest": Figure(max(seconds), "s"), "seconds": Figure(sum(seconds), "s")},
            )
        )
    return records


def families(records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return the families' records as a table."""
    rows = []
    for r in records:
        kinds = ", ".join(
            f"{figure.value:.0f} {kind.value}"
            for kind in OutcomeKind
            if (figure := r.figures.get(kind.value))
        )
        rows.append(
            [
                r.name,
                *shown(r, ("cases", "attempts"), ".0f"),
                kinds,
                *shown(r, ["wrong"], ".0f"),
                *shown(r, ["slowest"], ".2f"),
            ]
        )
    cases, attempts, wrong, seconds = (
        sum(r.value(f) or 0 for r in records) for f in ("cases", "attempts", "wrong", "seconds")
    )
    remark = (
        f"{cases:.0f} cases, {attempts:.0f} attempts in {seconds:.0f} s, {wrong:.0f} not as "
        "they must be."
    )
    return RecordTable(
        "Families",
        ("family", "cases", "attempts", "expected", "not as they must be", "slowest [s]"),
        rows,
        remark,
    )


def table(verdicts: Sequence[ExtremeVerdict]) -> RecordTable:
    """Return a row for each noteworthy case.

    A row has status, relative residual and seconds in each precision.

    A case is noteworthy if a verdict is wrong, a solve stops before its tolerance, or it takes a
    second or more. Random problems are listed only if a verdict is wrong.
    """
    by_case = defaultdict[tuple[str, str], list[ExtremeVerdict]](list)
    for v in (v for v in verdicts if v.wrong or v.case.family not in judging.FAMILIES):
        by_case[v.case.family, v.case.name].append(v)
    rows = []
    for name, case_verdicts in by_case.items():
        if all(
            v.attempt.status in ORDINARY and v.attempt.seconds < 1.0 and not v.wrong
            for v in case_verdicts
        ):
            continue
        cells = {
            v.precision: f"{v.attempt.status}{v.attempt.at}, {v.attempt.seconds:.2g} s"
            for v in case_verdicts
        }
        wrong = "; ".join(f"{v.precision}: {v.outcome}" for v in case_verdicts if v.wrong)
        expected = "; ".join(dict.fromkeys(str(v.promise) for v in case_verdicts))
        rows.append([*name, expected, *(cells.get(p, "-") for p in PRECISIONS), wrong or "yes"])
    remark = (
        "Cases that are wrong, stop before their tolerance, or take a second or more: status, "
        "residual relative to that of "
        "clip(0, l, u) (computed by NumPy and SciPy from cells and faces), seconds."
    )
    return RecordTable(
        "Noteworthy cases",
        ("family", "case", "expected", *PRECISIONS, "as it must be?"),
        rows,
        remark,
    )
