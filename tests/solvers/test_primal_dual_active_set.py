"""Primal-dual active-set method.

Planted problems, the cycle of period three, boxes, and the fallback after a cycle.
"""

import itertools

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import boxed, lemke, natural_residual
from warp_lcp.gallery import (
    PlantedSolution,
    banded,
    contact,
    definite,
    period_three,
    poisson,
    skewed,
    splash,
)
from warp_lcp.solvers.primal_dual_active_set import LOWER, PrimalDualActiveSet, _basic_solution
from warp_lcp.subproblems.dense_problem import DenseProblem

TIGHT = wl.StoppingCriteria(rtol=1e-10)


@pytest.mark.parametrize(
    "plant",
    [
        PlantedSolution(),
        PlantedSolution(active=0.8, weak=0.5),
        PlantedSolution(boxed=True, mixed=0.2, active=0.5),
    ],
)
@pytest.mark.parametrize(
    "make",
    [
        lambda plant: poisson((9, 7, 5), plant=plant, dtype=wp.float64, device="cpu"),
        lambda plant: banded(80, plant=plant),
    ],
)
def test_m_matrices_in_few_steps(make, plant):
    p = make(plant)
    for problem in (p, p.sparse(), p.dense()):
        result = wl.solve(problem.lcp(device="cpu"), PrimalDualActiveSet(), stopping=TIGHT)
        assert result, result.status
        assert result.iterations <= 16
        np.testing.assert_allclose(result.x.numpy(), problem.solution, atol=1e-7)


def test_the_set_found_is_the_planted_one_and_the_last_step_ends_it():
    p = definite(40, condition=10, plant=PlantedSolution(active=0.5), seed=3)
    result = wl.solve(p.lcp(device="cpu"), PrimalDualActiveSet(), stopping=TIGHT)
    assert result, result.status
    np.testing.assert_array_equal(result.x.numpy() == 0, p.solution == 0)
    assert result.history[-1].active == np.count_nonzero(p.solution == 0)
    assert {r.step for r in result.history} == {"start", "active set"}


def test_period_three_from_every_set():
    p = period_three()
    problem = p.lcp(device="cpu")
    names = set()
    for signs in itertools.product((0.0, 10.0), repeat=3):
        result = wl.solve(problem, PrimalDualActiveSet(), x0=np.array(signs), stopping=TIGHT)
        assert result, (signs, result.status)
        np.testing.assert_allclose(result.x.numpy(), p.solution, atol=1e-10)
        names |= {r.step for r in result.history}
    assert "least index" in names  # some starts do cycle


@pytest.mark.parametrize("boxes", [False, True])
def test_period_three_blocks_from_random_starts(boxes):
    rng = np.random.default_rng(71)
    cycled = 0
    for seed in range(40):
        p = period_three(2, plant=PlantedSolution(active=rng.random(), boxed=boxes), seed=seed)
        result = wl.solve(
            p.lcp(device="cpu"), PrimalDualActiveSet(), x0=rng.uniform(0, 5, 6), stopping=TIGHT
        )
        assert result, (seed, result.status)
        np.testing.assert_allclose(result.x.numpy(), boxed(p.A, p.b, p.lower, p.upper), atol=1e-8)
        cycled += result.history[-1].step == "least index"
    assert cycled > 0


def test_unsymmetric_p_matrix_against_lemke():
    for seed in range(10):
        p = skewed(30, skew=3.0, seed=seed)
        result = wl.solve(p.lcp(device="cpu"), PrimalDualActiveSet(), stopping=TIGHT)
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), lemke(p.A, p.b), atol=1e-7)


def test_contacts_are_solved_or_reported():
    solved = 0
    for seed in range(10):
        p = contact(4, seed=seed)
        result = wl.solve(p.lcp(device="cpu"), PrimalDualActiveSet())
        own = natural_residual(p.A, p.b, p.lower, p.upper, result.x.numpy())
        assert bool(result) == (
            own <= 1e-6 * natural_residual(p.A, p.b, p.lower, p.upper, np.zeros(len(p.b)))
        )
        solved += bool(result)
    assert solved >= 1  # their matrices are no P-matrices: there is no guarantee


def test_splash_takes_as_few_steps_as_newton():
    for bounds in ("walls", "everywhere"):
        problem = splash(32).named(bounds, device="cpu").lcp()
        ours, newton = (
            wl.solve(problem, m) for m in (PrimalDualActiveSet(), wl.MinimumMapNewton())
        )
        assert ours, ours.status
        assert ours.iterations <= newton.iterations + 1
        np.testing.assert_allclose(
            ours.x.numpy(), newton.x.numpy(), atol=1e-4 * np.abs(newton.x.numpy()).max()
        )


def test_settings_are_checked():
    with pytest.raises(ValueError, match="eta"):
        PrimalDualActiveSet(eta=0.0)
    with pytest.raises(ValueError, match="monotone_cycles"):
        PrimalDualActiveSet(monotone_cycles=-1)


def whole_steps(A, b, lower, upper):
    """Return whether plain steps in NumPy converge, by the repetition of a set.

    The repeated set is the last one, or the steps cycle. Also return the number of changes of sides
    alone.
    """
    x, d, seen = np.clip(np.zeros(len(b)), lower, upper), np.diag(A), []
    while True:
        target = x - (A @ x + b) / d
        place = np.where(target < lower, -1, np.where(target > upper, 1, 0))
        if any((place == other).all() for other in seen):
            turned = sum(
                ((one == 0) == (other == 0)).all() for one, other in itertools.combinations(seen, 2)
            )
            return (place == seen[-1]).all(), turned
        seen.append(place)
        free, x = place == 0, np.where(place < 0, lower, np.where(place > 0, upper, 0.0))
        x[free] = np.linalg.solve(A[np.ix_(free, free)], -(b + A @ x)[free])


def test_an_unknown_that_turns_to_its_other_bound_makes_another_set():
    """Unknown that moves to its other bound: another set.

    Steps continue where the free unknowns are the same, but not all at the same bounds; pivots are
    for repeated sets.
    """
    rng, turned = np.random.default_rng(5), 0
    for _ in range(120):
        B, S = rng.standard_normal((2, 6, 6))
        A, b, half = (
            B @ B.T / 6 + 0.1 * np.eye(6) + S - S.T,
            rng.standard_normal(6),
            rng.uniform(0.1, 0.5, 6),
        )
        ends, turns = whole_steps(A, b, -half, half)
        if ends:
            result = wl.solve(
                wl.LCP(wl.DenseOperator(A, device="cpu"), b, -half, half),
                PrimalDualActiveSet(),
                stopping=TIGHT,
            )
            assert result, result.status
            assert "least index" not in {r.step for r in result.history}
            turned += turns
    assert turned > 5


@pytest.mark.parametrize("size", [1.0, 1e-20, 1e20])
def test_violations_of_a_basic_solution_are_relative_to_b(size):
    """With x = 0 at its bounds y = b: only y_0 = -size is a violation, y_1 is rounding of size."""
    b = size * np.array([-1.0, -1e-13, 1.0])
    data = DenseProblem(np.arange(3), np.eye(3), b, np.zeros(3), np.full(3, np.inf))
    x, wrong, singular = _basic_solution(data, np.full(3, LOWER))
    assert x.tolist() == [0.0, 0.0, 0.0]
    assert wrong.tolist() == [0]
    assert not singular
