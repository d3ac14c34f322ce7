"""Hostile inputs by seed: judgement of wrong answers, and cases of each kind.

Each case is solved or refused.
"""

from dataclasses import replace

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.benchmarks.hostile import KINDS, attempt, draw, draw_case, examine, judge
from warp_lcp.benchmarks.hostile.__main__ import FAULTS, report, supervise
from warp_lcp.benchmarks.hostile.case import (
    ExpectedArrays,
    HostileAnswer,
    HostileBox,
    HostileCase,
    HostileProgram,
    MalformedInput,
)
from warp_lcp.benchmarks.hostile.judge import exists, residual, scales

qpsolvers = pytest.importorskip("qpsolvers")

SEED = 4721
A = np.array([[2.0, 1.0], [1.0, 2.0]])


def box(b, **known):
    given = {"A": A, "lower": np.zeros(2), "upper": np.full(2, np.inf), "definite": True, **known}
    return HostileBox(b=np.array(b), **given)


def categories(truth, answer, method=None):
    return [
        category for category, _ in judge(HostileCase("", lambda: answer, truth, method), answer)
    ]


@pytest.mark.parametrize("large", [1.0, 1e8, 1e16])
def test_a_wrong_x_is_a_false_convergence(large):
    """False convergence at a wrong x.

    b = (-1, large) has the solution x = (1/2, 0), however large the inactive row is.
    """
    truth = box([-1.0, large], solution=np.array([0.5, 0.0]), solvable=True, unique=True)
    assert categories(truth, HostileAnswer("CONVERGED", np.array([0.5, 0.0]))) == ["converged"]
    for wrong in ([0.0, 0.0], [0.49, 0.0], [0.5, 0.01], [-0.5, 0.0], [np.nan, 0.0]):
        assert categories(truth, HostileAnswer("CONVERGED", np.array(wrong))) == [
            "FALSE CONVERGED"
        ], wrong


def test_signs_at_upper_bounds_and_in_equations():
    truth = box([-9.0, 0.0], lower=np.array([0.0, -np.inf]), upper=np.array([1.0, np.inf]))
    # y = (-7.5, 0)
    assert categories(truth, HostileAnswer("CONVERGED", np.array([1.0, -0.5]))) == ["converged"]
    assert categories(
        replace(truth, b=np.array([9.0, 0.0])), HostileAnswer("CONVERGED", np.array([1.0, -0.5]))
    ) == ["FALSE CONVERGED"]


def test_a_small_row_hidden_by_large_ones_is_reported():
    """Report of a row that others hide.

    x_1 = 0 is wrong in its own row, but only 1e-12 of the norm to which the tolerance is relative.
    """
    truth = HostileBox(
        A=np.eye(2),
        b=np.array([-1.0, -1e12]),
        lower=np.zeros(2),
        upper=np.full(2, np.inf),
        definite=True,
    )
    assert categories(truth, HostileAnswer("CONVERGED", np.array([0.0, 1e12]))) == [
        "converged",
        "row hidden",
    ]
    assert categories(truth, HostileAnswer("CONVERGED", np.array([1.0, 1e12]))) == ["converged"]


def test_a_false_infeasible_status_is_detected():
    """Detection of a false INFEASIBLE.

    It is detected by the planted solution, by a linear program for monotone A, and by enumeration.
    """
    claim = HostileAnswer("INFEASIBLE", np.zeros(2))
    assert categories(box([-1.0, 1.0], solvable=True), claim) == ["FALSE INFEASIBLE"]
    assert categories(box([-1.0, 1.0]), claim) == ["FALSE INFEASIBLE"]
    assert categories(box([-1.0, 1.0], definite=False), claim) == ["FALSE INFEASIBLE"]
    # -2 x_1 - x_2 - 1 >= 0
    assert categories(box([-1.0, 0.0], A=-A, definite=False), claim) == ["infeasible right"]
    assert categories(box([-1.0, 0.0], A=np.zeros((2, 2))), claim) == ["infeasible right"]
    assert exists(box([-1.0, 0.0], A=-A, definite=False, upper=np.ones(2)))


def test_failure_statuses_are_not_counted_as_false_answers():
    known = box([-1.0, 1.0], solvable=True)
    assert categories(known, HostileAnswer("STAGNATED", np.zeros(2))) == ["not solved"]
    assert categories(known, HostileAnswer("STAGNATED", np.zeros(2)), "psor") == ["other method"]
    assert categories(replace(known, solvable=False), HostileAnswer("STAGNATED", np.zeros(2))) == [
        "honest"
    ]
    assert categories(known, HostileAnswer("REFUSED", None)) == ["refused"]
    assert categories(MalformedInput("no matrix"), HostileAnswer("REFUSED", None)) == ["honest"]
    assert categories(MalformedInput("no matrix"), HostileAnswer("CONVERGED", np.zeros(2))) == [
        "FALSE CONVERGED"
    ]


def test_scales_hardly_depend_on_units():
    """Approximate independence of the scale from units.

    d = 1 / (r c) becomes about s_i d_i if rows are scaled by s. Ruiz's limit depends on its start.
    """
    rng = np.random.default_rng(SEED)
    M, b, s = rng.standard_normal((5, 5)), rng.standard_normal(5), 10.0 ** rng.integers(-6, 6, 5)
    plain = HostileBox(A=M, b=b, lower=np.zeros(5), upper=np.full(5, np.inf))
    other = replace(plain, A=draw.scaled(M, s, np.ones(5)), b=s * b)
    x = np.abs(rng.standard_normal(5))
    for one, two in (
        (scales(other), s * scales(plain)),
        (residual(other, x, scales(other)), s * residual(plain, x, scales(plain))),
    ):
        assert np.all((one / two > 0.1) & (one / two < 10))


def test_programs_are_judged_in_plain_units():
    pytest.importorskip("clarabel", reason="the judge's second opinion")
    pytest.importorskip("piqp")
    one = np.ones((1, 1))
    plain = qpsolvers.Problem(one, -np.ones(1), G=one, h=np.array([0.5]))  # minimum at x = 0.5
    truth = HostileProgram(scaled=plain, plain=plain, expected="solvable", unique=True)
    assert categories(truth, HostileAnswer("CONVERGED", np.array([0.5]))) == ["converged"]
    for wrong in (0.4, 0.6, 0.0, 1.0):
        assert categories(truth, HostileAnswer("CONVERGED", np.array([wrong]))) == [
            "FALSE CONVERGED"
        ]
    assert categories(truth, HostileAnswer("INFEASIBLE", None)) == ["FALSE INFEASIBLE"]
    assert categories(
        replace(truth, expected="unbounded"), HostileAnswer("CONVERGED", np.array([0.5]))
    ) == ["FALSE CONVERGED"]


def test_values_and_exceptions():
    truth = ExpectedArrays({"b": np.array([1.0, -2.0])}, 1e-6)
    assert categories(
        truth, HostileAnswer("CONVERGED", None, "", {"b": np.array([1.0, -2.0])})
    ) == ["converged"]
    assert categories(truth, HostileAnswer("CONVERGED", None, "", {"b": np.array([1.0, 2.0])})) == [
        "FALSE CONVERGED"
    ]

    def fail():
        raise np.linalg.LinAlgError("from inside")

    assert attempt(HostileCase("", fail, truth)).status == "EXCEPTION"
    refused = attempt(HostileCase("", lambda: wl.LCP(A, np.array([np.nan, 1.0])), truth))
    assert (refused.status, "b" in refused.note) == ("REFUSED", True)


def test_the_stencil_oracle_follows_the_definition():
    """Oracle of the stencil's definition.

    A closed side adds its coefficient to the diagonal; AIR adds nothing there.
    """
    coefficients = {
        (0, 0): np.full((1, 2), 20.0),
        (0, 1): np.array([[-1.0, -5.0]]),
        (0, -1): np.array([[-3.0, -1.0]]),
    }
    cells = np.ones((1, 2), int)
    closed = draw.stencil_matrix(cells, coefficients, None, (False,) * 3, draw.SOLID).toarray()
    assert np.array_equal(closed, [[17.0, -1.0], [-1.0, 15.0]])
    open_ = draw.stencil_matrix(cells, coefficients, None, (False,) * 3, draw.AIR).toarray()
    assert np.array_equal(open_, [[20.0, -1.0], [-1.0, 20.0]])
    values = np.zeros((3, 4))
    values[1, 0], values[1, 3] = 1.0, 10.0
    assert np.array_equal(
        draw.boundary_term(cells, coefficients, values, (False,) * 3, draw.AIR), [[-3.0, -50.0]]
    )
    around = draw.stencil_matrix(
        np.ones((1, 3), int), {(0, 0): 5.0, (0, 1): -2.0}, 1.0, (True, False, False), draw.SOLID
    ).toarray()
    assert np.array_equal(around, [[6.0, -2.0, 0.0], [0.0, 6.0, -2.0], [-2.0, 0.0, 6.0]])


@pytest.mark.parametrize("kind", KINDS)
def test_a_case_repeats_for_its_seed(kind):
    names = {draw_case(kind, SEED, i).name for i in range(6)}
    assert names == {draw_case(kind, SEED, i).name for i in range(6)}
    assert len(names) > 3


def test_planted_solutions_solve():
    """Planted solutions that meet the criterion.

    Otherwise verdicts on them are meaningless.
    """
    rng, planted = np.random.default_rng(SEED), 0
    for kind in KINDS:
        for _ in range(8):
            case = KINDS[kind](rng)
            if isinstance(case.truth, HostileBox) and case.truth.solution is not None:
                assert (
                    categories(case.truth, HostileAnswer("CONVERGED", case.truth.solution))[0]
                    == "converged"
                ), case.name
                planted += 1
    assert planted > 30


SOLVED = {
    "rows": (1, 3),
    "infinity": (0, 2),
    "program": (0, 1),
    "solid": (0, 1),
    "gradients": (1, 2),
    "singular": (0, 2),
    "narrow": (1, 4),
    "sign": (1, 4),
    "low-rank": (0, 5),
    "friction": (0, 4),
    "malformed": (1, 2),
    "periodic": (3, 4),
    "odd": (1, 2),
}


@pytest.mark.parametrize(("kind", "index"), [(kind, i) for kind in KINDS for i in SOLVED[kind]])
def test_cases_are_solved_or_correctly_refused(kind, index):
    _, verdicts = examine(draw_case(kind, SEED, index))
    assert [v for v in verdicts if v[0] in (*FAULTS, "not solved", "refused")] == []


def test_a_worker_streams_the_results_of_its_cases():
    outcomes = supervise("narrow", SEED, 2)
    assert [o.index for o in outcomes] == [0, 1]
    assert all(o.verdicts for o in outcomes)
    page = report(outcomes, SEED)
    assert "| narrow | 2 |" in page and "| all | 2 |" in page
