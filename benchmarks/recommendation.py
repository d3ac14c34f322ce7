"""How good `wl.recommend` is: every method on random problems, and the time of the recommended one beside the best.

python -m benchmarks.recommendation measure train 0 8     seeds 0 ... 7 of every family; what the rules were made from
python -m benchmarks.recommendation measure check 100 110  seeds that no rule has seen
python -m benchmarks.recommendation report                 the share of problems within 1.5 x of the best, CSV and Markdown
"""

from __future__ import annotations

import argparse
import csv
import statistics
import time
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import warp as wp

import warp_lcp as wl
from benchmarks.recommendation_problems import FAMILIES, make

RESULTS = Path(__file__).parent / "results" / "amd-epyc"
WITHIN = 1.5  # times the best measured method
NOISE = 0.5e-3  # [s]: differences that a shared machine does not resolve; a method is as good as the best if it is no more than this slower
REPEAT = 3
CUT, CUT_AFTER = 3.0, 15e-3  # a method that has taken this multiple of the best so far plus these seconds is stopped
LIMITS = {"max_iterations": 20000, "patience": 500}
# likely winners first: what they take is where slower ones are cut off
ORDER = (
    *("projected-multigrid", "minimum-map-newton", "primal-dual-active-set", "direct-enumeration", "subspace-minimization", "mprgp"),
    *("psor", "nncg", "fischer-newton", "interior-point", "accelerated-projected-gradient", "blocked-gauss-seidel", "quadratic-program"),
    *("lemke", "incremental-pivoting", "staggering", "projected-jacobi", "gradient-descent"),
)


class TooSlow(Exception):
    """Ends a solve that cannot be the best any more."""


@dataclass(frozen=True)
class Row:
    """What one method did on one problem.

    Args:
        family: of the problem.
        seed: of the problem.
        name: of the problem.
        unknowns: n.
        accuracy: relative residual asked for.
        method: name in METHODS.
        outcome: a status, "refused", or "cut" where it was stopped for being slow.
        milliseconds: CPU time of set-up and solve, the median of REPEAT; the first run's where it was far from the best.
        iterations: steps.
    """

    family: str
    seed: int
    name: str
    unknowns: int
    accuracy: float
    method: str
    outcome: str
    milliseconds: float
    iterations: int


def timed(lcp: wl.LCP, method: Any, accuracy: float, limit: float) -> tuple[str, float, int]:
    """Return how a solve with set-up ends, its CPU seconds and steps; it is cut off after `limit` seconds, at the next step's end."""
    begun = time.process_time()

    def watch(record: wl.Record) -> None:
        if time.process_time() - begun > limit:
            raise TooSlow

    try:
        result = wl.solve(lcp, method, stopping=wl.StoppingCriteria(rtol=accuracy, **LIMITS), callback=watch)  # type: ignore[arg-type]
    except TooSlow:
        return "cut", time.process_time() - begun, 0
    except ValueError:
        return "refused", time.process_time() - begun, 0
    return result.status.name, time.process_time() - begun, result.iterations


def measure(family: str, seed: int, methods: Sequence[str] = ORDER) -> list[Row]:
    """Return the rows of a problem: all methods once, those near the best REPEAT times more, in turns."""
    name, lcp, accuracy = make(family, seed)
    n = int(getattr(lcp.A, "unknowns", lcp.layout.size))
    best, found = 0.4, dict[str, tuple[str, float, int]]()
    for method in methods:
        size = getattr(wl.METHODS[method], "most_unknowns", None)
        if size is not None and n > min(size, 1000):
            continue  # pivots of O(n^2): minutes
        found[method] = timed(lcp, wl.METHODS[method](), accuracy, CUT * best + CUT_AFTER)
        if found[method][0] == "CONVERGED":
            best = min(best, found[method][1])
    near = [m for m, (outcome, seconds, _) in found.items() if outcome == "CONVERGED" and seconds <= 3 * best + 2e-3]
    samples = {m: list[float]() for m in near}
    for _ in range(REPEAT):
        for method in near:
            samples[method].append(timed(lcp, wl.METHODS[method](), accuracy, 10.0)[1])
    rows = []
    for method, (outcome, seconds, iterations) in found.items():
        took = statistics.median(samples[method]) if method in samples else seconds
        rows.append(Row(family, seed, name, n, accuracy, method, outcome, round(1e3 * took, 4), iterations))
    return rows


def read(path: Path) -> list[Row]:
    """Return the rows of a file, none if there is no file."""
    if not path.exists():
        return []
    kinds = {"str": str, "int": int, "float": float}
    with path.open(newline="", encoding="utf-8") as file:
        return [Row(**{f.name: kinds[str(f.type)](line[f.name]) for f in fields(Row)}) for line in csv.DictReader(file)]


def write(path: Path, rows: Iterable[Row]) -> None:
    """Write rows as a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([f.name for f in fields(Row)])
        writer.writerows(astuple(row) for row in rows)


def load_kernels() -> None:
    """Run every method on a small problem of each kind of operator, so that no kernel is compiled while the clock runs."""
    for family in ("tiny", "definite", "banded", "poisson-2d", "skewed", "sparse-unsymmetric", "scene-boxed", "bodies-in-liquid"):
        _, lcp, _ = make(family, 900)
        for method in ORDER:
            timed(lcp, wl.METHODS[method](), 1e-4, 0.3)


def measure_all(path: Path, seeds: range, families: Sequence[str], seconds: float) -> bool:
    """Measure what the file does not have yet, for so many seconds; returns whether all is there."""
    begun, rows = time.perf_counter(), read(path)
    done = {(row.family, row.seed) for row in rows}
    load_kernels()
    for seed in seeds:
        for family in families:
            if (family, seed) in done:
                continue
            if time.perf_counter() - begun > seconds:
                write(path, rows)
                return False
            rows += measure(family, seed)
    write(path, rows)
    return True


def main() -> None:
    """Measure, or report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    measuring = actions.add_parser("measure")
    measuring.add_argument("set", choices=("train", "check"))
    measuring.add_argument("first", type=int)
    measuring.add_argument("end", type=int)
    measuring.add_argument("--families", nargs="*", default=list(FAMILIES))
    measuring.add_argument("--seconds", type=float, default=1e9, help="stop after these; the next call goes on")
    measuring.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    path = arguments.out / f"recommendation-{arguments.set}.csv"
    complete = measure_all(path, range(arguments.first, arguments.end), arguments.families, arguments.seconds)
    print(f"{path}: {len({(r.family, r.seed) for r in read(path)})} problems{'' if complete else ', not complete: call again'}")


if __name__ == "__main__":
    main()
