"""A rank that fails ends all, with a message that names it; none hangs."""

import pytest

FAIL = """
    import os, signal, sys, time
    from warp_lcp.distributed.meeting import Meeting, RankFailed
    from warp_lcp.distributed.ranks import Ranks

    def say(text):
        sys.stderr.write(text + "\\n")

    ranks = Ranks.world()
    try:
        with Meeting(ranks, (ValueError,), say).together():
            what = sys.argv[1]
            if what == "one" and ranks.rank == 1:
                raise RuntimeError("no more memory")
            if what == "wrong" and ranks.rank == 1:
                raise ValueError("--out /x: no such folder")
            if what == "interrupt" and ranks.rank == 1:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(30)
            if what == "killed" and ranks.rank == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            if what == "differ":
                ranks.agree("the scene", f"text {ranks.rank == 1}")
            if what == "all":
                raise ValueError("resolution = -3: must be > 0")
            if what in ("one", "killed", "none"):
                ranks.sum(1)  # with "one" the others wait here for a rank that does not come
    except (ValueError, RankFailed) as error:
        if ranks.first:
            say(str(error))
        sys.exit(2 if isinstance(error, ValueError) else 1)
    print("done")
"""


def test_one_that_leaves_the_others_waiting_ends_all(mpi):
    done = mpi(3, FAIL, "one", exit_code=1)
    assert "rank 1 of 3: Traceback" in done.stderr
    assert "RuntimeError: no more memory" in done.stderr
    assert "done" not in done.stdout


@pytest.mark.parametrize(
    ("what", "code", "message"),
    [
        ("wrong", 2, "rank 1: --out /x: no such folder"),
        ("interrupt", 1, "rank 1: KeyboardInterrupt"),
        ("differ", 2, "the scene on rank 1 is not what it is on rank 0: start all ranks with the same command and files"),
        ("all", 2, "resolution = -3: must be > 0"),
    ],
)
def test_what_fails_is_said_once(mpi, what, code, message):
    done = mpi(2, FAIL, what, exit_code=None)
    assert done.returncode == code or (what == "interrupt" and done.returncode > 0)  # Python's own exit code of Ctrl-C
    assert done.stderr.count(message) == 1
    assert "done" not in done.stdout


def test_a_killed_rank_ends_all(mpi):
    done = mpi(2, FAIL, "killed", exit_code=None, seconds=60.0)
    assert done.returncode != 0
    assert "done" not in done.stdout


def test_success_is_left_alone(mpi):
    assert mpi(2, FAIL, "none").stdout.count("done") == 2
    assert mpi(1, FAIL, "none").stdout == "done\n"
