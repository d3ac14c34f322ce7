"""Benchmark process: measure one suite and write its files.

Run it as `python -m warp_lcp.benchmarks SUITE --device cpu --out DIR`; `warp-lcp bench` starts it.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import sys
from pathlib import Path

from warp_lcp.benchmarks.harness.timing import Options

SUITES = (
    "kernels",
    "solvers",
    "choose",
    "published",
    "scaling",
    "tank",
    "threads",
    "devices",
    "domains",
    "ranks",
    "peers",
    "sparse",
    "run",
    "host",
    "sand",
    "contacts",
    "book",
    "models",
    "tradeoff",
    "validation",
    "extremes",
)


def main() -> None:
    """Measure a suite and write its files."""
    parser = argparse.ArgumentParser(prog="python -m warp_lcp.benchmarks")
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, action="append", default=[])
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--scene", default="")
    parser.add_argument("--seed", type=int)
    arguments = parser.parse_args()
    suite, report = (
        importlib.import_module(f"warp_lcp.benchmarks.{arguments.suite}"),
        importlib.import_module("warp_lcp.benchmarks.harness.report"),
    )
    options = Options(
        arguments.device,
        tuple(arguments.size),
        arguments.repeat,
        lambda text: sys.stderr.write(f"{text}\n"),
        arguments.scene,
        arguments.seed,
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    gc.collect()
    # Imports create hundreds of thousands of objects. Frozen, they are skipped by searches for
    # arrays (`machine.array_bytes`).
    gc.freeze()
    try:
        results = suite.measure(options, arguments.out)
    except MemoryError as error:
        sys.exit(f"out of memory: {error}")
    for line in report.write(arguments.suite, suite.TITLE, results, arguments.out):
        options.say(line)
    for line in results.failures:
        options.say(f"check failed: {line}")
    if results.failures:
        sys.exit(1)


if __name__ == "__main__":
    main()
