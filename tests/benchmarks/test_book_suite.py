"""Suite of the book's experiments at its smallest size, and its findings.

Solutions of the recipes, convergence tests and semi-definite problems.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import warp_lcp as wl
from warp_lcp.benchmarks import book
from warp_lcp.benchmarks.book import appendix_c, contact_scenes, outcome, studies
from warp_lcp.benchmarks.book.outcome import BookLimits, IterateTrace, Merit, follow
from warp_lcp.benchmarks.book.problems import ProblemScale, contact_matrix, dense, kinds
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.gallery import contact_scenes as gallery

SMALL = ProblemScale.of(Options("cpu", (8,), 1, print))


@pytest.mark.slow
def test_the_suite_runs_every_experiment(monkeypatch, tmp_path):
    kept = {name: gallery.SCENES[name] for name in ("sphere-stack", "incline")}
    monkeypatch.setattr(gallery, "SCENES", kept)
    monkeypatch.setattr(contact_scenes.contacts, "SCENES", kept)
    few = [
        (contact_scenes, "ORDERED", ("sphere-stack",)),
        (contact_scenes, "ROUNDS", 20),
        (studies, "ZEROS", (0.0, 0.8)),
    ]
    few += [
        (appendix_c, "FACTORS", (1.0, 1.4)),
        (appendix_c, "SHARES", (0.95, 1.0)),
        (appendix_c, "SWEEPS", 200),
    ]
    few += [
        (appendix_c, "KINKS", {name: appendix_c.KINKS[name] for name in ("zero", "perturbation")})
    ]
    few += [
        (
            studies,
            "SEMIDEFINITE",
            {name: appendix_c.METHODS[name] for name in ("PGS", "FischerNewton()")},
        )
    ]
    for module, name, value in few:
        monkeypatch.setattr(module, name, value)
    results = book.measure(Options("cpu", (8,), 1, lambda text: None), tmp_path)
    records = {record.name: record for record in results.records}
    assert records["planted: fluid, recipe"].value("infeasible") == SMALL.problems
    for kind in kinds(SMALL):
        assert records[f"{kind}: FischerNewton()"].value("solved") == SMALL.problems
    assert records["kinks: fluid, 7-point, planted: perturbation"].value("solved") == SMALL.problems
    assert (
        records["lambda: contact, rigid bodies, safeguarded: 0.95"].value("solved")
        == SMALL.problems
    )
    assert records["omega: splash 8^3, p >= 0"].value("best") > 1
    assert records["cost: contacts of rigid bodies: Lemke: 24"].value("steps") >= 1
    assert records["warm: planted: minimum map from 0"].value("accepted") == SMALL.problems
    assert records["zeros: planted: 80%"].value("solvable") == 2
    assert records["scenes: incline: PGS-SM"].value("residual") < 1e-10
    assert (
        records["orders: sphere-stack"].value("extreme staggered")
        < 1e-6
        < records["orders: sphere-stack"].value("PGS")
    )
    assert {chart.name for chart in results.charts} == {
        "c1-patterns",
        "c2-convergence",
        "c3-kinks",
        "c4-omega",
        "c5-cost",
        "c6-warm",
        "lambda",
        "zeros",
        "2-3-orders",
        "2-10-scenes",
    }
    assert all(len(row) == len(table.columns) for table in results.tables for row in table.rows)


@pytest.mark.parametrize("kind", list(kinds(SMALL)))
def test_planted_solutions_are_solutions_and_those_of_the_recipes_are_not(kind):
    for k in range(5):
        p = kinds(ProblemScale(5, 4, 5, 12, (8,), (2,), 10))[kind](k)
        if p.solution is None:
            continue
        y = p.A @ p.solution + p.b
        assert (p.solution >= 0).all()
        assert_allclose(p.solution * y, 0, atol=1e-12)
        infeasible = y.min() < -1e-3
        # Of most contacts.
        assert infeasible == (kind == "fluid, recipe") or kind == "contact, recipe"


def test_the_fluid_recipe_has_no_active_bounds():
    """Positive solution of the linear system for the fluid recipe.

    The matrix is an M-matrix, b <= 0 where x > 0 and b = 0 elsewhere, so nothing is complementary.
    """
    p = kinds(SMALL)["fluid, recipe"](3)
    x = np.linalg.solve(p.A.toarray(), -p.b)
    assert x.min() > 0
    solved = (
        wl.solve(p.lcp(device="cpu"), wl.Lemke(), stopping=wl.StoppingCriteria(rtol=1e-10))
        .x.numpy()
        .ravel()
    )
    assert_allclose(solved, x, rtol=1e-8)


def test_the_contact_recipe_has_the_pattern_of_stewart_and_trinkle_on_its_diagonal_blocks():
    A = contact_matrix(7, np.random.default_rng(5150))
    for k in range(0, 42, 6):
        block = A[k : k + 6, k : k + 6]
        if block.any():
            assert_allclose(block[5], [0.5, -1, -1, -1, -1, 0])
            assert_allclose(block[:, 5], [0, 1, 1, 1, 1, 0])


def test_the_book_s_stopping_test_accepts_wrong_solutions():
    p = kinds(ProblemScale(5, 4, 10, 12, (8,), (2,), 10))["contact, recipe"](0)
    trace = follow(p, appendix_c.PGS, Merit.PRODUCT, "cpu")
    state, _, residual = trace.verdict(Merit.PRODUCT, BookLimits())
    assert state == "absolute"
    assert residual > 0.01
    assert trace.solved is None


@pytest.mark.parametrize("zeros", [0.0, 0.6, 0.8])
def test_the_recipe_with_many_zero_eigenvalues_has_no_solution(zeros):
    scale = ProblemScale(5, 4, 5, 60, (8,), (2,), 10)
    for k in range(3):
        assert studies.solvable(dense("recipe", scale, k, zeros)) == (zeros == 0)
        planted = dense("planted", scale, k, zeros)
        assert studies.solvable(planted)
        result = wl.solve(
            planted.lcp(device="cpu"), wl.FischerNewton(), stopping=wl.StoppingCriteria(rtol=1e-8)
        )
        assert result
        x = result.x.numpy().ravel()
        assert np.abs(np.minimum(x, planted.A @ x + planted.b)).max() < 1e-5


def test_statuses_agree_with_num4lcp():
    def trace(merits, status=wl.SolveStatus.MAX_ITERATIONS):
        return IterateTrace(merits, [1.0] * len(merits), status)

    assert trace([9.0, 1.0, 1e-4]).verdict(Merit.FISCHER, BookLimits())[:2] == ("absolute", 3)
    assert trace([9.0, 1.0, 1.0]).verdict(Merit.FISCHER, BookLimits())[:2] == ("relative", 3)
    # Sweeps are tested after each one.
    assert trace([9.0, 1.0, 1e-4]).verdict(Merit.PRODUCT, BookLimits())[:2] == ("absolute", 2)
    assert trace([9.0, 8.0, 7.0]).verdict(Merit.FISCHER, BookLimits(most=2))[:2] == (
        "max iterations",
        2,
    )
    assert trace([9.0, 1.0], wl.SolveStatus.NON_DESCENT).verdict(Merit.MINIMUM, BookLimits())[
        :2
    ] == ("non-descent", 2)
    assert outcome.spread([1, 2, 3]) == "2.00 (1 to 3, 0.82)"
