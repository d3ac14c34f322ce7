"""Physical checks of liquids and sand with known answers, each with set-ups that are wrong on purpose and must fail it.

`warp-lcp bench validation` runs them all. A check is a file: what must hold, at two resolutions, with its negative controls.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.machine import machine
from benchmarks.record import Results
from benchmarks.timing import Options
from benchmarks.validation import (
    ceiling,
    dam_break,
    floating,
    inclined,
    rest,
    sand_collapse,
    sand_hourglass,
    sand_invariants,
    sand_rest,
    slope,
    sloshing,
    transfers,
    volume,
)
from benchmarks.validation.finding import Trial, table

TITLE = "Liquids and sand against known answers"
CHECKS = {
    "transfers": transfers,
    "ceiling": ceiling,
    "slope": slope,
    "dam break": dam_break,
    "sloshing": sloshing,
    "rest": rest,
    "volume": volume,
    "floating": floating,
    "inclined layer": inclined,
    "sand collapse": sand_collapse,
    "sand hourglass": sand_hourglass,
    "sand invariants": sand_invariants,
    "sand rest": sand_rest,
}


def measure(options: Options, out: Path) -> Results:
    """Run all checks."""
    trials: list[Trial] = []
    charts = []
    for name, module in CHECKS.items():
        options.say(f"{name} ...")
        found, drawn = module.check(options.device)
        options.say(f"{name}: {sum(t.passed for t in found)} of {len(found)} as they must be, {sum(t.seconds for t in found):.0f} s")
        trials += found
        charts += [chart for chart in drawn if chart.curves]
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat), *(t.record() for t in trials)]
    failures = [line for t in trials for line in t.failures()]
    return Results(records, [table(trials)], charts, failures)
