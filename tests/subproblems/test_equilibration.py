"""Rows in different units, and problems without a solution.

D A D with D from 1e-8 to 1e8, for second-order methods.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering
from matrices import posed
from oracle import boxed, lemke
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.subproblems.dense_problem import DenseProblem
from warp_lcp.subproblems.equilibration import EquilibratedWorkspace

TIGHT = wl.StoppingCriteria(rtol=1e-10)
N = 40
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
METHODS = [
    InteriorPoint(),
    InteriorPoint(mehrotra=False),
    wl.MinimumMapNewton(),
    wl.PrimalDualActiveSet(),
]


def name(method):
    return repr(method).partition(", cycle")[0][:80]


def matrix(kind, rng):
    if kind == "dense":
        B = rng.standard_normal((N, N))
        return B @ B.T / N + 0.1 * np.eye(N)
    return scipy.sparse.diags_array([-1.0, 2.1, -1.0], offsets=[-1, 0, 1], shape=(N, N)).toarray()


@pytest.mark.cpu_form("the CPU factors so few unknowns")
@pytest.mark.parametrize(
    ("method", "kind"),
    covering(METHODS, ["dense", "sparse"]),
    ids=lambda value: value if isinstance(value, str) else name(value),
)
def test_extreme_rows(kind, method):
    """Extreme rows.

    There are sixteen orders of magnitude between units, and thirty-two between pivots. Interior
    points once diverged, and dense blocks seemed singular.
    """
    for seed in range(6):
        rng = np.random.default_rng(seed)
        A, b, D = matrix(kind, rng), rng.standard_normal(N), 10 ** rng.uniform(-8, 8, N)
        scaled = posed(D[:, None] * A * D, D * b, kind)
        result = wl.solve(scaled, wl.default_chain(method, scaled))
        assert result, (seed, result.status)
        # The criterion is in units of y: it distinguishes these rows from 0.
        largest = D.max() / 100 < D
        np.testing.assert_array_equal(
            (result.x.numpy() * D)[largest] < 1e-3, lemke(A, b)[largest] < 1e-3
        )


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_the_same_steps_in_any_units(kind):
    """Equal steps in any units: D powers of 4, so that S removes them exactly."""
    rng = np.random.default_rng(107)
    A, b, D = matrix(kind, rng), rng.standard_normal(N), 4.0 ** rng.integers(-13, 14, N)
    x, high = lemke(A, b), np.full(N, 2.0)
    histories = []
    for lower, upper in ((0.0, np.inf), (-high / 10, high)):
        plain, scaled = [], []
        for units, residuals in ((np.ones(N), plain), (D, scaled)):
            limits = (lower, upper) if np.isscalar(lower) else (lower / units, upper / units)
            p = posed(units[:, None] * A * units, units * b, kind, *limits)
            work = InteriorPoint().init(p)
            result = wl.solve(
                p,
                InteriorPoint(),
                workspace=work,
                stopping=wl.StoppingCriteria(rtol=1e-30, max_iterations=9),
            )
            inner = work.inner
            residuals.extend([inner.residual.evaluate(inner.x), result.x.numpy() * units])
        histories.append((plain, scaled))
    for plain, scaled in histories:
        assert scaled[0] == pytest.approx(plain[0], rel=0.5, abs=1e-6)
        np.testing.assert_allclose(scaled[1], plain[1], atol=1e-3)
    np.testing.assert_allclose(histories[0][1][1], x, atol=1e-3)


@pytest.mark.parametrize("kind", ["dense", "sparse"])
@pytest.mark.parametrize("b", [(-1.0, -1.0), (1.0, -1.0)])
@pytest.mark.parametrize("precision", ["mixed", "double", "single"])
def test_no_solution_is_proved(b, kind, precision):
    """Proof that no solution exists.

    y_2 = -x_1 - 1 < 0 for every x >= 0: iterates diverge, and were once reported as not finite.
    """
    result = wl.solve(posed(TURN, np.array(b), kind), InteriorPoint(precision=precision))
    assert result.status is wl.SolveStatus.INFEASIBLE
    assert np.isfinite(result.x.numpy()).all()
    assert np.isfinite(result.residual)


@pytest.mark.parametrize("seed", range(6))
def test_solvable_problems_are_not_called_infeasible(seed):
    """False INFEASIBLE is excluded for solvable problems.

    Indefinite matrices, for which the method gives no guarantee; enumeration decides.
    """
    rng = np.random.default_rng(seed)
    A, b = rng.standard_normal((4, 4)), rng.standard_normal(4)
    result = wl.solve(posed(A + A.T, b, "dense"), InteriorPoint())
    if boxed(A + A.T, b, np.zeros(4), np.full(4, np.inf)) is not None:
        assert result.status is not wl.SolveStatus.INFEASIBLE
    else:
        assert not result
    assert result.status is not wl.SolveStatus.NON_FINITE


@pytest.mark.cpu_form("the CPU factors so few unknowns")
@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_entries_bounds_and_b_may_change_in_place(kind):
    rng = np.random.default_rng(109)
    A, D = matrix(kind, rng), 10 ** rng.uniform(-3, 3, N)
    b, upper = (wp.zeros(N, dtype=wp.float64, device="cpu") for _ in range(2))
    upper.fill_(1.0)
    p = posed(A, b, kind, 0.0, upper)
    work = InteriorPoint().init(p)
    assert isinstance(work, EquilibratedWorkspace)
    for units in (np.ones(N), D, 1 / D) if kind == "sparse" else (np.ones(N), np.full(N, 2.0)):
        values, right = (
            A if kind == "dense" else units[:, None] * A * units,
            units * rng.standard_normal(N),
        )
        if kind == "sparse":
            p.A.update(scipy.sparse.csr_array(values))
        b.assign(right)
        upper.assign(0.5 / units)
        warm = wl.solve(p, InteriorPoint(), workspace=work, stopping=TIGHT)
        fresh = wl.solve(
            posed(values, right, kind, 0.0, 0.5 / units), InteriorPoint(), stopping=TIGHT
        )
        assert warm, warm.status
        assert warm.iterations == fresh.iterations
        np.testing.assert_allclose(warm.x.numpy() * units, fresh.x.numpy() * units, atol=1e-6)


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_a_guess_counts_in_any_units(kind):
    rng = np.random.default_rng(127)
    A, b, D = matrix(kind, rng), rng.standard_normal(N), 4.0 ** rng.integers(-13, 14, N)
    x, counts = lemke(A, b), []
    for units, guess in ((np.ones(N), None), (np.ones(N), x + 0.01), (D, x + 0.01)):
        p = posed(units[:, None] * A * units, units * b, kind)
        result = wl.solve(
            p, InteriorPoint(), x0=None if guess is None else guess / units, stopping=TIGHT
        )
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy() * units, x, atol=1e-6)
        counts.append(result.iterations)
    assert max(counts[1:]) <= counts[0] - 3


def test_a_guess_and_rows_without_a_diagonal_entry():
    rng = np.random.default_rng(113)
    D = np.array([1e-5, 1e4])
    A, b = D[:, None] * TURN * D, D * np.array([-1.0, 1.0])
    for x0 in (None, rng.random(2) / D, np.ones(2) / D):
        result = wl.solve(posed(A, b, "dense"), InteriorPoint(), x0=x0, stopping=TIGHT)
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy() * D, [1.0, 1.0], atol=1e-4)


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_dense_problem_in_other_units_is_the_same_problem(symmetric):
    """Units of x = beta C x' and of y = beta R^-1 y': those of y do not depend on x.

    Bounds are those of x in its units. Units are powers of 2, so that equalities hold to rounding.
    """
    rng, n = np.random.default_rng(673), 12
    rows, columns = (10 ** rng.uniform(-6, 6, n) for _ in range(2))
    columns = rows if symmetric else columns
    A = rows[:, None] * matrix("dense", rng)[:n, :n] * columns
    b, lower = 1e3 * rows * rng.standard_normal(n), -rng.uniform(0.0, 1.0, n) / columns
    problem = DenseProblem(np.arange(n), A, b, lower, np.full(n, np.inf), symmetric)
    scaled, units = problem.scaled()
    np.testing.assert_array_equal(np.log2(units) % 1.0, 0.0)
    np.testing.assert_array_equal(scaled.lower * units, lower)
    ratios = [problem.affine(units * x) / scaled.affine(x) for x in rng.standard_normal((3, n))]
    np.testing.assert_allclose(ratios[1:], [ratios[0]] * 2, rtol=1e-6)
    if symmetric:
        assert 0.2 < np.abs(scaled.A).max() < 5.0
