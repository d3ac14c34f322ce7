"""Baraff's pivoting.

Problems are definite and semi-definite, with boxes, equations, and without a solution. A pivot
costs O(n^2).
"""

from functools import partial

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_lcp as wl
from matrices import planted_solution, solve_matrix
from oracle import boxed, lemke, natural_residual
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting, PrincipalInverse

TIGHT = wl.StoppingCriteria(rtol=1e-8, max_iterations=1000)


solve = partial(solve_matrix, solver=IncrementalPivoting(), stopping=TIGHT)


def semidefinite(rng, n, zeros):
    """Return a symmetric matrix with a share of zero eigenvalues."""
    B = rng.standard_normal((n, n - int(zeros * n)))
    A = B @ B.T
    return (A + A.T) / 2


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("zeros", [0.0, 0.2, 0.5, 0.8])
def test_semidefinite_problems(zeros):
    rng = np.random.default_rng(int(700 + 10 * zeros))
    for _ in range(20):
        A = semidefinite(rng, 60, zeros)
        b = planted_solution(A, rng, 0.5)[0]
        result = solve(A, b)
        assert result, result.status
        x = result.x.numpy()
        rounding = np.finfo(float).eps * np.linalg.norm(np.abs(A) @ np.abs(x) + np.abs(b))
        assert natural_residual(A, b, 0.0, np.inf, x) <= 100 * rounding


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 6))
def test_boxes_and_equations(seed, n):
    rng = np.random.default_rng(seed)
    B = rng.standard_normal((n, n))
    A, b, kind = B @ B.T + 0.1 * np.eye(n), rng.standard_normal(n), rng.integers(0, 5, n)
    lower = np.where(np.isin(kind, (1, 3)), -rng.random(n), np.where(kind == 4, 0.3, -np.inf))
    upper = np.where(np.isin(kind, (2, 3)), rng.random(n), np.where(kind == 4, 0.3, np.inf))
    result = solve(A, b, lower, upper)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), boxed(A, b, lower, upper), atol=1e-7)


def test_larger_problem_against_lemke():
    rng = np.random.default_rng(719)
    B = rng.standard_normal((80, 80))
    A, b = B @ B.T / 80 + 0.1 * np.eye(80), rng.standard_normal(80)
    np.testing.assert_allclose(solve(A, b).x.numpy(), lemke(A, b), atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), zeros=st.floats(0.2, 0.9))
def test_semidefinite_problem_is_solved_or_infeasible_as_a_linear_program_says(seed, zeros):
    """Semi-definite problem, solved or infeasible as by a linear program.

    A semi-definite LCP has a solution if and only if some x >= 0 has A x + b >= 0.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 30))
    A, b = semidefinite(rng, n, zeros), rng.standard_normal(n) + rng.choice([0.0, 0.5])
    feasible = scipy.optimize.linprog(np.zeros(n), A_ub=-A, b_ub=b).status == 0
    result = solve(A, b)
    assert result.status is (wl.SolveStatus.CONVERGED if feasible else wl.SolveStatus.INFEASIBLE)


def test_infeasible_problem():
    """Infeasible problem.

    y = A x + b cannot become positive in the direction (1, -1), where A is 0 and b is not.
    """
    result = solve(np.ones((2, 2)), np.array([-1.0, -2.0]), lower=-np.inf)
    assert result.status is wl.SolveStatus.INFEASIBLE
    assert solve(np.zeros((1, 1)), np.array([-1.0])).status is wl.SolveStatus.INFEASIBLE
    assert solve(np.zeros((1, 1)), np.array([-1.0]), upper=3.0).x.numpy() == [3.0]


def test_degenerate_problem_does_not_cycle():
    """Degenerate problem without cycling: every pivot ties with every other."""
    A = np.ones((30, 30)) + np.eye(30)
    result = solve(A, -np.ones(30))
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), np.full(30, 1 / 31), atol=1e-12)


def test_warm_start_needs_few_pivots():
    rng = np.random.default_rng(727)
    A = semidefinite(rng, 60, 0.0) + 0.1 * np.eye(60)
    b = planted_solution(A, rng, 0.5)[0]
    cold = solve(A, b)
    warm = solve(A, b + 1e-3 * rng.standard_normal(60), x0=cold.x.numpy())
    assert warm
    assert warm.linear_iterations <= cold.linear_iterations


def test_a_pivot_is_a_step_where_asked_for():
    """Pivots as steps.

    The history then has a line per pivot, and the limit is exact.
    """
    rng = np.random.default_rng(733)
    A = semidefinite(rng, 40, 0.0) + 0.1 * np.eye(40)
    b = planted_solution(A, rng, 0.5)[0]
    single = IncrementalPivoting(pivots_per_step=1)
    result = solve(A, b, solver=single)
    assert result
    pivots = result.linear_iterations
    assert pivots <= result.iterations <= pivots + 1
    assert all(
        record.linear_iterations == min(record.iteration, pivots) for record in result.history
    )
    short = solve(
        A, b, solver=single, stopping=wl.StoppingCriteria(rtol=1e-8, max_iterations=5, patience=1)
    )
    assert short.status is wl.SolveStatus.MAX_ITERATIONS
    assert short.iterations == short.linear_iterations == 5
    assert short.residual == min(record.residual for record in short.history)


def test_patience_does_not_end_a_sequence_of_pivots():
    rng = np.random.default_rng(739)
    A = semidefinite(rng, 60, 0.5)
    b = planted_solution(A, rng, 0.5)[0]
    stopping = wl.StoppingCriteria(rtol=1e-8, max_iterations=1000, patience=1, divergence=1.001)
    assert solve(A, b, solver=IncrementalPivoting(pivots_per_step=1), stopping=stopping)


@pytest.mark.parametrize(
    ("A", "message"),
    [
        (np.array([[2.0, 1.0], [0.0, 2.0]]), "not symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive semi-definite"),
        (-np.eye(2), "not positive semi-definite"),
    ],
)
def test_other_matrices_are_refused(A, message):
    with pytest.raises(ValueError, match=message):
        solve(A, -np.ones(len(A)))


def test_settings_and_sizes_are_checked(monkeypatch):
    with pytest.raises(ValueError, match="pivots_per_step = 0"):
        IncrementalPivoting(pivots_per_step=0)
    monkeypatch.setattr(IncrementalPivoting, "most_unknowns", 3)
    with pytest.raises(
        ValueError, match="4 unknowns: IncrementalPivoting is a dense method for at most 3"
    ):
        solve(np.eye(4), -np.ones(4))


def test_inverse_follows_changes_of_the_set():
    """Inverse after changes of the set.

    Bordering and deflation are compared with NumPy, without a fresh inverse on a well-conditioned
    block.
    """
    rng = np.random.default_rng(743)
    A = semidefinite(rng, 30, 0.0) / 30 + np.eye(30)
    inverse, members = PrincipalInverse(A), set()
    for _ in range(400):
        j = int(rng.integers(0, 30))
        if j in members:
            inverse.remove(j)
            members.remove(j)
        else:
            inverse.insert(j)
            members.add(j)
        assert set(inverse.members.tolist()) == members
        r = rng.standard_normal(len(members))
        expected = np.linalg.solve(A[np.ix_(inverse.members, inverse.members)], r)
        np.testing.assert_allclose(inverse.solve(r), expected, atol=1e-11)
    assert inverse.refactorizations == 0


def test_inverse_of_a_singular_block_is_a_least_squares_solution():
    A = np.ones((3, 3))
    inverse = PrincipalInverse(A)
    for j in range(3):
        inverse.insert(j)
    np.testing.assert_allclose(inverse.solve(np.full(3, 6.0)), np.full(3, 2.0), atol=1e-12)
    inverse.remove(2)
    inverse.remove(0)
    np.testing.assert_allclose(inverse.solve(np.array([6.0])), [6.0])


def test_fresh_inverses_stay_rare():
    """Number of fresh inverses: one at the end.

    All other pivots update, in O(n^2).
    """
    rng = np.random.default_rng(751)
    A = semidefinite(rng, 120, 0.0) / 120 + 0.1 * np.eye(120)
    problem = wl.LCP(wl.DenseOperator(A, device="cpu"), rng.standard_normal(120))
    solver = IncrementalPivoting()
    work = solver.init(problem)
    result = wl.solve(problem, solver, workspace=work, stopping=TIGHT)
    assert result
    assert result.linear_iterations > 40
    assert work.inverse.refactorizations == 1
