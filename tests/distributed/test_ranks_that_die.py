"""Ranks that are killed, interrupted or given different input end all ranks.

Ranks without a fault end, too.
"""

import pytest

FAIL = """
    import os, signal, sys, time
    from warp_lcp.distributed import collective as collectives
    from warp_lcp.distributed.ranks import Ranks

    def say(text):
        sys.stderr.write(text + "\\n")

    collectives.PATIENCE = 2.0
    ranks = Ranks.world()
    what = sys.argv[1]
    try:
        with collectives.Collective(ranks, (ValueError,), say).together():
            if what == "interrupt" and ranks.rank == 1:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(30)
            if what == "killed" and ranks.rank == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            if what == "differ":
                ranks.agree("the scene", f"text {ranks.rank == 1}")
            ranks.sum(1)  # with the others they wait here for a rank that does not come
    except ValueError as error:
        if ranks.is_root:
            say(str(error))
        sys.exit(2)
    print("done")
"""


@pytest.mark.parametrize("what", ["interrupt", "killed"])
def test_a_dead_rank_ends_all_ranks(mpi, what):
    done = mpi(2, FAIL, what, exit_code=None, seconds=60.0)
    assert done.returncode != 0
    assert "done" not in done.stdout
    assert ("rank 1 of 2: " in done.stderr and "KeyboardInterrupt" in done.stderr) == (
        what == "interrupt"
    )


def test_differing_collective_calls_are_refused_once(mpi):
    done = mpi(3, FAIL, "differ", exit_code=2)
    assert (
        done.stderr.count(
            "the scene on rank 1 differs from rank 0: start all ranks with the same command and "
            "files"
        )
        == 1
    )
    assert "done" not in done.stdout


SHORT = ("--engine", "petsc", "--device", "cpu", "--set", "domain.resolution=32", "--frames", "1")


@pytest.mark.slow
@pytest.mark.parametrize("turn", range(200))
def test_short_runs_end_on_all_ranks(mpi, turn):
    """Short runs one after the other, which may reveal rare deadlocks."""
    done = mpi(
        2 + turn % 3,
        "-c",
        "from warp_lcp.cli.commands import main; main()",
        "run",
        "dam-break-2d",
        *SHORT,
    )
    assert "finished: frame 1 of" in done.stdout
