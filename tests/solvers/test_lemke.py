"""Lemke's method: any matrix, frictional contacts, boxes by reformulation, rays."""

from functools import partial

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_lcp as wl
from matrices import solve_matrix
from oracle import boxed, lemke, natural_residual
from warp_lcp.operators.banded_matrix import BandedFactors
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting
from warp_lcp.solvers.lemke import Basis, Lemke
from warp_lcp.solvers.quadratic_program import QuadraticProgram

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=1000)


solve = partial(solve_matrix, solver=Lemke(), stopping=TIGHT)


def contacts(count, rng, friction=0.5):
    """Return the Stewart-Trinkle LCP of random bodies with random contacts.

    Its blocks are the normal, four tangents and the sliding speed beta.
    """
    bodies = max(2, count // 3)
    masses = rng.uniform(0.5, 2.0, bodies)
    inverse = np.concatenate(
        [np.r_[np.full(3, 1 / m), 1 / (m * rng.uniform(0.1, 1.0, 3))] for m in masses]
    )
    J = np.zeros((5 * count, 6 * bodies))
    for k in range(count):
        first, second = rng.choice(bodies, 2, replace=False)
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        tangent = np.cross(normal, rng.standard_normal(3))
        tangent /= np.linalg.norm(tangent)
        arms = rng.uniform(-1.0, 1.0, (2, 3))
        other = np.cross(normal, tangent)
        for row, direction in enumerate((normal, tangent, other, -tangent, -other)):
            J[5 * k + row, 6 * first : 6 * first + 6] = -np.r_[
                direction, np.cross(arms[0], direction)
            ]
            J[5 * k + row, 6 * second : 6 * second + 6] = np.r_[
                direction, np.cross(arms[1], direction)
            ]
    A, b = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    forces = np.flatnonzero(np.arange(6 * count) % 6 != 5)
    A[np.ix_(forces, forces)] = (J * inverse) @ J.T
    for k in range(0, 6 * count, 6):
        A[k + 5, k], A[k + 5, k + 1 : k + 5], A[k + 1 : k + 5, k + 5] = friction, -1.0, 1.0
    b[forces] = J @ rng.standard_normal(6 * bodies)
    return A, b


@pytest.mark.parametrize("count", [15, pytest.param(100, marks=pytest.mark.slow)])
def test_contact_problems_of_180_variables(count):
    pivots = []
    for seed in range(count):
        A, b = contacts(30, np.random.default_rng(9000 + seed))
        result = solve(A, b)
        assert result, f"seed {seed}: {result.status.name}"
        assert natural_residual(A, b, 0.0, np.inf, result.x.numpy()) <= 1e-10 * natural_residual(
            A, b, 0.0, np.inf, np.zeros(180)
        )
        pivots.append(result.linear_iterations)
    assert np.mean(pivots) < 180


@pytest.mark.parametrize("zeros", [0.2, 0.5, 0.8])
def test_semidefinite_problems(zeros):
    rng = np.random.default_rng(int(800 + 10 * zeros))
    for _ in range(10):
        B = rng.standard_normal((60, 60 - int(60 * zeros)))
        A, held = B @ B.T, rng.random(60) < 0.5
        b = np.where(held, rng.uniform(0.1, 1.0, 60), 0.0) - A @ np.where(
            held, 0.0, rng.uniform(0.1, 1.0, 60)
        )
        result = solve(A, b)
        assert result, result.status
        assert result.relative_residual <= 1e-10


def test_against_the_tableau():
    rng = np.random.default_rng(811)
    for _ in range(10):
        B, C = rng.standard_normal((2, 40, 40))
        # Positive definite, far from symmetric.
        A, b = B @ B.T / 40 + 0.1 * np.eye(40) + C - C.T, rng.standard_normal(40)
        np.testing.assert_allclose(solve(A, b).x.numpy(), lemke(A, b), atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 6))
def test_boxes_equations_and_fixed_values(seed, n):
    rng = np.random.default_rng(seed)
    B, C = rng.standard_normal((2, n, n))
    A, b, kind = B @ B.T + 0.1 * np.eye(n) + C - C.T, rng.standard_normal(n), rng.integers(0, 5, n)
    lower = np.where(np.isin(kind, (1, 3)), -rng.random(n), np.where(kind == 4, 0.3, -np.inf))
    upper = np.where(np.isin(kind, (2, 3)), rng.random(n), np.where(kind == 4, 0.3, np.inf))
    result = solve(A, b, lower, upper)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), boxed(A, b, lower, upper), atol=1e-8)


def test_equations_with_a_singular_block_are_split():
    """Equations with a singular block: split.

    x_0 and x_1 are free and their block is 0: a saddle point that only its third row determines.
    """
    A = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -2.0], [1.0, 2.0, 1.0]])
    b, lower = np.array([1.0, 2.0, -4.0]), np.array([-np.inf, -np.inf, 0.0])
    result = solve(A, b, lower)
    assert result, result.status
    x = result.x.numpy()
    np.testing.assert_allclose(x[2], 1.0, atol=1e-12)
    np.testing.assert_allclose(A @ x + b, 0.0, atol=1e-12)


def test_degenerate_problem_does_not_cycle():
    A = np.ones((30, 30)) + np.eye(30)
    result = solve(A, -np.ones(30))
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), np.full(30, 1 / 31), atol=1e-12)


def test_lexicographic_rule_passes_an_example_with_ties():
    """Lexicographic rule on an example with ties.

    All ratios tie at the start and after it; a rule that takes any of them may return to an earlier
    basis.
    """
    A = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 2.0], [2.0, 0.0, 1.0]])
    seen, basis = set(), Basis(A, -np.ones(3), np.ones(3))
    while (outcome := basis.pivot()) is None:
        key = tuple(sorted(basis.variables.tolist()))
        assert key not in seen
        seen.add(key)
    assert outcome is True
    np.testing.assert_allclose(basis.z(), np.full(3, 1 / 3), atol=1e-14)


@pytest.mark.parametrize(
    ("A", "b", "lower"),
    [
        (np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([1.0, -2.0]), 0.0),
        (np.ones((2, 2)), np.array([-1.0, -2.0]), -np.inf),
        (-np.eye(3), -np.ones(3), 0.0),  # not semi-definite: the linear program decides
        (np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([-1.0, 1.0]), 0.0),
    ],
)
def test_a_confirmed_ray_is_infeasible(A, b, lower):
    problem = wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower)
    solver = Lemke()
    work = solver.init(problem)
    result = wl.solve(problem, solver, stopping=TIGHT, workspace=work)
    assert result.status is wl.SolveStatus.INFEASIBLE
    assert work.rays == 3  # the three random covering vectors were tried


def test_a_ray_is_not_called_infeasible_where_a_solution_exists():
    """Ray without INFEASIBLE where a solution exists.

    Indefinite matrices with a planted solution: the path may end in rays, which then prove nothing.
    """
    rng = np.random.default_rng(821)
    statuses = []
    for _ in range(60):
        A = rng.standard_normal((8, 8))
        held = rng.random(8) < 0.5
        b = np.where(held, rng.uniform(0.1, 1.0, 8), 0.0) - A @ np.where(
            held, 0.0, rng.uniform(0.1, 1.0, 8)
        )
        statuses.append(solve(A, b).status)
    assert set(statuses) == {wl.SolveStatus.CONVERGED, wl.SolveStatus.STAGNATED}
    assert statuses.count(wl.SolveStatus.CONVERGED) > 30


def test_unsymmetric_p_matrix_with_a_cycle_of_period_three():
    A = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])
    np.testing.assert_allclose(solve(A, -np.ones(3)).x.numpy(), np.full(3, 0.2), atol=1e-12)


def test_limit_counts_single_pivots_where_asked_for():
    A, b = contacts(5, np.random.default_rng(823))
    full = solve(A, b, solver=Lemke(pivots_per_step=1))
    assert full
    assert full.iterations == full.linear_iterations
    short = solve(
        A,
        b,
        solver=Lemke(pivots_per_step=1),
        stopping=wl.StoppingCriteria(rtol=1e-10, max_iterations=4, patience=1),
    )
    assert short.status is wl.SolveStatus.MAX_ITERATIONS
    assert short.iterations == 4
    x = short.x.numpy()
    assert x.any()  # complementary except for the covering variable
    np.testing.assert_allclose(np.minimum(x, A @ x + b - (A @ x + b).min()), 0.0, atol=1e-12)


@pytest.mark.parametrize("settings", [{"pivots_per_step": 0}, {"covering_vectors": 0}])
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        Lemke(**settings)


def test_large_problems_are_refused(monkeypatch):
    monkeypatch.setattr(Lemke, "most_unknowns", 3)
    with pytest.raises(ValueError, match="4 unknowns: Lemke is a dense method for at most 3"):
        solve(np.eye(4), -np.ones(4))


@pytest.mark.default_cases(9)
@pytest.mark.parametrize("method", [Lemke, IncrementalPivoting, QuadraticProgram])
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize("load", [1e-8, 1e8])
def test_units_do_not_matter(method, size, load):
    """Units without influence.

    Rows and columns from 1e-3 to 1e3, A and b in any units: no certificate of infeasibility may
    depend on them.
    """
    if method is QuadraticProgram:
        pytest.importorskip("piqp")
    rng = np.random.default_rng(827)
    B, scale = rng.standard_normal((40, 40)), 10 ** rng.uniform(-3, 3, 40)
    A = (B @ B.T / 40 + 0.1 * np.eye(40)) * np.outer(scale, scale) * size
    A = (A + A.T) / 2
    held = rng.random(40) < 0.4
    x = np.where(held, 0.0, rng.uniform(0.1, 1.0, 40) / scale) * load / size
    b = np.where(held, rng.uniform(0.1, 1.0, 40) * scale, 0.0) * load - A @ x
    result = solve(A, b, solver=method())
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), x, rtol=1e-5, atol=1e-9 * x.max())


def flipped(seed):
    """Return -M of a definite matrix plus a skew one, in a box.

    A solution exists, and Lemke's usual covering vectors end in rays.
    """
    rng = np.random.default_rng([seed, 222])
    n = int(np.exp(rng.uniform(np.log(2), np.log(24))))
    B, S = rng.standard_normal((n, n)), rng.standard_normal((n, n))
    A = -(B @ B.T / n + 10 ** rng.uniform(-3, 0) * np.eye(n) + (S - S.T) * 10 ** rng.uniform(-2, 1))
    lower = -(10 ** rng.uniform(-2, 2)) * rng.random(n)
    return (
        A,
        rng.standard_normal(n) * 10 ** rng.uniform(-1, 1),
        lower,
        lower + 10 ** rng.uniform(-2, 2) * rng.random(n) + 1e-3,
    )


def test_finite_bounds_end_every_path_in_a_solution():
    """Paths with finite bounds: each ends in a solution.

    A fifth of these ended STAGNATED, on rays of four covering vectors.
    """
    for seed in range(40):
        A, b, lower, upper = flipped(seed)
        result = solve(A, b, lower, upper)
        assert result, (seed, result.status)
        x = result.x.numpy()
        at = natural_residual(A, b, lower, upper, np.clip(0.0, lower, upper))
        assert ((lower <= x) & (x <= upper)).all(), seed
        assert np.linalg.norm(natural_residual(A, b, lower, upper, x)) <= 1e-8 * np.linalg.norm(
            at
        ), seed


def test_the_default_solves_flipped_matrices_in_boxes():
    for seed in range(40, 60):
        A, b, lower, upper = flipped(seed)
        result = wl.solve(wl.LCP(A, b, lower, upper))
        assert result, (seed, result.status)


def test_a_path_begins_again_with_a_dense_inverse_where_banded_factors_fail(monkeypatch):
    """Banded factors that are singular at the fifth pivot: the dense basis finds the solution."""
    rng, n, calls = np.random.default_rng(677), 120, []
    A = scipy.sparse.diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(n, n)).tocsr()
    problem = wl.LCP(wl.SparseOperator(A, device="cpu"), rng.standard_normal(n))
    factor = BandedFactors.factor

    def failing(self, basic, row):
        calls.append(row)
        return len(calls) != 5 and factor(self, basic, row)

    monkeypatch.setattr(BandedFactors, "factor", failing)
    work = wl.Lemke().init(problem)
    result = wl.solve(problem, wl.Lemke(), workspace=work)
    assert result
    assert len(calls) == 5
    assert type(work.basis) is Basis
    x = result.x.numpy()
    np.testing.assert_allclose(np.minimum(x, A @ x + problem.b.numpy()), 0.0, atol=1e-10)
