"""Command that solves and judges hostile inputs.

Run `python -m warp_lcp.benchmarks.hostile --seed N --count N [--kinds ...] [--out DIR]`. Each kind
has a worker process. If it dies or exceeds the CPU time limit, only one case is lost.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

from warp_lcp.files import Tables

LIMIT = 60.0  # [s] limit of CPU time for a solve without max_seconds
GRACE = 15.0  # [s] from the limit until the worker is ended
WALL = 600.0  # [s] limit of wall time, for a busy machine
FAULTS = ("FALSE CONVERGED", "FALSE INFEASIBLE", "CRASH", "TIMEOUT", "EXCEPTION")
REMARKS = ("row hidden", "suspicious", "infeasible unproved", "not solved", "refused")
COLUMNS = ("solves", "converged", "infeasible right", "honest", "other method", *FAULTS, *REMARKS)


@dataclass(frozen=True)
class HostileOutcome:
    """Outcome of one case: pairs of category and reason, CPU seconds of its solve."""

    kind: str
    index: int
    name: str
    verdicts: list[list[str]]
    seconds: float


def main() -> None:
    """Run the requested kinds; print a table and the faults."""
    parser = argparse.ArgumentParser(
        prog="python -m warp_lcp.benchmarks.hostile", description=__doc__
    )
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument(
        "--count", type=int, default=78, help="cases of each kind; 78 make 1,014 solves"
    )
    parser.add_argument("--kinds", nargs="+", default=[], help="default: all")
    parser.add_argument("--index", type=int, help="solve only this case, in this process")
    parser.add_argument("--out", type=Path, help="folder for hostile.json and hostile.md")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)  # index of the first case
    arguments = parser.parse_args()
    if arguments.worker is not None:
        return _work(arguments.kinds[0], arguments.seed, range(arguments.worker, arguments.count))
    from warp_lcp.benchmarks.hostile import KINDS

    unknown = sorted(set(arguments.kinds) - set(KINDS))
    if unknown:
        parser.error(f"--kinds {' '.join(unknown)}: known are {', '.join(KINDS)}")
    if arguments.index is not None:
        return _work(
            arguments.kinds[0], arguments.seed, range(arguments.index, arguments.index + 1)
        )
    outcomes: list[HostileOutcome] = []
    for kind in arguments.kinds or KINDS:
        start = time.perf_counter()
        outcomes += supervise(kind, arguments.seed, arguments.count)
        _say(f"{kind}: {time.perf_counter() - start:.0f} s")
        if arguments.out:  # written after each kind, since a run may be interrupted
            arguments.out.mkdir(parents=True, exist_ok=True)
            (arguments.out / "hostile.md").write_text(report(outcomes, arguments.seed))
            (arguments.out / "hostile.json").write_text(
                json.dumps([asdict(o) for o in outcomes], indent=1)
            )
    sys.stdout.write(report(outcomes, arguments.seed))
    sys.exit(1 if any(c in FAULTS for o in outcomes for c, _ in o.verdicts) else 0)


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def _work(kind: str, seed: int, indices: range) -> None:
    """Solve cases in this process; print a line of JSON before and after each."""
    warnings.simplefilter("ignore")
    import warp

    warp.config.quiet = True
    from warp_lcp.benchmarks.hostile import attempt, draw_case, judge

    signal.signal(signal.SIGPROF, signal.SIG_DFL)  # ends the process in any library
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    for index in indices:
        case = draw_case(kind, seed, index)
        _write({"begin": index, "name": case.name})
        signal.setitimer(signal.ITIMER_PROF, LIMIT + GRACE)
        signal.setitimer(signal.ITIMER_REAL, WALL)  # a solve that waits uses no CPU time
        start = time.process_time()
        answer = attempt(case)
        seconds = time.process_time() - start
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
            signal.setitimer(timer, 0.0)
        verdicts = judge(case, answer)
        _write(
            {
                "end": index,
                "name": case.name,
                "status": answer.status,
                "seconds": seconds,
                "verdicts": verdicts,
            }
        )


def _write(record: Tables) -> None:
    sys.stdout.write("@" + json.dumps(record) + "\n")
    sys.stdout.flush()


def supervise(kind: str, seed: int, count: int) -> list[HostileOutcome]:
    """Run workers until all cases of a kind have an outcome."""
    environment = {
        "WARP_LCP_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        **os.environ,
    }
    outcomes: list[HostileOutcome] = []
    while len(outcomes) < count:
        first = len(outcomes)
        command = [
            sys.executable,
            "-m",
            "warp_lcp.benchmarks.hostile",
            "--worker",
            str(first),
            "--seed",
            str(seed),
            "--count",
            str(count),
        ]
        running_case = ""
        with (
            tempfile.TemporaryFile("w+") as messages,
            subprocess.Popen(
                [*command, "--kinds", kind],
                stdout=subprocess.PIPE,
                stderr=messages,
                text=True,
                env=environment,
            ) as worker,
        ):
            assert worker.stdout is not None
            for line in worker.stdout:
                if not line.startswith("@"):
                    continue
                record = json.loads(line[1:])
                if "begin" in record:
                    running_case = record["name"]
                    continue
                outcomes.append(
                    HostileOutcome(
                        kind, record["end"], record["name"], _late(record), record["seconds"]
                    )
                )
                _tell(outcomes[-1], seed)
            messages.seek(0)
            error_output = messages.read()
        if len(outcomes) < count:  # the worker has died
            category = (
                "TIMEOUT" if -worker.returncode in (signal.SIGPROF, signal.SIGALRM) else "CRASH"
            )
            why = (
                f"more than {LIMIT + GRACE:g} s"
                if category == "TIMEOUT"
                else f"exit {worker.returncode}: {error_output.strip()[-150:]}"
            )
            outcomes.append(
                HostileOutcome(
                    kind,
                    len(outcomes),
                    running_case,
                    [[category, why]],
                    LIMIT + GRACE if category == "TIMEOUT" else 0.0,
                )
            )
            _tell(outcomes[-1], seed)
    return outcomes


def _late(record: Tables) -> list[list[str]]:
    late = (
        [["TIMEOUT", f"{record['seconds']:.0f} s, {record['status']}"]]
        if record["seconds"] > LIMIT
        else []
    )
    return [*record["verdicts"], *late]


def _tell(outcome: HostileOutcome, seed: int) -> None:
    for line in fault_lines([outcome], seed, FAULTS):
        _say(line)


def fault_lines(
    outcomes: list[HostileOutcome], seed: int, categories: tuple[str, ...]
) -> list[str]:
    """Return a line for each verdict of the categories, with the command to repeat it."""
    return [
        f"{category}: --kinds {o.kind} --seed {seed} --index {o.index}: {o.name} ({o.seconds:.1f} "
        f"s): {' '.join(why.split())}"
        for o in outcomes
        for category, why in o.verdicts
        if category in categories
    ]


def report(outcomes: list[HostileOutcome], seed: int) -> str:
    """Return a page: a row for each kind, then the faults and remarks."""
    kinds = list(dict.fromkeys(o.kind for o in outcomes))
    lines = [
        f"# Hostile inputs, seed {seed}",
        "",
        f"| kind | {' | '.join(COLUMNS)} | slowest [s] |",
    ]
    lines.append("|---" * (len(COLUMNS) + 2) + "|")
    for kind in [*kinds, "all"]:
        chosen = [o for o in outcomes if kind in (o.kind, "all")]
        count = Counter(category for o in chosen for category, _ in o.verdicts)
        cells = [str(len(chosen)), *(str(count[column] or "") for column in COLUMNS[1:])]
        lines.append(
            f"| {kind} | " + " | ".join(cells) + f" | {max(o.seconds for o in chosen):.1f} |"
        )
    for title, categories in (("Faults", FAULTS), ("Remarks", REMARKS)):
        found = fault_lines(outcomes, seed, categories)
        lines += ["", f"## {title}: {len(found)}", "", *(f"- {line}" for line in found)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
