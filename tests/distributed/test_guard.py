"""A rank that fails ends all, with a message; none hangs."""

import time

import pytest

from warp_lcp.distributed.devices import dealt

FAIL = """
    import os, signal, sys, time
    from warp_lcp.distributed.guard import Guard
    from warp_lcp.distributed.ranks import Ranks

    def say(text):
        sys.stderr.write(text + "\\n")

    ranks = Ranks.world()
    try:
        with Guard(ranks, say):
            what = sys.argv[1]
            if what == "one":
                if ranks.rank == 1:
                    raise RuntimeError("no more memory")
                ranks.sum(1)  # waits for rank 1
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
            if what == "each":
                raise ValueError(f"file {ranks.rank}: is not there")
            if what == "exit":
                raise SystemExit(3)
            if what != "none":
                ranks.sum(1)
    except ValueError as error:
        say(str(error))
        sys.exit(2)
    print("done")
"""


def test_one_ends_all(mpi):
    done = mpi(3, FAIL, "one", exit_code=1)
    assert "rank 1 of 3: Traceback" in done.stderr
    assert "RuntimeError: no more memory\nall ranks end" in done.stderr
    assert "rank 0 of 3" not in done.stderr
    assert "done" not in done.stdout


@pytest.mark.parametrize(
    ("what", "code", "message"),
    [("wrong", 2, "rank 1 of 2: --out /x: no such folder\nall ranks end"), ("interrupt", 130, "rank 1 of 2: interrupted\nall ranks end")],
)
def test_one_is_named(mpi, what, code, message):
    done = mpi(2, FAIL, what, exit_code=code)
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert "done" not in done.stdout


def test_a_killed_rank_is_seen(mpi):
    begun = time.monotonic()
    done = mpi(2, FAIL, "killed", exit_code=None)
    assert done.returncode != 0
    assert "done" not in done.stdout
    assert time.monotonic() - begun < 60.0  # it did not hang


def test_different_inputs_are_refused_once(mpi):
    done = mpi(3, FAIL, "differ", exit_code=2)
    assert done.stderr.count("the scene on rank 1 is not what it is on rank 0") == 1
    assert "all ranks end" not in done.stderr


def test_what_all_refuse_is_said_by_rank_0(mpi):
    assert mpi(2, FAIL, "all", exit_code=2).stderr.count("resolution = -3: must be > 0") == 1


def test_what_each_refuses_is_said_by_one_at_least(mpi):
    done = mpi(2, FAIL, "each", exit_code=2)
    assert any(f"rank {n} of 2: file {n}: is not there\nall ranks end" in done.stderr for n in range(2))


def test_an_exit_of_all_is_kept(mpi):
    assert mpi(2, FAIL, "exit", exit_code=3).stdout == ""


def test_success_is_left_alone(mpi):
    assert mpi(2, FAIL, "none").stdout.count("done") == 2
    assert mpi(1, FAIL, "none").stdout == "done\n"


@pytest.mark.parametrize(
    ("name", "number", "found", "expected"),
    [
        (None, 1, [], "cpu"),
        (None, 1, ["cuda:0"], "cuda:0"),
        ("cpu", 0, ["cuda:0"], "cpu"),
        ("cuda", 3, ["cuda:0", "cuda:1"], "cuda:1"),
        ("cuda:1", 0, ["cuda:0", "cuda:1"], "cuda:1"),
    ],
)
def test_devices_are_dealt_in_turns(name, number, found, expected):
    assert dealt(name, number, found) == expected


@pytest.mark.parametrize(("name", "choices"), [("cuda", "cpu"), ("cuda:0", "cpu"), ("tpu", "cpu")])
def test_a_missing_device_is_named(name, choices):
    with pytest.raises(ValueError, match=f"--device {name}: there is no such device on this machine; choose from {choices}"):
        dealt(name, 0, [])


def test_ranks_of_one_machine_count_through_its_devices(mpi):
    text = """
    import warp as wp
    from warp_lcp.distributed import devices
    from warp_lcp.distributed.ranks import Ranks
    wp.config.log_level = wp.LOG_ERROR
    devices.dealt = lambda name, number, found: f"{name} {number}"  # without a GPU at hand
    ranks = Ranks.world()
    print(f"{ranks.rank}: {devices.device_of_rank(ranks, 'cuda')}\\n", end="")
    """
    lines = mpi(3, text).stdout.split("\n")
    assert sorted(line for line in lines if ": cuda" in line) == ["0: cuda 0", "1: cuda 1", "2: cuda 2"]
