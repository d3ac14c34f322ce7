"""Matrices with their sign flipped: detected at once, with a message.

The message asks for the sign.
"""

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg

import warp_lcp as wl
from matrices import laplacian
from oracle import natural_residual
from warp_lcp.problem.curvature import has_negative_curvature

CURVED, INFEASIBLE = wl.SolveStatus.NEGATIVE_CURVATURE, wl.SolveStatus.INFEASIBLE


def drawn(seed):
    """Return a solvable matrix, sparse or dense.

    It is symmetric positive definite, or dominant and unsymmetric.
    """
    rng = np.random.default_rng(seed)
    kind, n = int(rng.integers(0, 4)), int(rng.integers(2, 40))
    if kind == 0:
        return laplacian(n // 6 + 2)
    if kind == 1:
        F = rng.standard_normal((n, n))
        return F @ F.T + np.eye(n)
    A = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.4)
    np.fill_diagonal(A, 0.0)
    np.fill_diagonal(A, np.abs(A).sum(axis=1) + rng.uniform(0.1, 1.0, n))
    return A if kind == 2 else scipy.sparse.csr_array(A)


def products(A):
    """Return A as an operator with products only."""
    symmetric = bool(abs(A - A.T).max() < 1e-12)
    return wl.LinearOperator(
        lambda x: A @ x,
        shape=(A.shape[0],),
        symmetric=symmetric,
        transpose=None if symmetric else lambda x: A.T @ x,
    )


def is_feasible(A, b):
    """Return whether some x >= 0 has A x + b >= 0, by HiGHS."""
    return scipy.optimize.linprog(np.zeros(len(b)), A_ub=-A, b_ub=b, bounds=(0.0, None)).status == 0


@pytest.mark.parametrize(
    "method", [wl.MinimumMapNewton(), wl.PrimalDualActiveSet(), wl.Penalty(), wl.InteriorPoint()]
)
def test_flipped_matrices_take_no_steps(method):
    for seed in range(6201, 6207):
        A = drawn(seed)
        b = np.random.default_rng([seed, 1]).standard_normal(A.shape[0]) - 1.0
        result = wl.solve(wl.LCP(-A, b), method)
        assert result.status is CURVED, (seed, result.status)
        assert result.iterations == 0
        assert wl.solve(wl.LCP(A, b), method).status is not CURVED


def test_flipped_matrices_are_solved_or_refuted_by_default():
    """Flipped matrices: solved or proved infeasible by default.

    Pivots solve -A or prove it infeasible; otherwise negative curvature is reported.
    """
    for seed in range(6201, 6216):
        A = drawn(seed)
        b = np.random.default_rng([seed, 1]).standard_normal(A.shape[0]) - 1.0
        result = wl.solve(wl.LCP(-A, b))
        assert result or result.status in (CURVED, INFEASIBLE), (seed, result.status)
        if result.status is INFEASIBLE:
            assert not is_feasible(-A, b)
        assert wl.solve(wl.LCP(A, b))


@pytest.mark.parametrize(("n", "status"), [(20, 2), (32, 10)])
def test_the_message_asks_for_the_sign(n, status):
    """Message that asks for the sign.

    Up to 1,000 unknowns pivots prove that there is no solution.
    """
    found = wl.linear_complementarity(-laplacian(n), np.full(n * n, -1.0))
    assert not found.success
    assert "A, not -A" in found.message
    assert found.status == status


def test_negative_curvature_is_detected_from_products_alone():
    for seed in range(6221, 6251):
        A = drawn(seed)
        b = np.full(A.shape[0], -1.0)
        assert has_negative_curvature(wl.LCP(products(-A), b)), seed
        assert has_negative_curvature(wl.LCP(products(-A), b, -np.inf, 0.0)), seed
        assert not has_negative_curvature(wl.LCP(products(A), b)), seed


def test_finite_bounds_allow_any_sign():
    """Any sign with finite bounds.

    A box always has a solution (Brouwer's fixed point of the projection).
    """
    A = drawn(6261)
    assert not has_negative_curvature(wl.LCP(-A, np.ones(A.shape[0]), 0.0, 1.0))
    upper = np.full(A.shape[0], np.inf)
    assert has_negative_curvature(wl.LCP(-A, np.ones(A.shape[0]), 0.0, upper))


def test_some_negative_entries_are_no_wrong_sign():
    """Some negative entries: no wrong sign.

    Convection causes some, as in a Newton step for ice. Such problems have solutions, which the
    default finds.
    """
    rng = np.random.default_rng(6281)
    for form in (np.asarray, scipy.sparse.csr_array):
        A = drawn(6262)
        A = A.toarray() if scipy.sparse.issparse(A) else A
        n = A.shape[0]
        A[n // 2, n // 2] *= -0.01
        x, y = rng.random(n) * (np.arange(n) % 2), rng.random(n) * ((np.arange(n) + 1) % 2)
        problem = wl.LCP(form(A), y - A @ x)
        assert not has_negative_curvature(problem)
        result = wl.solve(problem)
        assert result
        assert natural_residual(
            A, y - A @ x, 0.0, np.inf, result.x.numpy()
        ) <= 1e-6 * np.linalg.norm(y - A @ x)
        assert has_negative_curvature(wl.LCP(form(-np.abs(np.diag(A)) * np.eye(n)), y))


def test_a_start_that_solves_stays_a_solution():
    A = laplacian(5)
    result = wl.solve(wl.LCP(-A, np.ones(25)))
    assert result
    assert not result.x.numpy().any()


def test_semidefinite_and_skew_matrices_are_no_such_case():
    rng = np.random.default_rng(6271)
    F = rng.standard_normal((12, 3))
    S = rng.standard_normal((12, 12))
    for A in (F @ F.T, S - S.T, F @ F.T + S - S.T, np.zeros((12, 12))):
        for form in (A, products(A)):
            assert not has_negative_curvature(wl.LCP(form, -np.ones(12)))
