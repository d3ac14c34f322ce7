"""`warp-lcp solve` on Matrix Market files: output, exit codes and messages."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from typer.testing import CliRunner, Result

import warp_lcp as wl
from oracle import boxed, lemke
from warp_lcp.benchmarks.problems import cut_cells, splash
from warp_lcp.cli import commands as cli
from warp_lcp.cli.solve_file import MOST_ROWS
from warp_lcp.recorded_problem import NUMBERS


def call(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, ["solve", *map(str, arguments), "--device", "cpu"])


@pytest.fixture
def problem(tmp_path):
    """Write a problem: a 5-point stencil and a wave."""
    T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(6, 6))
    A = (
        scipy.sparse.kron(T, scipy.sparse.eye_array(6))
        + scipy.sparse.kron(scipy.sparse.eye_array(6), T)
    ).tocsr()
    b = np.sin(np.arange(36.0))
    write(tmp_path / "A.mtx", A)
    write(tmp_path / "b.mtx", b)
    return A, b


def write(path: Path, array) -> Path:
    """Write an array as Matrix Market; vectors as one column."""
    scipy.io.mmwrite(
        path,
        array
        if scipy.sparse.issparse(array) or np.ndim(array) == 2
        else np.reshape(array, (-1, 1)),
        precision=17,
    )
    return path


def test_a_sparse_problem(problem, tmp_path):
    A, b = problem
    out = tmp_path / "x.mtx"
    result = call(tmp_path / "A.mtx", tmp_path / "b.mtx", "--out", out, "--tolerance", 1e-10)
    assert result.exit_code == 0, result.stderr
    assert "36 unknowns, 156 entries, symmetric, by minimum-map-newton on cpu" in result.stdout
    lines = result.stdout.splitlines()
    assert lines[1].split() == ["iteration", "residual", "linear", "active", "step", "seconds"]
    assert [line.split()[0] for line in lines[2:-1]] == [str(k) for k in range(len(lines) - 3)]
    assert lines[-1].startswith("CONVERGED: ")
    assert f"{float(lines[-2].split()[1]):.3e}" in lines[-1]
    x = scipy.io.mmread(out)
    assert x.shape == (36, 1)
    np.testing.assert_allclose(x.ravel(), lemke(A.toarray(), b), atol=1e-9)


@pytest.mark.parametrize("method", ["psor", "lemke"])
def test_a_dense_problem_with_bounds_in_files(method, tmp_path):
    rng = np.random.default_rng(3)
    B = rng.standard_normal((6, 6))
    A, b, upper = B @ B.T + np.eye(6), rng.standard_normal(6), rng.random(6)
    upper[2] = np.inf
    write(tmp_path / "A.mtx", A)
    write(tmp_path / "b.mtx", scipy.sparse.coo_array(b.reshape(-1, 1)))
    write(tmp_path / "u.mtx", upper)
    result = call(
        *(tmp_path / "A.mtx", tmp_path / "b.mtx", "--lower", -0.25, "--upper", tmp_path / "u.mtx"),
        *("--method", method, "--out", tmp_path / "x.mtx", "--tolerance", 1e-11),
    )
    assert result.exit_code == 0, result.stderr
    assert f"6 unknowns, dense, symmetric, by {method} on cpu" in result.stdout
    expected = boxed(A, b, np.full(6, -0.25), upper)
    np.testing.assert_allclose(scipy.io.mmread(tmp_path / "x.mtx").ravel(), expected, atol=1e-8)


@pytest.mark.parametrize("infinity", [1e20, 3e20, 1e30, np.inf])
def test_1e20_is_infinite_in_files(infinity, tmp_path):
    rng = np.random.default_rng(31)
    B = rng.standard_normal((5, 5))
    A, b = B @ B.T + np.eye(5), rng.standard_normal(5)
    lower, upper = (
        np.array([-infinity, -0.1, 0.0, -infinity, 0.0]),
        np.array([infinity, 0.1, 0.05, 0.0, infinity]),
    )
    for name, array in {"A": A, "b": b, "l": lower, "u": upper}.items():
        write(tmp_path / f"{name}.mtx", array)
    result = call(
        *(
            tmp_path / "A.mtx",
            tmp_path / "b.mtx",
            "--lower",
            tmp_path / "l.mtx",
            "--upper",
            tmp_path / "u.mtx",
        ),
        *("--method", "lemke", "--out", tmp_path / "x.mtx", "--tolerance", 1e-11),
    )
    assert result.exit_code == 0, result.stderr
    expected = boxed(
        A, b, np.where(lower <= -1e20, -np.inf, lower), np.where(upper >= 1e20, np.inf, upper)
    )
    np.testing.assert_allclose(scipy.io.mmread(tmp_path / "x.mtx").ravel(), expected, atol=1e-9)
    free = call(
        tmp_path / "A.mtx",
        tmp_path / "b.mtx",
        "--lower",
        -infinity,
        "--out",
        tmp_path / "x.mtx",
        "--tolerance",
        1e-11,
    )
    assert free.exit_code == 0, free.stderr
    np.testing.assert_allclose(
        scipy.io.mmread(tmp_path / "x.mtx").ravel(), np.linalg.solve(A, -b), atol=1e-9
    )


def test_the_files_symmetry_is_understood(problem, tmp_path):
    """Symmetric files, which hold one triangle only."""
    A, _ = problem
    scipy.io.mmwrite(tmp_path / "half.mtx", A, symmetry="symmetric")
    whole, half = (
        call(tmp_path / name, tmp_path / "b.mtx").stdout.splitlines()
        for name in ("A.mtx", "half.mtx")
    )
    assert half[0] == whole[0]
    assert half[-1] == whole[-1]


def test_a_solve_that_fails_exits_with_1(problem, tmp_path):
    out = tmp_path / "x.mtx"
    result = call(
        tmp_path / "A.mtx",
        tmp_path / "b.mtx",
        "--method",
        "psor",
        "--max-iterations",
        3,
        "--out",
        out,
    )
    assert result.exit_code == 1
    assert result.stderr.startswith("MAX_ITERATIONS: ")
    assert "3 iterations, residual " in result.stderr
    assert np.isfinite(scipy.io.mmread(out)).all()  # the best iterate


def test_a_solve_ends_in_time(problem, tmp_path):
    result = call(tmp_path / "A.mtx", tmp_path / "b.mtx", "--max-seconds", 1e-9)
    assert result.exit_code == 1
    assert result.stderr.startswith("TIME_LIMIT: `max_seconds` was reached")
    assert call(tmp_path / "A.mtx", tmp_path / "b.mtx", "--max-seconds", 600).exit_code == 0


def test_a_long_history_is_shortened(problem, tmp_path):
    result = call(
        tmp_path / "A.mtx",
        tmp_path / "b.mtx",
        "--method",
        "psor",
        "--max-iterations",
        70,
        "--tolerance",
        1e-15,
    )
    rows = [
        line.split()[0]
        for line in result.stdout.splitlines()[2:]
        if line.split()[0].isdigit() or line.split()[0] == "..."
    ]
    assert len(rows) == MOST_ROWS + 1
    assert rows[MOST_ROWS // 2] == "..."


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nope.mtx", "b.mtx"], "nope.mtx: no such file"),
        (["text.mtx", "b.mtx"], "text.mtx: is not a Matrix Market file"),
        (
            ["short.mtx", "b.mtx"],
            "short.mtx: 2 x 2 with 3 entries: these take 17 bytes, and the file has 8",
        ),
        (["wide.mtx", "b.mtx"], "wide.mtx: has shape 36 x 35: A must be square"),
        (["complex.mtx", "b.mtx"], "complex.mtx: holds complex numbers"),
        (["nan.mtx", "b.mtx"], "nan.mtx: holds 1 values that are not finite"),
        (["A.mtx", "A.mtx"], "A.mtx: has shape 36 x 36: expected 36 x 1"),
        (
            ["claims.mtx", "b.mtx"],
            "b.mtx: has shape 36 x 1: expected 2000000000 x 1, a number for each row of A",
        ),
        (
            ["A.mtx", "b.mtx", "--upper", "long.mtx"],
            "long.mtx: has shape 2000000000 x 1: expected 36 x 1",
        ),
        (
            ["A.mtx", "b.mtx", "--lower", "1e25"],
            "--lower 1e25: is inf (1e20 and more count as infinite): no x could meet it",
        ),
        (
            ["A.mtx", "b.mtx", "--upper=-inf"],
            "--upper -inf: is -inf (1e20 and more count as infinite)",
        ),
        (["A.mtx", "bnan.mtx"], "bnan.mtx: holds 2 values that are not finite"),
        (["A.mtx", "binf.mtx"], "binf.mtx: holds 1 values that are not finite"),
        (["A.mtx", "b.mtx", "--upper", "bnan.mtx"], "bnan.mtx: holds 2 values that are NaN"),
        (["A.mtx", "b.mtx", "--out", "."], "--out .: is a folder; name a file"),
        (["A.mtx", "b.mtx", "--lower", "none"], "--lower none: neither a number nor a file"),
        (["A.mtx", "b.mtx", "--lower", "2", "--upper", "1"], "lower > upper in 36"),
        (["A.mtx", "b.mtx", "--lower", "nan"], "lower holds 36 NaN"),
        (
            ["A.mtx", "b.mtx", "--method", "lemk"],
            "--method lemk: no such method; did you mean 'lemke'?",
        ),
        (
            ["A.mtx", "b.mtx", "--method", "projected-multigrid"],
            "does not accept sparse matrices; choose from",
        ),
        (["A.mtx", "b.mtx", "--tolerance", "2"], "--tolerance 2.0: must be in [0, 1)"),
        (
            ["A.mtx", "b.mtx", "--max-iterations", "-1"],
            "--max-iterations -1: must be an integer >= 0",
        ),
        (["A.mtx", "b.mtx", "--max-seconds", "0"], "--max-seconds 0.0: must be > 0"),
        (["A.mtx", "b.mtx", "--max-seconds", "nan"], "--max-seconds nan: must be > 0"),
        (
            ["A.mtx", "b.mtx", "--out", "no/where/x.mtx"],
            "--out no/where/x.mtx: no such folder: no/where",
        ),
        (["A.mtx"], "b.mtx"),
    ],
)
def test_wrong_input_exits_with_2(problem, tmp_path, monkeypatch, arguments, expected):
    A, b = problem
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.mtx").write_text("1 2 3\n")
    (tmp_path / "short.mtx").write_text(
        "%%MatrixMarket matrix coordinate real general\n2 2 3\n1 1 1.0\n"
    )
    claims = "%%MatrixMarket matrix coordinate real general\n2000000000 {} 2\n1 1 1.0\n36 1 1.0\n"
    (tmp_path / "claims.mtx").write_text(claims.format(2000000000))
    (tmp_path / "long.mtx").write_text(claims.format(1))
    write(tmp_path / "wide.mtx", A[:, :35])
    write(tmp_path / "complex.mtx", A * 1j)
    broken = A.copy()
    broken.data[3] = np.nan
    write(tmp_path / "nan.mtx", broken)
    write(tmp_path / "bnan.mtx", np.where(np.arange(36) % 30 == 2, np.nan, b))
    write(tmp_path / "binf.mtx", np.where(np.arange(36) == 2, np.inf, b))
    result = call(*arguments)
    assert result.exit_code == 2, result.stdout
    assert expected in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    "text",
    [
        "coordinate real symmetric\n2 2 3\n1 1 2.0\n2 1 -1.0\n2 2 2.0\n",
        "coordinate integer symmetric\n2 2 3\n1 1 2\n2 1 -1\n2 2 2\n",
        "array real symmetric\n2 2\n2.0\n-1.0\n2.0\n",
        "array integer general\n2 2\n2\n-1\n-1\n2\n",
        # Repeated entries are summed.
        "coordinate real general\n2 2 5\n1 1 1.5\n1 1 0.5\n1 2 -1\n2 1 -1\n2 2 2\n",
    ],
)
@pytest.mark.parametrize(
    "right_side", ["array integer general\n2 1\n1\n-5\n", "array real general\n1 2\n1.0\n-5.0\n"]
)
def test_all_forms_of_a_file_mean_the_same(text, right_side, tmp_path):
    """Equivalent forms of a file.

    2 x1 - x2 + 1 and -x1 + 2 x2 - 5 vanish at x = (1, 3).
    """
    for name, content in (("A.mtx", text), ("b.mtx", right_side)):
        (tmp_path / name).write_text(f"%%MatrixMarket matrix {content}")
    result = call(
        tmp_path / "A.mtx", tmp_path / "b.mtx", "--out", tmp_path / "x.mtx", "--tolerance", 1e-12
    )
    assert result.exit_code == 0, result.stderr
    np.testing.assert_allclose(scipy.io.mmread(tmp_path / "x.mtx").ravel(), [1.0, 3.0], atol=1e-10)


@pytest.fixture
def recorded_problem(tmp_path):
    """Return a splash recorded by a run."""
    scene = cut_cells(splash(10))
    fields = {
        "cells": scene.cells,
        "b": scene.b,
        "lower": scene.lower("walls"),
        "upper": np.inf,
        "x0": np.zeros(scene.b.shape),
    }
    np.savez_compressed(
        tmp_path / "problem_000007.npz",
        format=1,
        **fields,
        **scene.faces,
        **dict.fromkeys(NUMBERS, 1.0),
    )
    return scene


def test_a_recorded_problem(recorded_problem, tmp_path):
    file, out = tmp_path / "problem_000007.npz", tmp_path / "x.npy"
    result = call(file, "--out", out, "--tolerance", 1e-10)
    assert result.exit_code == 0, result.stderr
    fluid = recorded_problem.cells == wl.FLUID
    assert (
        f"{fluid.sum()} unknowns, 10 x 10 x 10 cells, by projected-multigrid on cpu"
        in result.stdout
    )
    x, lower = np.load(out), np.where(recorded_problem.wall, 0.0, -np.inf)
    y = recorded_problem.matrix() @ x[fluid] + recorded_problem.b[fluid]
    assert np.abs(np.minimum(x[fluid] - lower[fluid], y)).max() < 1e-6
    # The liquid separates from some walls.
    assert 0 < (x[fluid][np.isfinite(lower[fluid])] == 0.0).sum() < np.isfinite(lower).sum()
    assert (x[~fluid] == 0.0).all()
    by_psor = call(file, "--method", "psor", "--out", out, "--max-iterations", 5)
    assert by_psor.exit_code == 1
    assert "5 iterations" in by_psor.stderr


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["b.mtx"], "b.mtx: problem_000007.npz has a right-hand side of its own"),
        (["--lower", "0"], "--lower 0: problem_000007.npz has bounds of its own"),
        (
            ["--out", "x.mtx"],
            "--out x.mtx: x of a grid is written as a NumPy array: the name must end in .npy",
        ),
        (["--method", "psorr"], "--method psorr: no such method; did you mean 'psor'?"),
        (["--tolerance", "2"], "--tolerance 2.0: must be in [0, 1)"),
    ],
)
def test_wrong_options_of_a_recorded_problem(
    recorded_problem, tmp_path, monkeypatch, arguments, expected
):
    monkeypatch.chdir(tmp_path)
    result = call("problem_000007.npz", *arguments)
    assert result.exit_code == 2
    assert expected in result.stderr


def test_a_damaged_recorded_problem(recorded_problem, tmp_path):
    file = tmp_path / "problem_000007.npz"
    file.write_bytes(file.read_bytes()[:-900])
    result = call(file)
    assert result.exit_code == 2
    assert f"{file}: is not a recorded problem: " in result.stderr


def test_a_pattern_is_a_matrix_of_ones(tmp_path):
    (tmp_path / "A.mtx").write_text(
        "%%MatrixMarket matrix coordinate pattern symmetric\n2 2 2\n1 1\n2 2\n"
    )
    write(tmp_path / "b.mtx", np.array([-2.0, 3.0]))
    assert call(tmp_path / "A.mtx", tmp_path / "b.mtx", "--out", tmp_path / "x.mtx").exit_code == 0
    np.testing.assert_allclose(scipy.io.mmread(tmp_path / "x.mtx").ravel(), [2.0, 0.0], atol=1e-6)
