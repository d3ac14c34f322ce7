"""How good `wl.recommend` is: every method on random problems, and the time of the recommended one beside the best.

python -m benchmarks.recommendation measure train 0 4      seeds 0 ... 3 of every family, and 100 ... 108: what the rules were made from
python -m benchmarks.recommendation measure check 200 209  seeds that no rule has seen
python -m benchmarks.recommendation report                 the share of problems within 1.5 x of the best, CSV and Markdown
"""

from __future__ import annotations

import argparse
import csv
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import warp_lcp as wl
from warp_lcp import gallery
from warp_lcp.benchmarks.recommendation_problems import DEVICE, FAMILIES, make

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
        result = wl.solve(lcp, method, stopping=wl.StoppingCriteria(rtol=accuracy, **LIMITS), callback=watch)
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
    for n in range(1, 5):  # DirectEnumeration has a kernel for each
        timed(gallery.definite(n).lcp(device=DEVICE), wl.DirectEnumeration(), 1e-4, 0.3)
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
    write(path, rows)
    return True


@dataclass(frozen=True)
class Verdict:
    """A choice beside what was measured on a problem.

    Args:
        rows: of the problem, all methods.
        chosen: name of the recommended method.
        default: name of the method that `wl.solve` takes without a word.
        milliseconds: CPU time of the recommendation.
    """

    rows: tuple[Row, ...]
    chosen: str
    default: str
    milliseconds: float

    @property
    def best(self) -> Row | None:
        """The fastest row that converged, None if there is none."""
        return min((row for row in self.rows if row.outcome == "CONVERGED"), key=lambda row: row.milliseconds, default=None)

    def of(self, method: str) -> Row | None:
        """Return a method's row."""
        return next((row for row in self.rows if row.method == method), None)

    def near(self, method: str, noise: float = NOISE) -> bool:
        """Return whether a method is within WITHIN times the best, or no more than `noise` seconds slower."""
        row, best = self.of(method), self.best
        if row is None or best is None or row.outcome != "CONVERGED":
            return False
        return row.milliseconds <= max(WITHIN * best.milliseconds, best.milliseconds + 1e3 * noise)


def judge(rows: Sequence[Row]) -> list[Verdict]:
    """Ask for a recommendation for every measured problem."""
    names = {cls: name for name, cls in wl.METHODS.items()}
    problems: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        problems.setdefault((row.family, row.seed), []).append(row)
    verdicts = []
    for (family, seed), own in problems.items():
        _, lcp, accuracy = make(family, seed)
        begun = time.process_time()
        chosen = wl.recommend(lcp, accuracy=accuracy).name
        took = time.process_time() - begun
        verdicts.append(Verdict(tuple(own), chosen, names[type(wl.default_method(lcp))], round(1e3 * took, 3)))
    return verdicts


def report(train: Sequence[Verdict], check: Sequence[Verdict]) -> str:
    """Return the figures as Markdown."""
    lines = [
        "# How good `wl.recommend` is",
        "",
        "`python -m benchmarks.recommendation report`, from `recommendation-train.csv` and `recommendation-check.csv`: all methods of",
        "`wl.METHODS` with their default settings, CPU time of set-up and solve on one core of a shared, busy AMD EPYC, the median of",
        f"{REPEAT} in turns. A choice is right if it converges within {WITHIN} x the best method's time, or is no more than",
        f"{1e3 * NOISE:g} ms slower. Direct methods were not tried beyond 1000 unknowns. A recommendation's own time is not counted.",
        "",
        "| problems | all | solved | recommended right | without the allowance | where the best takes >= 5 ms | default right |",
        "|---|---|---|---|---|---|---|",
    ]
    for title, verdicts in (("rules made from", train), ("never seen", check)):
        able = [v for v in verdicts if v.best is not None]
        longer = [v for v in able if v.best is not None and v.best.milliseconds >= 5]
        shares = [
            _share(able, lambda v: v.near(v.chosen)),
            _share(able, lambda v: v.near(v.chosen, 0.0)),
            _share(longer, lambda v: v.near(v.chosen)),
            _share(able, lambda v: v.near(v.default)),
        ]
        lines.append(f"| {title} | {len(verdicts)} | {len(able)} | {' | '.join(shares)} |")
    able = [v for v in check if v.best is not None]
    failed = [sum(_converged(v, name(v)) is None for v in able) for name in (lambda v: v.chosen, lambda v: v.default)]
    counted = [(a + v.milliseconds) / b for v in able if (a := _converged(v, v.chosen)) and (b := _converged(v, v.default))]
    both = [(a, b) for v in able if (a := _converged(v, v.chosen)) and (b := _converged(v, v.default))]
    lines += [
        "",
        f"Of {len(able)} never seen problems that some method solves, {failed[0]} are not solved, or were cut off, by the recommended one",
        f"and {failed[1]} by the default. Where both solve, the recommended one takes {sum(a for a, _ in both):.0f} ms in all",
        f"and the default {sum(b for _, b in both):.0f} ms; the median of the ratio is {statistics.median(a / b for a, b in both):.2f}.",
        f"With the recommendation's own time counted it is {statistics.median(counted):.2f}: `wl.solve` keeps its default.",
        f"A recommendation takes {statistics.median(v.milliseconds for v in check):.1f} ms (median), at most",
        f"{max(v.milliseconds for v in check):.0f} ms; the best solves take",
        f"{statistics.median(v.best.milliseconds for v in able if v.best):.1f} ms (median).",
        "",
        "## By family, never seen",
        "",
        "| family | right | recommended |",
        "|---|---|---|",
    ]
    for family in FAMILIES:
        own = [v for v in able if v.rows[0].family == family]
        names = sorted({v.chosen for v in own})
        lines.append(f"| {family} | {sum(v.near(v.chosen) for v in own)} of {len(own)} | {', '.join(names)} |")
    lines += ["", "## Misses", "", "| problem | n | to | recommended | ms | best | ms |", "|---|---|---|---|---|---|---|"]
    for v in able:
        if not v.near(v.chosen) and v.best:
            row, mine = v.rows[0], v.of(v.chosen)
            took = "not tried" if mine is None else f"{mine.milliseconds:.1f}" if mine.outcome == "CONVERGED" else mine.outcome
            lines.append(
                f"| {row.name}, seed {row.seed} | {row.unknowns} | {row.accuracy:g} | {v.chosen} | {took} | {v.best.method} "
                f"| {v.best.milliseconds:.1f} |"
            )
    return "\n".join(lines) + "\n"


def _share(verdicts: Sequence[Verdict], right: Callable[[Verdict], bool]) -> str:
    count = sum(map(right, verdicts))
    return f"{count} of {len(verdicts)} ({count / max(len(verdicts), 1):.1%})"


def _converged(verdict: Verdict, method: str) -> float | None:
    row = verdict.of(method)
    return row.milliseconds if row is not None and row.outcome == "CONVERGED" else None


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
    actions.add_parser("report").add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if arguments.action == "report":
        found = [judge(read(arguments.out / f"recommendation-{name}.csv")) for name in ("train", "check")]
        text = report(found[0], found[1])
        (arguments.out / "recommendation.md").write_text(text, encoding="utf-8")
        print(text)
        return
    path = arguments.out / f"recommendation-{arguments.set}.csv"
    complete = measure_all(path, range(arguments.first, arguments.end), arguments.families, arguments.seconds)
    print(f"{path}: {len({(r.family, r.seed) for r in read(path)})} problems{'' if complete else ', not complete: call again'}")


if __name__ == "__main__":
    main()
