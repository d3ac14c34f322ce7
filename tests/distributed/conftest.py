"""Fixtures that start programs on ranks by mpiexec.

Tests are skipped where MPI or PETSc is missing.
"""

import subprocess
import textwrap

import pytest

from warp_lcp.distributed import launch

SECONDS = 240.0  # limit of a run that may hang; the first one compiles kernels

launch.find_petsc()


@pytest.fixture
def mpi(tmp_path):
    """Run this interpreter on ranks in `tmp_path`, see `starter`."""
    return starter(tmp_path)


@pytest.fixture(scope="module")
def mpi_of_module(tmp_path_factory):
    """Run this interpreter on ranks in a folder of the test module, see `starter`.

    A start takes seconds; the tests of a module can share one.
    """
    return starter(tmp_path_factory.mktemp("ranks"))


def starter(folder):
    """Return what runs this interpreter on n ranks.

    `mpi(2, "-m", "module", "--option")`, or `mpi(2, TEXT, *arguments)` with a program's text. Text
    is what has a line break in it; it is written into a file in the folder, which is the working
    folder of all runs, `mpi.folder`.

    Args:
        n: number of ranks.
        arguments: arguments of the interpreter, of any type that `str` converts; or a program
            and its arguments.
        exit_code: required exit code; None for any.
        seconds: time limit.
        environment: variables to add.

    Returns:
        subprocess.CompletedProcess with the text of `stdout` (of all ranks, their lines in any
        order) and `stderr`.
    """
    why = launch.missing()
    if why:
        pytest.skip(why)

    def run(n, *arguments, exit_code=0, seconds=SECONDS, environment=None):
        words = [str(a) for a in arguments]
        if "\n" in words[0]:
            program = folder / "program.py"
            program.write_text(textwrap.dedent(words[0]))
            words[0] = str(program)
        process = subprocess.Popen(
            launch.command(n, *words),
            env=launch.environment() | (environment or {}),
            cwd=folder,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            out, errors = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.terminate()  # mpiexec then ends its ranks
            try:
                out, errors = process.communicate(timeout=10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                out, errors = process.communicate()
            pytest.fail(f"{n} ranks did not end within {seconds} s\n{out}\n{errors}")
        assert exit_code is None or process.returncode == exit_code, (
            f"exit code {process.returncode}\n{out}\n{errors}"
        )
        return subprocess.CompletedProcess(process.args, process.returncode, out, errors)

    run.folder = folder
    return run
