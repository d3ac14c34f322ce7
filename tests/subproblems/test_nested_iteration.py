"""Nested iteration on narrow matrices.

Cyclic reduction against dense Schur complements, and steps that do not grow with n.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from narrow_problems import KINDS, M_MATRICES, narrow_problem
from oracle import natural_residual
from warp_lcp.operators.banded_matrix import BandedMatrix, bands_of, bandwidth
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.subproblems.nested_iteration import (
    COARSEST,
    BlockTridiagonalProblem,
    nested_iteration,
)


def diagonal_residual(A, b, lower, upper, x):
    """Return the natural residual; its scale is the diagonal.

    The matrices here are dominant or positive definite.
    """
    return natural_residual(A, b, lower, upper, x, A.diagonal())


EPS = float(np.finfo(np.float64).eps)
TIGHT = wl.StoppingCriteria(rtol=1e-7)


def banded(p):
    A = SparseOperator(p.A, device="cpu")
    return BandedMatrix(bands_of(A, bandwidth(A)))


def relative_residual(p, x):
    own, start = (
        diagonal_residual(p.A, p.b, p.lower, p.upper, at)
        for at in (x, np.clip(np.zeros(len(p.b)), p.lower, p.upper))
    )
    return own / start if start > 0 else own


def newton(A, b, lower, upper, x):
    """Return whole Newton steps on the minimum map, by dense NumPy.

    They end when the active set repeats.
    """
    seen = []
    while True:
        target = x - (A @ x + b) / A.diagonal()
        key = (target < lower).tolist(), (target > upper).tolist()
        if key in seen:
            return x
        seen.append(key)
        x = np.where(target < lower, lower, np.where(target > upper, upper, x))
        free = np.flatnonzero((target >= lower) & (target <= upper))
        x[free] -= np.linalg.solve(A[np.ix_(free, free)], (A @ x + b)[free])


def plain_nested_iteration(A, b, lower, upper, k, *, finest=True):
    """Return nested iteration by definition, with dense Schur complements.

    n is a multiple of k.
    """
    n = len(b)
    if n <= COARSEST * k:
        return newton(A, b, lower, upper, np.clip(np.zeros(n), lower, upper))
    block = np.arange(n) // k
    C, F = np.flatnonzero(block % 2 == 0), np.flatnonzero(block % 2 == 1)
    G = np.linalg.inv(A[np.ix_(F, F)])
    P, R = G @ A[np.ix_(F, C)], A[np.ix_(C, F)] @ G
    x = np.zeros(n)
    x[C] = plain_nested_iteration(
        A[np.ix_(C, C)] - A[np.ix_(C, F)] @ P, b[C] - R @ b[F], lower[C], upper[C], k, finest=False
    )
    x[F] = -P @ x[C] - G @ b[F]
    return x if finest else newton(A, b, lower, upper, x)


@pytest.mark.parametrize(
    "kind", ["chain", "convection", "dominant band", "supported beam", "frame"]
)
@pytest.mark.parametrize("seed", [7301, 7302, 7303])
def test_levels_are_schur_complements(kind, seed):
    p = narrow_problem(kind, seed, 90)
    A = banded(p)
    x = nested_iteration(A, p.b, p.lower, p.upper)
    expected = plain_nested_iteration(p.A.toarray(), p.b, p.lower, p.upper, A.width)
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("n", [31, 64, 97])
def test_a_last_block_that_is_not_full_is_filled_up(n):
    p = narrow_problem("dominant band", 7311, n)
    level = BlockTridiagonalProblem.of(banded(p), p.b, p.lower, p.upper)
    whole, filled = level.matrix(), level.b.size
    x = np.random.default_rng(7312).standard_normal(filled)
    np.testing.assert_allclose(whole.product(x)[:n], p.A @ x[:n], atol=1e-13)
    np.testing.assert_array_equal(whole.product(x)[n:], x[n:])


@pytest.mark.parametrize("kind", M_MATRICES)
def test_steps_on_m_matrices_do_not_grow_with_n(kind):
    for n in (100, 1600, 12800):
        for seed in range(7321, 7324):
            p = narrow_problem(kind, seed, n)
            result = wl.solve(wl.LCP(p.A, p.b, p.lower, p.upper))
            assert result, f"{p.name}: {result.status.name}"
            # Four plain steps, nested iteration, and the rest.
            assert result.iterations <= 11, p.name
            assert relative_residual(p, result.x.numpy()) <= 1e-6 * (1 + 1e-6)


def test_an_upper_bound_in_a_window_at_any_size():
    """Upper bound in a window at any size.

    It ended in an AttributeError at 3,700 unknowns, after 9, 22 and 76 steps at 100, 400 and 1,600.
    """
    for n in (100, 400, 1600, 3700, 50000):
        x = np.arange(1, n + 1) / (n + 1)
        A = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n)).tocsr()
        b = (-40 * np.sin(7 * x) - 8) / (n + 1) ** 2
        for upper in (np.where(abs(x - 0.6) < 0.15, 0.05, np.inf), np.inf):
            result = wl.solve(wl.LCP(A, b, 0.0, upper))
            assert result
            assert result.iterations <= 8
            assert diagonal_residual(A, b, 0.0, upper, result.x.numpy()) <= 1e-6 * np.linalg.norm(
                np.minimum(b, 0)
            ) * (1 + 1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_default_solves_narrow_problems(kind):
    """Default method on narrow problems.

    Beams of 150 unknowns: the condition number of larger ones leaves no digits.
    """
    for seed in range(7331, 7339):
        p = narrow_problem(kind, seed, 150)
        result = wl.solve(wl.LCP(p.A, p.b, p.lower, p.upper))
        assert result, f"{p.name}: {result.status.name}"
        assert relative_residual(p, result.x.numpy()) <= 1e-6 * (1 + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1500, 15000])
def test_default_solves_large_narrow_problems(n):
    """Default method on large narrow problems.

    The condition number of beams is about n^4: 5e12 at 1,500 unknowns, where FLOOR is correct; at
    15,000, 5e16, A is singular in float64.
    """
    for kind in KINDS:
        beam = kind in ("beam", "supported beam", "frame")
        for seed in range(7341, 7361):
            p = narrow_problem(kind, seed, n)
            result = wl.solve(wl.LCP(p.A, p.b, p.lower, p.upper))
            honest = beam and (result.status is wl.SolveStatus.FLOOR or n > 1500)
            assert result or honest, f"{p.name}: {result.status.name}"
            if result:
                x = result.x.numpy()
                # Of A x: another order of sums gives another residual.
                rounding = EPS * np.linalg.norm(abs(p.A) @ abs(x))
                start = np.clip(np.zeros(len(p.b)), p.lower, p.upper)
                allowed = 1e-6 * diagonal_residual(p.A, p.b, p.lower, p.upper, start) + 4 * rounding
                assert diagonal_residual(p.A, p.b, p.lower, p.upper, x) <= allowed, p.name


def test_a_guess_far_from_the_solution_takes_nested_iteration_too():
    p = narrow_problem("chain", 7371, 3000)
    problem = wl.LCP(p.A, p.b, p.lower, p.upper)
    far = np.where(np.isfinite(p.upper), p.upper, np.clip(5.0, p.lower, None))
    result = wl.solve(problem, x0=far, stopping=TIGHT)
    assert result
    assert result.iterations <= 14
    again = wl.solve(problem, x0=result.x, stopping=TIGHT)
    assert [record.step for record in again.history[1:]] in ([], ["active set"])


@pytest.mark.parametrize(
    "method", [wl.MinimumMapNewton(), wl.InteriorPoint(), wl.MPRGP(), wl.SubspaceMinimization()]
)
def test_methods_on_narrow_matrices_agree(method):
    p = narrow_problem("supported beam", 7381, 120)
    problem = wl.LCP(p.A, p.b, p.lower, p.upper)
    result = wl.solve(
        problem, method, stopping=wl.StoppingCriteria(rtol=1e-6, max_iterations=2000, patience=500)
    )
    assert result, result.status
    x = wl.solve(problem, stopping=wl.StoppingCriteria(rtol=1e-10)).x.numpy()
    np.testing.assert_allclose(result.x.numpy(), x, atol=2e-4 * np.abs(x).max())


@pytest.mark.parametrize("width", [0, 1, 2, 3])
def test_band_factors_with_a_shift(width):
    rng = np.random.default_rng(7391 + width)
    n = 23
    A = np.triu(np.tril(rng.standard_normal((n, n)), width), -width) + 5 * np.eye(n)
    free, shift, r = rng.random(n) < 0.6, rng.uniform(0, 3, n), rng.standard_normal(n)
    e = BandedMatrix(
        bands_of(SparseOperator(scipy.sparse.csr_array(A), device="cpu"), width)
    ).solve(free, r, shift)
    F = np.flatnonzero(free)
    np.testing.assert_allclose(
        e[F], np.linalg.solve(A[np.ix_(F, F)] + np.diag(shift[F]), r[F]), atol=1e-12
    )
    assert not e[~free].any()


def test_a_singular_block_is_reported():
    A = scipy.sparse.csr_array(np.array([[1.0, 1.0, 0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]]))
    matrix = BandedMatrix(bands_of(SparseOperator(A, device="cpu"), 1))
    assert matrix.solve(np.ones(3, dtype=bool), np.ones(3)) is None
    np.testing.assert_allclose(
        matrix.solve(np.array([True, False, True]), np.ones(3)), [1.0, 0.0, 0.5]
    )
