"""Physical checks of liquids, sand and bodies with known answers, each with set-ups that are wrong on purpose and must fail it.

`warp-lcp bench validation` runs them all. A check is a file: what must hold, at two resolutions, with its negative controls.
"""

from __future__ import annotations

import inspect
from pathlib import Path

from warp_lcp.benchmarks.machine import machine
from warp_lcp.benchmarks.record import Results
from warp_lcp.benchmarks.timing import Options
from warp_lcp.benchmarks.validation import (
    ceiling,
    dam_break,
    flight,
    floating,
    inclined,
    rest,
    sand_collapse,
    sand_heap,
    sand_hourglass,
    sand_invariants,
    sand_oblique,
    sand_rest,
    sand_silo,
    slope,
    sloshing,
    spin,
    time_steps,
    transfers,
    volume,
)
from warp_lcp.benchmarks.validation.finding import Trial, table
from warp_lcp.benchmarks.validation.html_page import Section, page

TITLE = "Liquids, sand and rigid bodies against known answers"
CHECKS = {
    "transfers": transfers,
    "flight": flight,
    "spin": spin,
    "time steps": time_steps,
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
    "sand oblique": sand_oblique,
    "sand rest": sand_rest,
    "sand silo": sand_silo,
    "sand heap": sand_heap,
}

KNOWN = {  # why a check is known not to hold everywhere; the report says so where it does not
    "inclined layer": "half a degree below the angle from which it runs a settled layer of 32 cells still moves, at .7 % of g t",
    "rest": "single particles that leave a tilted free surface run down above it, beyond 10 % of sqrt(g dx)",
    "sand collapse": "a = 0.5 with 20 cells, ten of height, runs 0.40 widths, with 40 cells 0.52; 10 to 30 % of tall ones' steps miss 1e-3",
    "sand hourglass": "deep sand that yields everywhere is solved to 2 to 5e-3 rho g dx, not 1e-3; at 30 degrees delta is 1.6 cells",
    "sand invariants": "of the steps at 40 cells 94.9 % reach 1e-3, one packs a cell to 1.11, one gains 1e-4 J/m",
    "sand rest": "columns of the box of Narain et al. run 2.25 widths, 7 % less than the experiments allow",
    "sand heap": "sand at rest holds up to asin k: heaps lie at 33 to 36 degrees where layers stop at 30, at 41 to 43 where at 40",
}


def measure(options: Options, out: Path) -> Results:
    """Run all checks."""
    sections: list[Section] = []
    for name, module in CHECKS.items():
        options.say(f"{name} ...")
        found, drawn = module.check(options.device)
        options.say(f"{name}: {sum(t.passed for t in found)} of {len(found)} as they must be, {sum(t.seconds for t in found):.0f} s")
        charts = [chart for chart in drawn if chart.curves]
        sections.append(Section(name, inspect.getdoc(module) or "", found, charts, KNOWN.get(name, "")))
    where = machine(options.device, elements=1 << 22, repeat=options.repeat)
    trials: list[Trial] = [t for s in sections for t in s.trials]
    records = [where, *(t.record() for t in trials)]
    failures = [line for t in trials for line in t.failures()]
    charts = [chart for s in sections for chart in s.charts]
    return Results(records, [table(trials)], charts, failures, page=page(TITLE, where, sections))
