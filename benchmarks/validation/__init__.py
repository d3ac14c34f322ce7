"""Physical checks of liquids, sand and bodies against known results.

`warp-lcp bench validation` runs them all. Each check is a file. It states what must hold, at two
resolutions, and has negative controls: set-ups that are wrong on purpose and must fail it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import Chart, RecordTable, Results
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.benchmarks.validation import (
    coiling,
    dam_break,
    flight,
    floating,
    folding,
    inclined,
    rest,
    sand_collapse,
    sand_heap,
    sand_hourglass,
    sand_silo,
    time_steps,
    transfers,
    viscous,
    walls,
)
from warp_lcp.benchmarks.validation.finding import ValidationTrial, table

TITLE = "Liquids, sand and rigid bodies against known answers"
CHECKS = {
    "transfers": transfers.CHECK,
    "flight": flight.THROWING,
    "spin": flight.SPINNING,
    "time steps": time_steps.CHECK,
    "ceiling": walls.CEILING,
    "slope": walls.SLOPE,
    "dam break": dam_break.DAM_BREAK,
    "sloshing": rest.SLOSHING,
    "rest": rest.RESTING,
    "volume": dam_break.VOLUME,
    "floating": floating.CHECK,
    "viscous": viscous.CHECK,
    "buckling": coiling.BUCKLING,
    "coiling": coiling.COILING,
    "folding": folding.CHECK,
    "inclined layer": inclined.LAYERS,
    "sand collapse": sand_collapse.COLLAPSES,
    "sand hourglass": sand_hourglass.CHECK,
    "sand invariants": sand_collapse.INVARIANTS,
    "sand oblique": inclined.OBLIQUE,
    "sand rest": sand_collapse.RESTING,
    "sand silo": sand_silo.CHECK,
    "sand heap": sand_heap.CHECK,
}


def measure(options: Options, out: Path) -> Results:
    """Run all checks."""
    trials: dict[str, list[ValidationTrial]] = {}
    charts: list[Chart] = []
    for name, check in CHECKS.items():
        options.say(f"{name} ...")
        trials[name], drawn = check.run(options.device)
        passed = sum(t.passed for t in trials[name])
        options.say(
            f"{name}: {passed} of {len(trials[name])} as they must be, "
            f"{sum(t.seconds for t in trials[name]):.0f} s"
        )
        charts += [chart for chart in drawn if chart.curves]
    all_trials = [t for own in trials.values() for t in own]
    where = machine(options.device, elements=1 << 22, repeat=options.repeat)
    tables = [
        summary(trials),
        misses(trials),
        *(table(name, CHECKS[name].about.strip(), own) for name, own in trials.items()),
    ]
    return Results(
        [where, *(t.record() for t in all_trials)],
        tables,
        charts,
        [line for t in all_trials for line in t.failures()],
    )


def summary(trials: Mapping[str, Sequence[ValidationTrial]]) -> RecordTable:
    """Return a row for each check.

    The columns are figures within their bounds, and controls that fail theirs.
    """
    rows, sums = list[list[str]](), np.zeros(4, dtype=int)
    for name, own in trials.items():
        kinds = [
            [f.passed for t in own for f in t.findings if f.control is control]
            for control in (False, True)
        ]
        counts = [n for kind in kinds for n in (sum(kind), len(kind))]
        sums += counts
        verdict = "as it must be" if all(t.passed for t in own) else "not all as it must be"
        seconds = sum(t.seconds for t in own)
        rows.append(
            [
                name,
                f"{counts[0]} of {counts[1]}",
                f"{counts[2]} of {counts[3]}",
                f"{seconds:.1f}",
                verdict,
            ]
        )
    remark = (
        f"{sums[0]} of {sums[1]} figures keep their tolerance, and {sums[2]} of {sums[3]} negative "
        "controls fail theirs, as they must; "
        f"{sum(t.seconds for own in trials.values() for t in own):.0f} s in all. A negative "
        "control is a set-up that is wrong on "
        "purpose: a check that it passes would prove nothing."
    )
    return RecordTable(
        "Checks",
        ["check", "within tolerance", "controls that fail", "seconds", "verdict"],
        rows,
        remark,
    )


def misses(trials: Mapping[str, Sequence[ValidationTrial]]) -> RecordTable:
    """Return the failures, and why known ones occur."""
    rows = [
        [line, CHECKS[name].known]
        for name, own in trials.items()
        for t in own
        for line in t.failures()
    ]
    return RecordTable("Not as it must be", ["figure", "known"], rows)
