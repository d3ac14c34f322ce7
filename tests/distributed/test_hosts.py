"""Ranks on separate hosts: same results as ranks of one host.

The hosts are network namespaces of this machine.
"""

import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from warp_lcp.distributed import launch

HOSTS = Path(__file__).with_name("hosts")
RUN = "from warp_lcp.cli.commands import main; main()"
WORDS = (
    "run",
    "dam-break",
    "--engine",
    "petsc",
    "--device",
    "cpu",
    "--set",
    "domain.resolution=48",
    "--set",
    "time.duration=0.2",
)
WHERE = """
    import os, socket
    from mpi4py import MPI
    of_host = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED)
    print(f"{socket.gethostname()} {of_host.size} {os.environ['OPENBLAS_NUM_THREADS']}\\n", end="")
"""


@pytest.fixture
def hosts(tmp_path):
    """Run this interpreter on ranks with a host each and return the output.

    Call it as `hosts(3, *arguments)`; it runs in `tmp_path`.
    """
    if why := launch.missing():
        pytest.skip(why)
    if (
        shutil.which("ip") is None
        or subprocess.run(
            ["unshare", "--net", "--uts", "true"], check=False, capture_output=True
        ).returncode
    ):
        pytest.skip("this user makes no network namespaces")

    def run(n, *arguments):
        command = [str(HOSTS), str(n), sys.executable, *map(str, arguments)]
        done = subprocess.run(
            command,
            env=launch.environment(),
            cwd=tmp_path,
            text=True,
            capture_output=True,
            timeout=300.0,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.mark.slow
def test_each_rank_has_a_host(hosts, tmp_path):
    program = tmp_path / "where.py"
    program.write_text(textwrap.dedent(WHERE))
    assert sorted(hosts(3, program).split("\n")[:-1]) == ["host1 1 1", "host2 1 1", "host3 1 1"]


@pytest.mark.slow
def test_runs_have_the_same_bits(hosts, mpi, tmp_path):
    """Equal bits in the log, except seconds, and in all frames."""
    mpi(3, "-c", RUN, *WORDS, "--out", "one")
    hosts(3, "-c", RUN, *WORDS, "--out", "three")
    logs = [
        [row.split(",")[:-1] for row in (tmp_path / out / "log.csv").read_text().splitlines()]
        for out in ("one", "three")
    ]
    assert logs[0] == logs[1]
    assert len(logs[0]) > 10
    files = sorted(
        path.relative_to(tmp_path / "one") for path in (tmp_path / "one" / "frames").rglob("*.*")
    )
    assert len(files) > 30
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "three" / file).read_bytes(), (
            file
        )
