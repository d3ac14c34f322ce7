"""`mpiexec -n N warp-lcp solve PROBLEM.npz --engine petsc`.

Each rank reads and solves its box; the first one prints and writes.
"""

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.benchmarks.problems import cut_cells, splash
from warp_lcp.cli.solve_recorded import solve_recorded
from warp_lcp.recorded_problem import NUMBERS

NOTE = "import sys; from warp_lcp.cli.commands import main; main()"


def write(path, cells, b, lower, upper=np.inf, **faces):
    numbers = dict.fromkeys(NUMBERS, 1.0)
    np.savez_compressed(
        path,
        format=np.array(1),
        cells=cells,
        b=b,
        lower=lower,
        upper=upper,
        x0=np.zeros(b.shape),
        **numbers,
        **faces,
    )
    return path


def call(mpi, ranks, *arguments, **options):
    return mpi(ranks, "-c", NOTE, "solve", *arguments, **options)


@pytest.fixture
def problem(tmp_path):
    scene = cut_cells(splash(20))
    return write(
        tmp_path / "problem_000004.npz", scene.cells, scene.b, scene.lower("walls"), **scene.faces
    )


@pytest.mark.parametrize("ranks", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_ranks_solve_what_one_process_solves(mpi, problem, tmp_path, ranks):
    alone = solve_recorded(problem, tolerance=1e-9)
    assert bool(alone.result)
    out = tmp_path / "x.npy"
    done = call(mpi, ranks, problem, "--engine", "petsc", "--out", out, "--tolerance", 1e-9)
    x = np.load(out)
    assert x.shape == (20, 20, 20)
    np.testing.assert_allclose(x, alone.result.x.numpy(), rtol=0, atol=1e-7 * np.abs(x).max())
    lines = done.stdout.splitlines()
    assert lines[0].startswith(
        f"{alone.unknowns} unknowns, 20 x 20 x 20 cells, by projected-multigrid on cpu, ranks: "
        f"{ranks}, "
    )
    assert lines[-1].startswith("CONVERGED: ")
    assert done.stdout.count("CONVERGED") == 1  # one rank speaks
    iterations = int(lines[-2].split()[0])
    assert abs(iterations - alone.result.iterations) <= 1


def test_two_dimensions_and_boxes(mpi, tmp_path):
    """Solve a 2-D problem and boxes.

    Numbers as bounds, a file in Fortran order, ranks along the longer side.
    """
    cells = np.full((12, 30), wl.FLUID, dtype=np.int8)
    cells[-3:] = wl.AIR
    cells[:4, 11:14] = wl.SOLID
    b = np.where(cells == wl.FLUID, np.random.default_rng(5077).standard_normal(cells.shape), 0.0)
    file = write(
        tmp_path / "problem_000001.npz", np.asfortranarray(cells), np.asfortranarray(b), -0.5, 0.75
    )
    alone = solve_recorded(file, tolerance=1e-9)
    call(
        mpi,
        2,
        file,
        "--engine",
        "petsc",
        "--out",
        tmp_path / "x.npy",
        "--tolerance",
        1e-9,
        "--method",
        "minimum-map-newton",
    )
    x = np.load(tmp_path / "x.npy")
    np.testing.assert_allclose(x, alone.result.x.numpy(), rtol=0, atol=1e-7)
    assert (x.min(), x.max()) == (-0.5, 0.75)


WRONG = {  # commands, with the message of each
    "none.npz": "none.npz: is not a recorded problem",
    "A.mtx b.mtx": "A.mtx: --engine petsc solves only grid problems",
    "problem_000004.npz --method psor": "--method psor: does not work on several ranks; choose "
    "from minimum-map-newton",
    "problem_000004.npz --device cuda": "--device cuda: there is no such device",
    "problem_000004.npz --out x.mtx": "--out x.mtx: x of a grid is written as a NumPy array: the "
    "name must end in .npy",
}


def test_wrong_input_is_reported_once(mpi, problem):
    text = """
    import sys
    from warp_lcp.cli.commands import main
    commands = sys.argv[1:]
    for command in commands:
        sys.argv[1:] = ["solve", *command.split(), "--engine", "petsc"]
        try:
            main()
        except SystemExit as end:
            assert end.code == 2, end.code
            sys.stderr.write("exit code 2\\n")
    """
    done = mpi(2, text, *WRONG)
    assert done.stderr.count("exit code 2") == 2 * len(WRONG)
    for expected in WRONG.values():
        assert done.stderr.count(expected) == 1
    assert "Traceback" not in done.stderr


def test_ranks_with_different_files_end(mpi, problem, tmp_path):
    text = """
    import os, sys
    from warp_lcp.cli.commands import main
    from warp_lcp.distributed.launch import rank_here
    os.chdir(sys.argv.pop())
    if rank_here() == 1:
        os.chdir("other")
    main()
    """
    (tmp_path / "other").mkdir()
    scene = splash(20)
    write(tmp_path / "other" / problem.name, scene.cells, scene.b, 0.0)
    done = mpi(2, text, "solve", problem.name, "--engine", "petsc", tmp_path, exit_code=2)
    assert "the problem: " in done.stderr
    assert "on rank 0" in done.stderr


def test_more_ranks_than_the_grid_can_be_cut_for(mpi, tmp_path):
    cells = np.full((2, 2, 2), wl.FLUID, dtype=np.int8)
    cells[1] = wl.AIR
    file = write(
        tmp_path / "problem_000002.npz", cells, np.where(cells == wl.FLUID, -1.0, 0.0), 0.0
    )
    done = call(mpi, 3, file, "--engine", "petsc", exit_code=2)
    assert (
        done.stderr.count("3 ranks cannot share 2 x 2 x 2 cells, each with a box: start 2 or fewer")
        == 1
    )
