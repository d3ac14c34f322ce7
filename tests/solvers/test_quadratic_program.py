"""PIQP behind the interface: symmetric problems, refusals, unbounded objectives."""

import importlib.util
from functools import partial

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse

import warp_lcp as wl
from matrices import solve_matrix
from oracle import boxed
from warp_lcp.solvers.quadratic_program import QuadraticProgram

pytest.importorskip("piqp")
TIGHT = wl.StoppingCriteria(rtol=1e-8)


solve = partial(solve_matrix, solver=QuadraticProgram(), stopping=TIGHT)


@pytest.mark.parametrize("sparse", [False, True])
def test_boxes_and_equations(sparse):
    rng = np.random.default_rng(901)
    for _ in range(40):
        n = int(rng.integers(1, 7))
        B = rng.standard_normal((n, n))
        A, b, kind = B @ B.T + 0.1 * np.eye(n), rng.standard_normal(n), rng.integers(0, 5, n)
        A = (A + A.T) / 2
        lower = np.where(np.isin(kind, (1, 3)), -rng.random(n), np.where(kind == 4, 0.3, -np.inf))
        upper = np.where(np.isin(kind, (2, 3)), rng.random(n), np.where(kind == 4, 0.3, np.inf))
        result = solve(scipy.sparse.csr_array(A) if sparse else A, b, lower, upper)
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), boxed(A, b, lower, upper), atol=1e-6)


def test_sparse_problem_larger_than_the_dense_limit(monkeypatch):
    """Sparse problem larger than the dense limit.

    A chain of 6000 unknowns under a load, above an obstacle; SciPy's bounded quasi-Newton method
    finds the same.
    """
    n = 6000
    A = scipy.sparse.diags_array([-1.0, 2.05, -1.0], offsets=[-1, 0, 1], shape=(n, n)).tocsr()
    b = np.sin(np.linspace(0, 40, n))
    monkeypatch.setattr(QuadraticProgram, "most_unknowns", 100)
    result = solve(A, b)
    assert result, result.status
    found = scipy.optimize.minimize(
        lambda x: (0.5 * x @ (A @ x) + b @ x, A @ x + b),
        np.zeros(n),
        jac=True,
        bounds=[(0, None)] * n,
        method="L-BFGS-B",
        options={"maxiter": 3000, "ftol": 1e-15, "gtol": 1e-9, "maxfun": 10_000},
    )
    np.testing.assert_allclose(result.x.numpy(), found.x, atol=1e-4)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("zeros", [0.2, 0.5, 0.8])
def test_semidefinite_problem_is_solved_or_infeasible_as_a_linear_program_says(zeros):
    rng = np.random.default_rng(int(910 + 10 * zeros))
    seen = set()
    for _ in range(25):
        n = int(rng.integers(2, 25))
        B = rng.standard_normal((n, n - int(zeros * n)))
        A, b = B @ B.T, rng.standard_normal(n) + rng.choice([0.0, 1.0])
        A = (A + A.T) / 2
        feasible = scipy.optimize.linprog(np.zeros(n), A_ub=-A, b_ub=b).status == 0
        result = solve(A, b)
        assert result.status is (
            wl.SolveStatus.CONVERGED if feasible else wl.SolveStatus.INFEASIBLE
        )
        seen.add(feasible)
    assert True in seen


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize(
    ("A", "message"),
    [
        (np.array([[2.0, 1.0], [0.0, 2.0]]), "not symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive semi-definite"),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), "not positive semi-definite"),
    ],
)
def test_other_matrices_are_refused(A, message, sparse):
    with pytest.raises(ValueError, match=message):
        solve(scipy.sparse.csr_array(A) if sparse else A, -np.ones(2))


def test_without_piqp_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'warp-lcp\[peers\]'"):
        solve(np.eye(2), -np.ones(2))


def test_limit_of_its_own_iterations_is_reported():
    rng = np.random.default_rng(937)
    B = rng.standard_normal((100, 100))
    result = solve(
        (B @ B.T + (B @ B.T).T) / 2,
        rng.standard_normal(100),
        solver=QuadraticProgram(max_iterations=1),
    )
    assert result.status is wl.SolveStatus.MAX_ITERATIONS


@pytest.mark.parametrize("settings", [{"tolerance": 0.0}, {"max_iterations": 0}])
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        QuadraticProgram(**settings)
