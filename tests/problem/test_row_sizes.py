"""Rows of very different size, judged independently.

At the start and at the floor.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.problem.operator_protocol import families
from warp_lcp.problem.residual import EPS, NaturalResidual
from warp_lcp.solvers.registry import METHODS

RIGHT = {wl.SolveStatus.CONVERGED}
DENSE = sorted(name for name, method in METHODS.items() if "dense" in families(method))
CRITERIA = wl.StoppingCriteria(rtol=1e-6, max_iterations=3000, patience=300)


def planted(seed, *, largest, form="dense"):
    """Return A, b and the solution of a problem with some large active rows.

    Their y is up to `largest`.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 12))
    A = -rng.uniform(0, 1, (n, n)) * (rng.random((n, n)) < 0.5)
    A = A + A.T
    np.fill_diagonal(A, 0.0)
    np.fill_diagonal(A, -A.sum(axis=1) + rng.uniform(0.5, 1.5, n))
    held = rng.random(n) < 0.5
    held[0], held[1] = True, False
    x = np.where(held, 0.0, rng.uniform(0.5, 2.0, n))
    y = np.where(held, 10 ** rng.uniform(0, np.log10(largest), n), 0.0)
    y[0] = largest
    return A, y - A @ x, x


@pytest.mark.parametrize("largest", [1e3, 1e8, 1e13, 1e16, 1e30, 1e100])
def test_large_rows_at_bounds_do_not_hide_others(largest):
    for seed in range(6101, 6116):
        A, b, x = planted(seed, largest=largest)
        for form in (A, scipy.sparse.csr_array(A)):
            result = wl.solve(wl.LCP(form, b))
            assert result, result.status
            np.testing.assert_allclose(result.x.numpy(), x, atol=1e-5)


@pytest.mark.parametrize("name", DENSE)
def test_no_method_calls_the_start_a_solution(name):
    """Start that is no solution, for every method.

    [[2, 1], [1, 2]] and b = (-1, 1e16): (0, 0) was called CONVERGED; the solution is (0.5, 0).
    """
    problem = wl.LCP(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([-1.0, 1e16]))
    result = wl.solve(problem, METHODS[name](), stopping=CRITERIA)
    if name == "penalty":  # its penalty of 1e6 d is small beside b = 1e16: the residual grows
        assert result.status is wl.SolveStatus.DIVERGED
        return
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), [0.5, 0.0], atol=1e-5)


@pytest.mark.parametrize(
    "name", ["minimum-map-newton", "projected-multigrid", "mprgp", "psor", "fischer-newton"]
)
@pytest.mark.parametrize("kind", ["poisson", "stencil"])
def test_no_method_calls_the_start_a_solution_on_grids(name, kind):
    cells = np.ones((6, 7), dtype=int)
    cells[0] = wl.AIR
    five = np.array([[0.0, -1, 0], [-1, 4, -1], [0, -1, 0]])
    A = (
        wl.GridPoisson(cells, device="cpu")
        if kind == "poisson"
        else wl.Stencil(cells, five, device="cpu")
    )
    b = np.full((6, 7), -1.0)
    b[3, 3] = 1e16
    result = wl.solve(wl.LCP(A, b), METHODS[name](), stopping=CRITERIA)
    assert result, result.status
    x = result.x.numpy()
    free = np.ones((6, 7))
    free[3, 3] = free[0] = 0
    again = wl.solve(
        wl.LCP(A, np.where(free, b, 0.0), 0.0, np.where(free, np.inf, 0.0)),
        stopping=wl.StoppingCriteria(rtol=1e-9),
    )
    assert again
    np.testing.assert_allclose(x, again.x.numpy(), atol=1e-3)
    assert x.max() > 5


def test_rounding_is_judged_row_by_row():
    """Rounding judged row by row, against NumPy.

    The tolerance of a row is |r_i| <= 4 eps (|b_i| + sum_j |a_ij x_j|).
    """
    rng = np.random.default_rng(6131)
    A = rng.standard_normal((5, 5)) + 6 * np.eye(5)
    x = rng.standard_normal(5)
    for form in (A, scipy.sparse.csr_array(A)):
        for noise in (0.0, 1e-17, 1e-13):
            b = -A @ x
            b[2] += noise * 1e3
            problem = wl.LCP(form, b, -np.inf, np.inf)
            residual = NaturalResidual(problem)
            residual.start(wp.array(x, dtype=wp.float64, device="cpu"), keep=True)
            rows = np.abs(A @ x + b) <= 4 * EPS * (np.abs(b) + np.abs(A) @ np.abs(x))
            assert residual.is_rounding(wp.array(x, dtype=wp.float64, device="cpu")) == bool(
                rows.all()
            )


def test_a_start_that_solves_up_to_rounding_takes_no_steps():
    """Start that solves up to rounding: no steps.

    l = x: y is the rounding error of sums whose terms cancel, with either sign.
    """
    rng = np.random.default_rng(6137)
    A = rng.standard_normal((8, 8))
    A = A @ A.T + np.eye(8)
    x = rng.uniform(0.5, 1.0, 8)
    result = wl.solve(wl.LCP(A, -A @ x, x))
    assert result
    assert result.iterations == 0


def test_the_floor_is_that_of_the_rows_whose_y_counts():
    """Floor of the rows whose y counts.

    Row 0 is active far from the end of its bound: the rounding of its b is no error of the
    residual.
    """
    A, b = np.diag([2.0, 3.0]), np.array([1e16, -3.0])
    problem = wl.LCP(A, b)
    residual = NaturalResidual(problem)
    x = wp.array([0.0, 1.0], dtype=wp.float64, device="cpu")
    residual.start(x, keep=True)
    assert residual.rounding_floor(x, EPS) == pytest.approx(EPS * (2 * 3.0 + 3.0))
    free = NaturalResidual(wl.LCP(A, b, -np.inf))
    free.start(x, keep=True)
    assert free.rounding_floor(x, EPS) >= EPS * 1e16
