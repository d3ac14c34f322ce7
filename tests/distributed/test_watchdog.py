"""Deadlock watchdog: ranks that wait for a missing one end and name it.

They also say where it is.
"""

import re
import sys
import time
from pathlib import Path

import pytest

from warp_lcp.distributed.interruptible_wait import InterruptibleWait, finish
from warp_lcp.distributed.watchdog import HeartbeatMessages, HeartbeatTable, place_of, verdict

INSIDE, OUTSIDE = (
    HeartbeatMessages(9, 31, "a sum", 12.0, "solver:7"),
    HeartbeatMessages(8, 30, "", 13.0, "build:3 from step:5"),
)
LATE, SILENT = (
    "has been at build:3 from step:5 for 13 s",
    "sends no heartbeat: stopped, unreachable, or inside a library call that does not return",
)
VERDICTS = [
    ([OUTSIDE, OUTSIDE], ""),
    (
        [INSIDE, OUTSIDE, INSIDE],
        f"rank 1 of 3 keeps the others waiting: rank 1 {LATE}; ranks 0, 2 in a sum (solver:7) for "
        "12 s",
    ),
    (
        [INSIDE, None],
        f"rank 1 of 2 keeps the others waiting: rank 1 {SILENT}; rank 0 in a sum (solver:7) for 12 "
        "s",
    ),
    (
        [None, INSIDE, OUTSIDE, None],
        f"ranks 0, 2, 3 of 4 keep the others waiting: rank 2 {LATE}; ranks 0, 3 {SILENT}; rank 1 "
        "in a sum",
    ),
    ([None, OUTSIDE], f"rank 1 {LATE}; rank 0 {SILENT}"),
    (
        [INSIDE, HeartbeatMessages(9, 29, "a broadcast", 14.0, "solver:8")],
        "all ranks wait for each other in different operations: rank 0 in a sum (solver:7); rank 1 "
        "in a broadcast (solver:8)",
    ),
]
ROOT = Path(__file__).parents[2]

WAIT = """
    import sys, time
    from warp_lcp.distributed.collective import Collective
    from warp_lcp.distributed.ranks import Ranks
    from warp_lcp.distributed.watchdog import Watchdog

    ranks = Ranks.world()
    what = sys.argv[1]
    collective = Collective(ranks, (), lambda text: sys.stderr.write(text + "\\n"))
    other = Ranks(ranks.comm.Dup())
    with Watchdog(ranks, 2.0, collective.end_all):
        for _ in range(30):
            ranks.sum(1)
            time.sleep(0.1)  # longer than the limit in all
        if what == "late" and ranks.rank == 2:
            time.sleep(1000)
        if what == "other" and ranks.rank == 1:
            other.collect("this one")
        ranks.sum(1)
    print("done")
"""


@pytest.mark.parametrize(("posts", "expected"), VERDICTS)
def test_the_late_rank_is_named(posts, expected):
    said = verdict(dict(enumerate(posts)))
    assert said.startswith(expected)
    assert bool(said) == bool(expected)
    assert verdict(dict(reversed(list(enumerate(posts))))) == said  # whichever rank reports it


def test_heartbeats_are_read_whole_or_not_at_all(tmp_path):
    board = HeartbeatTable(tmp_path)
    assert board.read(3) is None
    board.write(3, INSIDE)
    board.write(4, HeartbeatMessages(1, 1, "x" * 50, 1.0, "y" * 5000))
    assert board.read(3) == INSIDE
    assert board.read(4) is not None
    board.path(3).write_bytes(board.path(3).read_bytes()[:20])
    assert board.read(3) is None
    board.clear([3, 4, 5])
    assert not list(tmp_path.iterdir())


def test_the_position_of_a_rank_is_described():
    here = place_of(sys._getframe())
    assert re.fullmatch(rf"{__name__}:\d+", here)
    assert place_of(None) == "its end"


def test_a_long_wait_uses_no_core(monkeypatch):
    """By a clock that each look at it moves on by 10 us, and each sleep by its length."""
    now, slept = [0.0], [0.0]

    def look() -> float:
        now[0] += 1e-5
        return now[0]

    def sleep(seconds: float) -> None:
        now[0] += seconds
        slept[0] += seconds

    class DelayedRequest:
        end = 0.3

        def Test(self) -> bool:  # noqa: N802  # MPI's name
            return now[0] > self.end

    monkeypatch.setattr(time, "monotonic", look)
    monkeypatch.setattr(time, "sleep", sleep)
    request = DelayedRequest()
    assert finish(request)
    assert 0.28 < slept[0] < 0.31
    request.end = 100.0
    assert not finish(request, 0.02)
    assert now[0] < 0.35


def test_operations_are_counted_in_order():
    waiting = InterruptibleWait()
    with pytest.raises(KeyError), waiting("a sum"):
        assert (waiting.name, waiting.count) == ("a sum", 1)
        raise KeyError
    assert (waiting.name, waiting.count) == ("", 2)


ENDS = {
    "late": r"rank 2 of 3 keeps the others waiting: rank 2 has been at __main__:\d+ for \d+ s; "
    r"ranks 0, 1 in a gather \(__main__:\d+\)",
    "other": r"all ranks wait for each other in different operations: ranks 0, 2 in a gather "
    r"\(__main__:\d+\); rank 1 in a gather",
}


@pytest.mark.parametrize("what", ENDS)
def test_waiting_ends(mpi, what):
    """Heartbeats between ranks of one machine without a known folder."""
    done = mpi(3, WAIT, what, exit_code=None, seconds=60.0)
    assert done.returncode != 0
    assert "done" not in done.stdout
    assert re.search(ENDS[what], done.stderr), done.stderr
    assert "all ranks are aborted: --rank-timeout 2" in done.stderr


def test_no_operation_goes_unwatched():
    """Collective calls only inside `waiting`, in the few places that call MPI."""
    calls = re.compile(
        r"\.(I?([Aa]ll|[Bb]arrier|[Bb]cast|[Gg]ather|[Ss]catter|[Rr]educe|[Ss]can)\w*"
        r"|[Ss]end|[Rr]ecv|Wait\w*|Split\w*)\("
    )
    unwatched = []
    for file in (
        file
        for folder in ("warp_lcp", "fluids", "granular")
        for file in (ROOT / folder).rglob("*.py")
    ):
        lines = file.read_text().splitlines()
        for number, line in enumerate(lines):
            if (
                ("comm." in line or "MPI." in line)
                and calls.search(line)
                and "with waiting(" not in lines[number - 1]
            ):
                unwatched.append(f"{file.name}:{number + 1}: {line.strip()}")
    assert not unwatched
