"""Suite of hostile cases: residual oracle, judgement, wrong solvers, families."""

import json
import time
from collections import Counter

import numpy as np
import pytest
import scipy.sparse
import warp as wp
from typer.testing import CliRunner

import warp_lcp as wl
from default_run import chosen, covering
from oracle import assemble, natural_residual
from warp_lcp.benchmarks import extremes
from warp_lcp.benchmarks.extremes import (
    bounds,
    case,
    matrices,
    rejected_input,
    shapes,
    wrong_methods,
)
from warp_lcp.benchmarks.extremes.case import (
    ExpectedOutcome,
    ExtremeAttempt,
    OutcomeKind,
    RefusalCase,
    SolveCase,
    judge,
    violations,
)
from warp_lcp.benchmarks.extremes.exact import ExactEquations, norm, stencil
from warp_lcp.benchmarks.extremes.problem import GridProblem, MatrixProblem
from warp_lcp.cli import commands as cli

FAST = (
    matrices.singular,
    rejected_input.wrong_arguments,
    shapes.masks,
    shapes.closed_pools,
    matrices.cycling,
)


def wrong(cases):
    """Return a line for each failure."""
    verdicts = [judge(c, precision, "cpu") for c in cases for precision in c.precisions]
    assert verdicts
    return [f"{v.name}: {v.outcome}" for v in verdicts if v.wrong]


@pytest.mark.parametrize("family", chosen(FAST, FAST[:2]), ids=lambda f: f.__name__)
def test_family(family):
    assert wrong(family()) == []


@pytest.mark.slow
@pytest.mark.parametrize("family", extremes.FAMILIES, ids=lambda f: f.__name__)
def test_every_family(family):
    assert wrong(family()) == []


def test_there_are_enough_cases_of_every_kind():
    cases = list(extremes.cases(4217))  # refuses names that occur twice
    kinds = Counter(c.promise(p).expected for c in cases for p in c.precisions)
    assert len(cases) >= 150
    assert set(kinds) == set(OutcomeKind)
    assert kinds[OutcomeKind.EITHER] < 0.35 * sum(kinds.values()), (
        "what may end either way tests little"
    )


@pytest.mark.parametrize(
    ("name", "precision"), covering(list(wrong_methods.SOLVERS), list(case.PRECISIONS))
)
def test_a_wrong_solver_is_caught(name, precision):
    """Expected to solve the problem, as a right one is, see below."""
    for _, make, method in wrong_methods.RIGHT:
        verdict = judge(
            SolveCase("wrong", name, make, method, solve=wrong_methods.SOLVERS[name]),
            precision,
            "cpu",
        )
        assert verdict.wrong
        if name == "steps backwards":
            assert verdict.attempt.status != "CONVERGED"
        else:  # the result claims success; only the independent residual shows the error
            assert verdict.attempt.status == "CONVERGED"
            assert any("CONVERGED at a residual of" in line for line in verdict.wrong)


@pytest.mark.parametrize("precision", case.PRECISIONS)
def test_cases_for_wrong_solvers_pass_with_a_correct_solver(precision):
    for _, make, method in wrong_methods.RIGHT:
        assert judge(SolveCase("right", "right", make, method), precision, "cpu").wrong == []


def test_a_wrong_solver_that_passes_fails_the_suite():
    promise = ExpectedOutcome(OutcomeKind.CAUGHT)
    assert violations(promise, ExtremeAttempt("CONVERGED", 1e-9, met=True)) == [
        "a wrong solver passes"
    ]
    assert violations(promise, ExtremeAttempt("CONVERGED", 1.0, faults=["found"])) == []


@pytest.mark.parametrize(
    ("promise", "attempt", "expected"),
    [
        (case.SOLVED, ExtremeAttempt("CONVERGED", 1e-9, met=True), ""),
        (case.SOLVED, ExtremeAttempt("CONVERGED", 1e-2), "not solved"),
        (case.SOLVED, ExtremeAttempt("STAGNATED", 1e-2), "not solved"),
        (case.SOLVED, ExtremeAttempt("refused", message="b"), "refused: b"),
        (case.refusal("b "), ExtremeAttempt("refused", message="b holds 1 NaN"), ""),
        (
            case.refusal("b "),
            ExtremeAttempt("refused", message="something is wrong"),
            "does not name b ",
        ),
        (case.refusal("b "), ExtremeAttempt("CONVERGED", 0.0, met=True), "not refused"),
        (case.INFEASIBLE, ExtremeAttempt("INFEASIBLE", 1.0), ""),
        (case.INFEASIBLE, ExtremeAttempt("STAGNATED", 1.0), "not INFEASIBLE"),
        (case.EITHER, ExtremeAttempt("FLOOR", 1e-7), ""),
        (case.EITHER, ExtremeAttempt("DIVERGED", 1e7), "DIVERGED"),
        (
            case.EITHER,
            ExtremeAttempt("FLOOR", 1e-7, faults=["says the residual is 0"]),
            "says the residual is 0",
        ),
    ],
)
def test_judgment(promise, attempt, expected):
    found = violations(promise, attempt)
    assert (expected in "; ".join(found)) if expected else found == []


def test_a_case_beyond_its_budget_fails(monkeypatch):
    monkeypatch.setattr(case, "LAST_CALL", 0.0)
    slow = RefusalCase("slow", "slow", lambda device, precision: worked(0.05), "x", budget=0.01)
    assert any("its budget is 0.01 s" in line for line in judge(slow, "mixed", "cpu").wrong)


def test_budgets_exclude_time_of_other_programs(monkeypatch):
    monkeypatch.setattr(case, "LAST_CALL", 0.0)
    waits = RefusalCase(
        "waits", "waits", lambda device, precision: time.sleep(0.2), "x", budget=0.1
    )
    assert not any("budget" in line for line in judge(waits, "mixed", "cpu").wrong)


def worked(seconds):
    """Use CPU time for some seconds."""
    begun = time.process_time()
    while time.process_time() < begun + seconds:
        pass


def random_grid(seed):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 6, rng.integers(2, 4)))
    cells = rng.choice(3, shape, p=[0.2, 0.6, 0.2])
    faces = {}
    for axis, name in enumerate(("face_x", "face_y", "face_z")[: len(shape)]):
        counts = list(shape)
        counts[-1 - axis] += 1
        faces[name] = rng.random(counts) if rng.random() < 0.5 else float(rng.random())
    periodic = tuple(bool(p) for p in rng.random(3) < 0.3)
    for axis, name in enumerate(faces):
        if periodic[axis] and np.ndim(faces[name]):
            faces[name].swapaxes(0, -1 - axis)[-1] = faces[name].swapaxes(0, -1 - axis)[0]
    return cells, faces, rng.random(shape) if rng.random() < 0.5 else None, periodic, rng


@pytest.mark.default_cases(12)
@pytest.mark.parametrize("seed", range(331, 371))
def test_the_matrix_is_that_of_the_oracle(seed):
    cells, faces, shift, periodic, rng = random_grid(seed)
    matrix, fluid = stencil(cells, faces, shift, periodic)
    expected = assemble(cells, tuple(faces.values()), shift, periodic)[np.ix_(fluid, fluid)]
    np.testing.assert_allclose(matrix.toarray(), expected, atol=1e-14)
    n = int(fluid.sum())
    b, x, lower = rng.standard_normal((3, n))
    own = ExactEquations(matrix, b, lower, lower + 1.5)
    assert own.residual(x) == pytest.approx(
        natural_residual(expected, b, lower, lower + 1.5, x), rel=1e-12
    )


def test_bodies_are_in_the_residual():
    rng = np.random.default_rng(373)
    cells, U = np.ones((3, 4), dtype=int), rng.standard_normal((3, 4, 2))
    cells[0, 0] = wl.AIR
    W = np.array([[2.0, 0.5], [0.5, 3.0]])
    problem = GridProblem(cells=cells, b=rng.standard_normal((3, 4)), columns=U, weights=W)
    inside = cells.ravel() == wl.FLUID
    A = (
        assemble(cells)[np.ix_(inside, inside)]
        + U.reshape(12, 2)[inside] @ W @ U.reshape(12, 2)[inside].T
    )
    x, b = rng.standard_normal(11), problem.b.ravel()[inside]
    assert problem.exact().residual(x) == pytest.approx(
        natural_residual(A, b, np.zeros(11), np.full(11, np.inf), x), rel=1e-12
    )


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1.0, 1e160, 1e300])
def test_the_norm_neither_vanishes_nor_overflows(scale):
    assert norm(np.array([3.0, -4.0]) * scale) == pytest.approx(5 * scale)


def test_values_whose_squares_vanish_are_refused():
    """Refusal of values whose squares underflow.

    Without it the status was CONVERGED with a residual of 0, while the true residual was that of
    the start.
    """
    A = wl.DenseOperator(np.array([[2.0, -1.0], [-1.0, 2.0]]), device="cpu")
    for tiny in (1e-150, -1e-170, 1e-310):
        with pytest.raises(ValueError, match="b: largest value"):
            wl.solve(wl.LCP(A, np.array([tiny, -abs(tiny)])))
        with pytest.raises(ValueError, match="lower, upper: largest value"):
            wl.solve(wl.LCP(A, np.zeros(2), lower=abs(tiny)))
        assert wl.solve(
            wl.LCP(A, np.array([tiny, -abs(tiny)])), stopping=wl.StoppingCriteria(atol=1e-30)
        )
    assert wl.solve(wl.LCP(A, np.zeros(2)))
    assert wl.solve(wl.LCP(A, np.array([-1e-100, 1e-130])))


def test_a_tolerance_below_what_float32_holds_costs_few_iterations():
    """End of linear solves that no longer reduce the residual.

    Without it each runs to its limit: 3,236 iterations.
    """
    problem = bounds.pool((96, 96)).lcp("cpu", wp.float32)
    result = wl.solve(
        problem, wl.MinimumMapNewton(precision="single"), stopping=wl.StoppingCriteria(rtol=1e-13)
    )
    assert result.status is wl.SolveStatus.FLOOR
    assert result.relative_residual < 1e-5
    assert result.linear_iterations < 1500


def test_precisions_are_those_that_a_method_has():
    def problem():
        return MatrixProblem(matrix=scipy.sparse.eye_array(3).tocsr(), b=-np.ones(3))

    assert SolveCase("a", "b", problem, "lemke").precisions == ("double",)
    assert SolveCase("a", "b", problem, "minimum-map-newton").precisions == (
        "single",
        "mixed",
        "double",
    )


@pytest.mark.slow
def test_the_whole_suite(tmp_path):
    result = CliRunner().invoke(
        cli.app, ["bench", "extremes", "--device", "cpu", "--out", str(tmp_path), "--repeat", "1"]
    )
    assert result.exit_code == 0, result.stderr
    records = [
        r for r in json.loads((tmp_path / "extremes.json").read_text()) if r["name"] != "machine"
    ]
    assert sum(r["figures"]["cases"]["value"] for r in records) >= 900
    assert all(r["figures"]["wrong"]["value"] == 0 for r in records)
    report = (tmp_path / "extremes.md").read_text()
    assert "| family | case | expected | single | mixed | double | as it must be? |" in report
    assert "| NO |" not in report
