"""Experiments of [Book] appendix C and figures 2.3, 2.10 and 2.12.

Each experiment runs twice, side by side: as the book states it, and corrected.
"""

from __future__ import annotations

from pathlib import Path

from warp_lcp.benchmarks.book import appendix_c, contact_scenes, studies
from warp_lcp.benchmarks.book.problems import ProblemScale
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import Results
from warp_lcp.benchmarks.harness.timing import Options

TITLE = "The book's experiments"


def measure(options: Options, out: Path) -> Results:
    """Run all experiments."""
    scale = ProblemScale.of(options)
    results = Results([machine(options.device, elements=1 << 22, repeat=options.repeat)], [])
    for part in (appendix_c, studies, contact_scenes):
        part.measure(results, scale, options)
    return results
