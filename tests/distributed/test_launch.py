"""Start and end of programs on ranks."""

import pytest

from warp_lcp.distributed import launch

HELLO = """
    import os, sys
    from mpi4py import MPI
    print(f"rank {MPI.COMM_WORLD.rank} of {MPI.COMM_WORLD.size}, {sys.argv[1]}, \
{os.environ['OPENBLAS_NUM_THREADS']}\\n", end="")
"""


def test_ranks_know_each_other(mpi):
    lines = mpi(3, HELLO, "argument").stdout.split("\n")
    assert sorted(line for line in lines if line) == [
        f"rank {n} of 3, argument, 1" for n in range(3)
    ]


def test_modules_run_on_ranks(mpi):
    # Lines of ranks may be interleaved.
    text = "from warp_lcp.distributed import launch; print(f'{launch.rank_here()} ', end='')"
    assert sorted(mpi(2, "-c", text).stdout.split()) == ["0", "1"]


def test_without_mpiexec_there_is_no_rank(monkeypatch):
    for name in launch.RANK:
        monkeypatch.delenv(name, raising=False)
    assert launch.rank_here() is None


def test_an_exit_code_is_seen(mpi):
    with pytest.raises(AssertionError, match="exit code 3"):
        mpi(2, "-c", "raise SystemExit(3)")
    assert mpi(2, "-c", "raise SystemExit(3)", exit_code=3).returncode == 3


def test_a_hang_is_ended(mpi):
    hang = "from mpi4py import MPI; MPI.COMM_WORLD.rank or MPI.COMM_WORLD.recv()"
    with pytest.raises(pytest.fail.Exception, match="2 ranks did not end within"):
        mpi(2, "-c", hang, seconds=2.0)


def test_environment_variables_override_launch_defaults(monkeypatch):
    monkeypatch.setenv("PETSC_DIR", "/somewhere")
    given = launch.environment()
    assert given["PETSC_DIR"] == "/somewhere"
    assert given["OMPI_MCA_rmaps_base_oversubscribe"] == "1"
    assert launch.environment({"OMP_NUM_THREADS": "2"})["OMP_NUM_THREADS"] == "2"
    assert launch.command(2, "program.py")[:3] == ["mpiexec", "-n", "2"]


@pytest.mark.parametrize(
    ("there", "expected"),
    [(None, "no mpiexec: install"), ("/usr/bin/mpiexec", "no petsc4py and no mpi4py: install")],
)
def test_missing_programs_are_named(monkeypatch, there, expected):
    monkeypatch.setattr(launch.shutil, "which", lambda name: there)
    monkeypatch.setattr(launch.importlib.util, "find_spec", lambda name: None)
    assert launch.missing().startswith(expected)
