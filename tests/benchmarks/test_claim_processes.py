"""Checks in processes: their order, statuses, and the time limit."""

import sys
import time
from pathlib import Path

from benchmarks.claim_processes import ClaimProcess, run_all

SPAN = "import sys, time, pathlib; a = time.time(); time.sleep({}); " + (
    "pathlib.Path({!r}).write_text(f'{{a}} {{time.time()}}')"
)


def task(name: str, code: str, *, alone: bool = False) -> ClaimProcess:
    return ClaimProcess(name, [sys.executable, "-c", code], alone)


def test_statuses_are_those_of_the_processes(tmp_path: Path) -> None:
    tasks = [
        task("good", ""),
        task("bad", "raise SystemExit(3)"),
        task("killed", "import os\nos.kill(os.getpid(), 9)"),
    ]
    assert dict(run_all(tasks, tmp_path, 2, 60.0)) == {"good": 0, "bad": 3, "killed": -9}


def test_processes_that_measure_run_alone(tmp_path: Path) -> None:
    names = ("first", "alone", "last", "also last")
    tasks = [
        task(name, SPAN.format(0.2, str(tmp_path / name)), alone=name == "alone") for name in names
    ]
    assert all(status == 0 for _, status in run_all(tasks, tmp_path, 4, 60.0))
    begin, end = map(float, (tmp_path / "alone").read_text().split())
    for name in set(names) - {"alone"}:
        other_begin, other_end = map(float, (tmp_path / name).read_text().split())
        assert other_end <= begin or other_begin >= end


def test_processes_stop_at_the_limit(tmp_path: Path) -> None:
    begin = time.monotonic()
    tasks = [task("long", "import time; time.sleep(60)"), task("waiting", "")]
    assert dict(run_all(tasks, tmp_path, 1, 0.5)) == {"long": None, "waiting": None}
    assert time.monotonic() - begin < 30
