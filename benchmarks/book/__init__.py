"""The experiments of [Book] appendix C, again: `warp-lcp bench solvers --suite book`."""

from __future__ import annotations

from pathlib import Path

from warp_lcp.benchmarks.book import convergence, robustness, sizes, starts
from warp_lcp.benchmarks.book.claims import claims
from warp_lcp.benchmarks.book.problems import Scale
from warp_lcp.benchmarks.machine import COPIED, machine
from warp_lcp.benchmarks.record import Results
from warp_lcp.benchmarks.timing import Options

TITLE = "The book's experiments"


def measure(options: Options, out: Path) -> Results:
    """Make all experiments."""
    scale = Scale.of(options)
    where = machine(options.device, elements=min(COPIED, 64 * max(scale.sizes) ** 3), repeat=options.repeat)
    parts = [part.measure(scale, options.device, options.say) for part in (sizes, convergence, robustness, starts)]
    records = [r for p in parts for r in p.records]
    return Results(
        [where, *records],
        [claims(records), *(t for p in parts for t in p.tables)],
        [c for p in parts for c in p.charts],
        sheets=[s for p in parts for s in p.sheets],
    )
