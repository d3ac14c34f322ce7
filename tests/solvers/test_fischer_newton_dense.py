"""Fischer-Newton on dense matrices: bounds, units, many contacts."""

import numpy as np
import pytest

import warp_lcp as wl
from oracle import natural_residual
from warp_lcp.gallery.contact_scenes import contact
from warp_lcp.solvers import fischer_newton


def dense(problem, scale=1.0):
    return wl.LCP(wl.DenseOperator(scale * problem.A, device="cpu"), problem.b)


def reference(problem):
    n = len(problem.b)
    return natural_residual(problem.A, problem.b, np.zeros(n), np.full(n, np.inf), np.zeros(n))


@pytest.mark.parametrize("safeguard", [True, False])
def test_answers_are_within_their_bounds(safeguard):
    """Answers within their bounds.

    The fallbacks' own iterates are not: at the end of most of these contacts some are below 0 by up
    to 4e-6.
    """
    for seed in range(10):
        problem = contact(10, seed=seed)
        result = wl.solve(dense(problem), wl.FischerNewton(safeguard=safeguard))
        x, n = result.x.numpy(), len(problem.b)
        assert x.min() >= 0
        own = natural_residual(problem.A, problem.b, np.zeros(n), np.full(n, np.inf), x)
        assert own == pytest.approx(result.residual, rel=1e-6)
        assert bool(result) == (own <= 1e-6 * reference(problem))


def test_boxes_hold_their_answers():
    rng = np.random.default_rng(89)
    for _ in range(10):
        B = rng.standard_normal((12, 12))
        lower, upper = -rng.random(12), rng.random(12)
        problem = wl.LCP(
            wl.DenseOperator(B @ B.T / 12 + 0.1 * np.eye(12), device="cpu"),
            rng.standard_normal(12),
            lower,
            upper,
        )
        result = wl.solve(problem, wl.FischerNewton())
        assert result, result.status
        assert ((result.x.numpy() >= lower) & (result.x.numpy() <= upper)).all()


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("scale", [2.0**-27, 2.0**27])
def test_contacts_in_other_units(scale):
    """Contacts in other units of mass and time.

    The same steps except at the end, where rows without a diagonal entry are measured.
    """
    for seed in range(10):
        problem = contact(10, seed=seed)
        plain, scaled = (wl.solve(dense(problem, s), wl.FischerNewton()) for s in (1.0, scale))
        assert plain, plain.status
        assert scaled, scaled.status
        assert abs(plain.iterations - scaled.iterations) <= 4


@pytest.mark.slow
@pytest.mark.parametrize("contacts", [20, 30])
@pytest.mark.parametrize("scale", [1.0, 1e8, 1e-8])
def test_a_hundred_contacts_of_120_and_180_variables(contacts, scale):
    """Hundred contacts of 120 and 180 variables.

    Rows of a zero diagonal count in A's own units: the criterion is that of the solver's units, A
    of scale 1.
    """
    steps = []
    for seed in range(30):
        problem = contact(contacts, seed=seed)
        result = wl.solve(dense(problem, scale), wl.FischerNewton())
        assert result, (seed, result.status)
        assert result.x.numpy().min() >= 0
        steps.append(result.iterations)
    assert np.mean(steps) <= 20


def test_a_regularized_direction_that_climbs_is_replaced_by_the_gradient(monkeypatch):
    """Linear solve of the wrong sign: the step takes the negative gradient, and the merit falls."""
    A = np.array([[3.0, 1.0], [-1.0, 2.0]])
    problem = wl.LCP(wl.DenseOperator(A, device="cpu"), np.array([-40.0, 30.0]))
    work = wl.FischerNewton(safeguard=True).init(problem)
    work.start(warm=False, tolerance=0.0)
    values = []
    monkeypatch.setattr(fischer_newton, "_solve", lambda J, r: -np.linalg.solve(J, r))
    for _ in range(2):
        x = work._iterate
        values.append(float(np.linalg.norm(work.map.value(x, work.map.data.affine(x)))))
        work.newton_step(work.x)
    assert work.stage == 0  # no search has failed
    assert values[1] < values[0]
