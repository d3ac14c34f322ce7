"""The book's experiments: recipes, the book's tests of convergence, and figures that follow from the CSV files."""

import csv
import json
import math
import statistics

import numpy as np
import pytest
import scipy.optimize
from typer.testing import CliRunner

import warp_lcp as wl
from warp_lcp.benchmarks.book.problems import Scale, contact_matrix, contacts, definite_matrix, fluids, properly, recipe
from warp_lcp.benchmarks.book.robustness import FISCHER
from warp_lcp.benchmarks.book.sizes import exponent
from warp_lcp.benchmarks.book.traces import Merit, Trace, follow, judge, spread
from warp_lcp.benchmarks.timing import Options
from warp_lcp.cli import commands as cli
from warp_lcp.gallery.banded import banded_matrix

STATUS = wl.SolveStatus


def rng(seed=977):
    return np.random.default_rng(seed)


def least_squares(A, b):
    """Solve a symmetric positive definite LCP as min |L'x + L^-1 b| over x >= 0: an oracle that shares nothing with the library."""
    L = np.linalg.cholesky(A)
    return scipy.optimize.nnls(L.T, -np.linalg.solve(L, b))[0]


def test_recipe_plants_no_solution():
    A = banded_matrix(60, 3, rng())
    problem = recipe(A, generator := rng(), "recipe")
    x = rng().random(60)
    x[x < 0.25] = 0  # the same draw: what the recipe takes for a solution
    assert generator.random() != rng().random()
    y = A @ x + problem.b
    assert (y[x == 0] < -0.01).all(), "an M-matrix gives y < 0 at every zero of x"
    assert abs(y[x > 0]).max() < 1e-12
    assert np.mean(least_squares(A.toarray(), problem.b) <= 1e-9) < 0.05, "its true solution has nearly no active unknown"


def test_properly_planted_solution_is_one():
    A = banded_matrix(60, 3, rng())
    problem = properly(A, rng(), "planted")
    x = problem.solution
    assert abs(np.minimum(x, A @ x + problem.b)).max() < 1e-12
    assert 0.1 < np.mean(x == 0) < 0.45
    assert np.allclose(least_squares(A.toarray(), problem.b), x, atol=1e-9)


def test_contact_matrix_has_the_pattern_and_is_no_contact_of_bodies():
    A = contact_matrix(8, rng())
    blocks = A.reshape(8, 6, 8, 6).transpose(0, 2, 1, 3)
    kept = blocks[:, :, 0, 0] != 0
    assert 0.2 < kept.mean() < 0.8
    for i, j in np.argwhere(kept):
        block = blocks[i, j]
        assert (block[5, 0], block[5, 5], block[0, 5]) == (0.5, 0, 0)
        assert (block[5, 1:5] == -1).all()
        assert (block[1:5, 5] == 1).all()
    assert (blocks[~kept] == 0).all()


def test_definite_matrix_has_the_spectrum():
    values = np.linalg.eigvalsh(definite_matrix(10, rng(), zeros=0.3))
    assert np.allclose(values, [0, 0, 0, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0], atol=1e-12)


def test_merits():
    x, y = np.array([3.0, 0.0]), np.array([4.0, -2.0])
    assert Merit.FISCHER.of(x, y) == pytest.approx(0.5 * ((5 - 7) ** 2 + (2 + 2) ** 2))
    assert Merit.MINIMUM.of(x, y) == pytest.approx(0.5 * (9 + 4))
    assert Merit.PRODUCT.of(x, y) == pytest.approx(12.0), "y < 0 where x = 0 costs nothing"


def trace(merits, steps=None, status=STATUS.CONVERGED):
    return Trace(merits, [10.0, *merits[1:]], ["start", *(steps or ["newton"] * (len(merits) - 1))], status)


@pytest.mark.parametrize(
    ("given", "merit", "expected"),
    [
        (trace([10, 1, 1e-4]), Merit.MINIMUM, ("absolute", 3)),  # tested before each step: the start is number 1
        (trace([10, 1, 1e-4]), Merit.PRODUCT, ("absolute", 2)),  # tested after each sweep
        (trace([0, 1, 1e-4]), Merit.PRODUCT, ("absolute", 2)),  # x = 0 at the start is not tested
        (trace([10, 1, 1 - 1e-9, 1e-4]), Merit.MINIMUM, ("relative", 3)),
        (trace([10, 1, 0.5], ["newton", "proximal point"]), Merit.MINIMUM, ("non-descent", 3)),
        (trace([10, 1], status=STATUS.LOCAL_MINIMUM), Merit.FISCHER, ("local minimum", 2)),
        (trace([10, *(5.0 + (-1) ** k for k in range(200))]), Merit.PRODUCT, ("max iterations", 100)),
    ],
)
def test_the_books_tests(given, merit, expected):
    verdict = judge(given, merit)
    assert (verdict.state, verdict.iterations) == expected


def test_solved_is_judged_by_the_natural_residual():
    assert Trace([], [8.0, 1.0, 8e-6, 8.1e-6], [], STATUS.CONVERGED).solved == 2
    assert Trace([], [8.0, 1.0], [], STATUS.CONVERGED).solved is None


def test_follow_sees_the_iterates():
    problem = properly(definite_matrix(12, rng()), rng(), "small")
    found = follow(problem, FISCHER, Merit.MINIMUM, device="cpu")
    assert len(found.merits) == len(found.residuals) == len(found.steps)
    assert found.merits[0] == pytest.approx(0.5 * np.sum(np.minimum(0, problem.b) ** 2))
    assert found.merits[-1] < 1e-10


def test_every_kind_of_problem_is_of_the_books_size():
    scale = Scale.of(Options("cpu", (), 5, print))
    assert (scale.problems, scale.side**3, 6 * scale.contacts) == (100, 1000, 180)
    small = Scale.of(Options("cpu", (16,), 1, print))
    sizes = [make(0).b.size for make in (*fluids(small).values(), *contacts(small).values())]
    assert sizes == [64, 64, 64, 24, 24, 24]


def test_exponent_and_spread():
    assert exponent([10, 100, 1000], [2 * n**1.5 for n in (10, 100, 1000)]) == pytest.approx(1.5)
    assert spread([4, 6]) == "5.00 (4 to 6, 1.00)"


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("book")
    options = ["--suite", "book", "--size", "8", "--size", "12", "--repeat", "1", "--out", str(out)]
    called = CliRunner().invoke(cli.app, ["bench", "solvers", *options])
    assert called.exit_code == 0, called.stderr
    assert str(out / "book-robustness.csv") in called.stdout
    return out


def sheet(results, name):
    with (results / f"book-{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def records(results):
    kept = json.loads((results / "book.json").read_text())
    return {r["name"]: r for r in kept}


def test_files(results):
    text = (results / "book.md").read_text()
    for title in (
        "What the book concludes",
        "Cost against size",
        "Convergence",
        "Kink",
        "Relaxation",
        "Robustness",
        "Warm",
        "Overdetermined",
    ):
        assert f"## {title}" in text
    images = {p.name for p in results.glob("book-*.png")}
    assert {"book-warm.png", "book-zeros.png", "book-sizes-grid.png", "book-psor-0.png", "book-kinks-contact.png"} <= images
    assert all(f"]({name})" in text for name in images)


def test_robustness_follows_from_its_rows(results):
    found, rows = records(results), sheet(results, "robustness")
    groups = {(r["problems"], r["method"]) for r in rows}
    assert len(groups) == 3 * 8 + 3 * 8
    for kind, method in groups:
        of_method = [r for r in rows if (r["problems"], r["method"]) == (kind, method)]
        record = found[f"robustness: {kind}: {method}"]
        figures = {name: f["value"] for name, f in record["figures"].items()}
        accepted = [int(r["iterations"]) for r in of_method if r["state"] in ("relative", "absolute")]
        solved = [int(r["steps to 1e-6"]) for r in of_method if r["steps to 1e-6"]]
        assert (figures["problems"], figures["accepted"], figures["solved"]) == (len(of_method), len(accepted), len(solved))
        assert figures["residual"] == pytest.approx(max(float(r["residual there"]) for r in of_method), rel=0.06)
        if accepted:
            assert figures["iterations"] == statistics.fmean(accepted)
        if solved:
            assert figures["steps"] == statistics.fmean(solved)
        converged = [r for r in of_method if r["status"] == "CONVERGED"]
        assert all(float(r["last residual"]) <= 1e-6 and r["steps to 1e-6"] for r in converged)


def test_convergence_follows_from_its_rows(results):
    found, rows = records(results), sheet(results, "convergence")
    curves = {}
    for r in rows:
        if r["experiment"] == "methods":
            curves.setdefault((r["problem"], r["method"]), []).append((int(r["iteration"]), float(r["relative residual"])))
    assert {method for _, method in curves} >= {"projected-multigrid", "psor", "fischer-newton", "lemke", "interior-point", "mprgp"}
    for (problem, method), curve in curves.items():
        figures = found[f"convergence: {problem}: {method}"]["figures"]
        reached = [k for k, residual in curve if residual <= 1e-6]
        assert ("to 1e-6" in figures) == bool(reached)
        if reached:
            assert figures["to 1e-6"]["value"] == min(reached)
        assert figures["residual"]["value"] <= min(r for _, r in curve) * 1.001


def test_exponents_follow_from_the_sizes(results):
    found, rows = records(results), sheet(results, "sizes")
    for method in ("ProjectedMultigrid", "PSOR 1.4"):
        pair = [(float(r["unknowns"]), float(r["seconds of a step"])) for r in rows if (r["problem"], r["method"]) == ("grid", method)]
        (a, s), (b, t) = pair
        assert found[f"cost: grid: {method}"]["figures"]["step exponent"]["value"] == pytest.approx(
            math.log(t / s) / math.log(b / a), abs=5e-3
        )


def test_starts_follow_from_their_rows(results):
    found = records(results)
    warm = sheet(results, "warm")
    for start in ("cold", "warm"):
        counts = [int(r["iterations"]) for r in warm if (r["b"], r["method"], r["start"]) == ("planted", "minimum map, book", start)]
        assert found[f"warm starting: planted: minimum map, book: {start}"]["figures"]["iterations"]["value"] == statistics.fmean(counts)
    zeros = sheet(results, "zeros")
    for share in ("0", "0.8"):
        rows = [r for r in zeros if (r["b"], r["zeros"], r["method"]) == ("planted", share, "PGS")]
        label = f"overdetermined: planted: {float(share):.0%}: PGS"
        assert found[label]["figures"]["solved"]["value"] == sum(bool(r["steps to 1e-6"]) for r in rows)
        assert found[label.replace("PGS", "solvable")]["figures"]["problems"]["value"] == len(rows), "planted problems have a solution"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["kernels", "--suite", "book"], "the suite kernels has no such group"),
        (["solvers", "--group", "books"], "has no such group; choose from book"),
        (["solvers", "--suite", "book", "--method", "psor"], "cannot be combined"),
    ],
)
def test_wrong_groups_exit_with_2(arguments, expected):
    result = CliRunner().invoke(cli.app, ["bench", *arguments])
    assert result.exit_code == 2
    assert expected in result.stderr
