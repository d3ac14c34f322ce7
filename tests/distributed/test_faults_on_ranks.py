"""Faults of one rank: all ranks end soon, with a message that names it.

Any number of ranks can continue from what was written.
"""

import fcntl
import json
import random
from contextlib import suppress
from pathlib import Path

import faults_on_ranks
import pytest
from dots_on_ranks import SCENE
from test_run_on_ranks import assert_same_run, log, run

from small_runs import read_record

PROGRAM = Path(__file__).with_name("faults_on_ranks.py")
SECONDS = 90.0  # a run that takes longer hangs: without a fault it takes a few
LIMIT = 6.0  # that a rank may be late, in seconds
__all__ = ["run"]


@pytest.fixture
def befall(mpi, tmp_path):
    """Run dots on ranks with a fault on one, see `faults_on_ranks`.

    The ranks must end within SECONDS. Return their output.
    """

    def go(ranks, fault, *more):
        (tmp_path / "dots.toml").write_text(SCENE)
        options = (
            "--engine",
            "petsc",
            "--device",
            "cpu",
            "--out",
            "out",
            "--rank-timeout",
            LIMIT,
            *more,
        )
        done = mpi(
            ranks,
            PROGRAM,
            "run",
            "dots.toml",
            *options,
            exit_code=None,
            seconds=SECONDS,
            environment={"FAULT": fault},
        )
        assert done.returncode != 0
        assert "finished" not in done.stdout
        assert (tmp_path / "fault").exists()
        return done.stdout + done.stderr

    return go


def wait_for_ranks(folder):
    """Wait until no process holds a folder: mpiexec may end before its last rank."""
    with suppress(FileNotFoundError), open(folder / "run.lock") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)


# On two ranks: the status in run.json, the message, and the step from which others continue.
FAULTS = {
    "1 killed step 70": ("running", "", "noticed that process rank 1", 68),
    "1 late wait 300": (
        "failed",
        "rank 1 of 2 keeps the others waiting: ",
        "rank 1 has been at __main__:",
        12,
    ),
    "0 Ctrl-C step 30": ("stopped", "interrupted by SIG", "", None),
    "1 bug step 30": ("failed", "rank 1", "KeyError: 'no such key'", 28),
    "1 small-files step 30": ("failed", "rank 1: [Errno 27] File too large", "File too large", 28),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_after_a_fault_all_ranks_end_and_the_run_resumes(befall, run, tmp_path, fault):
    status, reason, expected_text, step = FAULTS[fault]
    text = befall(2, fault)
    found = read_record(tmp_path / "out")
    # by mpiexec, a second later, before the step's end
    killed = "Ctrl-C" in fault and found["status"] == "running"
    assert killed or (found["status"], found["reason"][: len(reason)]) == (status, reason)
    assert expected_text in text
    ranks = 3 if "late" in fault else 0
    wait_for_ranks(tmp_path / "out")
    run(ranks, "run dots.toml --out out --resume")
    run(0, "run dots.toml --out one")
    assert_same_run(tmp_path / "one", tmp_path / "out")
    resumed = read_record(tmp_path / "out")["resumed_from_step"]
    assert resumed == step if step is not None else resumed >= 28
    assert not list((tmp_path / "out").glob(".waits*"))


AFTER = """
    import sys
    sys.path.insert(0, {folder!r})
    import dots_on_ranks
    from mpi4py import MPI
    from warp_lcp.run.progress import ProgressLines
    from warp_lcp.run import rank_frames

    if MPI.COMM_WORLD.rank == {rank}:
        def fail(self, row):
            if row["step"] == 30:
                raise LookupError("nothing to show")
        ProgressLines.step = fail
    dots_on_ranks.main(["run", "dots.toml", "--engine", "petsc", "--device", "cpu", "--out", "out"])
"""


@pytest.mark.parametrize("rank", [0, 1])
def test_a_failure_after_a_step_keeps_the_step(mpi, run, tmp_path, rank):
    done = mpi(2, AFTER.format(folder=str(PROGRAM.parent), rank=rank), exit_code=1)
    assert "LookupError: nothing to show" in done.stderr
    found = read_record(tmp_path / "out")
    assert (found["status"], found["steps"]) == ("failed", 30)
    assert found["reason"] == (
        "LookupError: nothing to show" if rank == 0 else "rank 1: LookupError: nothing to show"
    )
    run(0, "run dots.toml --out out --resume")
    assert read_record(tmp_path / "out")["resumed_from_step"] == 30


MOST = {"file": 80, "wait": 900, "wait-end": 900, "step": 131}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_any_fault_at_any_moment(mpi, run, tmp_path, seed):
    draw = random.Random(9173 * seed + 71)
    ranks, kind, place = (
        draw.choice([2, 2, 3, 4]),
        draw.choice(faults_on_ranks.KINDS),
        draw.choice(faults_on_ranks.PLACES),
    )
    rank, number = draw.randrange(ranks), 1 + int(MOST[place] * draw.random() ** 1.5)
    words = (
        "run",
        "dots.toml",
        "--engine",
        "petsc",
        "--device",
        "cpu",
        "--out",
        "out",
        "--rank-timeout",
        LIMIT,
    )
    done = mpi(
        ranks,
        PROGRAM,
        *words,
        exit_code=None,
        seconds=SECONDS,
        environment={"FAULT": f"{rank} {kind} {place} {number}"},
    )
    if (tmp_path / "fault").exists() and done.returncode != 0:
        if rank and kind in ("late", "stopped", "bug", "disk", "disk-full", "small-files"):
            assert f"rank {rank}" in done.stdout + done.stderr
    out = tmp_path / "out"
    wait_for_ranks(out)
    if (
        not (out / "run.json").is_file()
        or json.loads((out / "run.json").read_text())["status"] != "finished"
    ):
        run(
            draw.choice([0, 1, 3]),
            f"run dots.toml --out out{' --resume' * (out / 'run.json').is_file()}",
        )
    run(0, "run dots.toml --out one")
    assert len(log(out)) == 131
    assert_same_run(tmp_path / "one", out)
    assert not [path for path in out.rglob(".*") if "spare" not in path.name]
