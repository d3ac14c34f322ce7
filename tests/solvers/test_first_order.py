"""NNCG and accelerated projected gradients.

They are compared with plain loops in NumPy and oracles, within iteration budgets.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from oracle import assemble, lemke
from warp_lcp.solvers.accelerated_projected_gradient import AcceleratedProjectedGradient
from warp_lcp.solvers.nncg import NNCG

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=20_000, patience=2000)


def obstacle(n, seed):
    """Return Poisson on n^2 cells with AIR around, and a random b.

    The Gauss-Seidel iterations of this LCP grow as n^2.
    """
    cells = np.ones((n + 2, n + 2), dtype=int)
    cells[[0, -1]] = cells[:, [0, -1]] = wl.AIR
    b = np.where(
        cells == wl.FLUID, np.random.default_rng(seed).standard_normal(cells.shape) - 0.3, 0.0
    )
    return cells, b


def nncg_by_its_algorithm(A, b, steps):
    """Return x after each step of [Book] algorithm 8, with the projection."""
    x, p, before, out = np.zeros(len(b)), np.zeros(len(b)), 0.0, []
    for _ in range(steps):
        y = x.copy()
        for i in range(len(b)):
            y[i] = max(0.0, y[i] - (A[i] @ y + b[i]) / A[i, i])
        g = x - y
        beta = g @ g / before if before else 0.0
        if beta > 1:
            p, x = np.zeros(len(b)), y
        else:
            x, p = np.maximum(0.0, y + beta * p), beta * p - g
        before = g @ g
        out.append(x.copy())
    return out


def test_nncg_is_its_algorithm(device):
    rng = np.random.default_rng(101)
    B = rng.standard_normal((10, 10))
    A, b = B @ B.T / 10 + 0.1 * np.eye(10), rng.standard_normal(10)
    expected = nncg_by_its_algorithm(A, b, 12)
    problem, solver = wl.LCP(wl.DenseOperator(A, device=device), b), NNCG()
    work = solver.init(problem)
    work.start(warm=False, tolerance=0.0)
    for x in expected:
        solver.step(problem, work, work.x)
        np.testing.assert_allclose(work.x.numpy(), x, atol=1e-11)


@pytest.mark.parametrize(
    "solver", [NNCG(), NNCG(direction="symmetric"), NNCG(omega=1.2), AcceleratedProjectedGradient()]
)
def test_first_order_methods_need_far_fewer_sweeps_than_gauss_seidel(solver, device):
    cells, b = obstacle(24, 103)
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells)
    A = scipy.sparse.csr_array(dense[np.ix_(fluid, fluid)])
    expected = lemke(dense[np.ix_(fluid, fluid)], b.ravel()[fluid]) if fluid.sum() < 200 else None
    assert expected is None
    pgs = wl.solve(
        wl.LCP(wl.SparseOperator(A, device=device), b.ravel()[fluid]),
        wl.ProjectedSOR(omega=1.0),
        stopping=TIGHT,
    )
    assert pgs
    grid = wl.solve(
        wl.LCP(wl.GridPoisson(cells, device=device, dtype=wp.float64), b), solver, stopping=TIGHT
    )
    sparse = wl.solve(
        wl.LCP(wl.SparseOperator(A, device=device), b.ravel()[fluid]), solver, stopping=TIGHT
    )
    for result, x in ((grid, grid.x.numpy().ravel()[fluid]), (sparse, sparse.x.numpy())):
        assert result, result.status
        assert result.linear_iterations <= 0.6 * pgs.linear_iterations
        np.testing.assert_allclose(x, pgs.x.numpy(), atol=1e-7)


def test_gradient_steps_are_the_proximal_iteration(device):
    """Gradient steps as the proximal iteration.

    The first step is prox(x - D^-1 (A x + b) / L); the momentum begins with the third.
    """
    rng = np.random.default_rng(107)
    B = rng.standard_normal((6, 6))
    A, b = B @ B.T / 6 + np.eye(6), rng.standard_normal(6)
    d, L = np.diag(A), 4.0
    x = np.maximum(0, 0 - b / (L * d))
    second = np.maximum(0, x - (A @ x + b) / (L * d))
    problem, solver = (
        wl.LCP(wl.DenseOperator(A, device=device), b),
        AcceleratedProjectedGradient(lipschitz=L),
    )
    for steps, expected in ((1, x), (2, second)):
        got = wl.solve(
            problem, solver, stopping=wl.StoppingCriteria(rtol=0.0, max_iterations=steps)
        )
        np.testing.assert_allclose(got.x.numpy(), expected, atol=1e-13)


@pytest.mark.parametrize("n", [5, 40])
def test_the_first_step_is_as_long_as_the_spectrum_allows(n, device):
    """Length of the first step, by the spectrum.

    Without bounds it is -D^-1 b / L, and L need not be far above the largest eigenvalue of D^-1/2 A
    D^-1/2.
    """
    rng = np.random.default_rng(113)
    B = rng.standard_normal((n, n))
    A, b = B @ B.T / n + 0.5 * np.eye(n), rng.standard_normal(n)
    problem = wl.LCP(wl.DenseOperator(A, device=device), b, lower=-np.inf)
    x = wl.solve(
        problem,
        AcceleratedProjectedGradient(),
        stopping=wl.StoppingCriteria(rtol=0.0, max_iterations=1),
    ).x.numpy()
    L = -b / (np.diag(A) * x)
    np.testing.assert_allclose(L, L[0], rtol=1e-12)
    assert 1 <= L[0] / np.linalg.eigvalsh(A / np.sqrt(np.outer(np.diag(A), np.diag(A))))[-1] <= 1.1


@pytest.mark.parametrize("start", [1e-3, 100.0])
def test_a_wrong_lipschitz_constant_is_corrected_or_only_slow(start, device):
    """Wrong Lipschitz constant: corrected, or only slow.

    Too small a constant would diverge; it grows until it covers the steps' curvature. Too large a
    one is slow.
    """
    rng = np.random.default_rng(109)
    B = rng.standard_normal((20, 20))
    A, b = B @ B.T / 20 + 0.5 * np.eye(20), rng.standard_normal(20)
    problem, solver = (
        wl.LCP(wl.DenseOperator(A, device=device), b),
        AcceleratedProjectedGradient(lipschitz=start),
    )
    work = solver.init(problem)
    result = wl.solve(problem, solver, stopping=TIGHT, workspace=work)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-8)
    scaled = A / np.sqrt(np.outer(np.diag(A), np.diag(A)))
    greatest = np.linalg.eigvalsh(scaled)[-1]
    assert 0.3 * greatest <= work.lipschitz
    assert start > 1 or work.lipschitz <= 1.2 * greatest


def test_gradient_method_solves_singular_semidefinite_boxes(device):
    """Singular semi-definite boxes of rank 6 of 20.

    Solutions are not unique, their y is.
    """
    rng = np.random.default_rng(113)
    B = rng.standard_normal((20, 6))
    A, b = B @ B.T, rng.standard_normal(20)
    problem = wl.LCP(wl.DenseOperator(A, device=device), b, -1.0, 1.0)
    gradient = wl.solve(problem, AcceleratedProjectedGradient(), stopping=TIGHT)
    sweeps = wl.solve(problem, wl.ProjectedSOR(omega=1.0), stopping=TIGHT)
    assert gradient
    assert sweeps
    np.testing.assert_allclose(A @ gradient.x.numpy(), A @ sweeps.x.numpy(), atol=1e-7)


def test_unsupported_problems_are_refused():
    unsymmetric = wl.LCP(
        wl.DenseOperator(np.array([[1.0, 1.0], [0.0, 1.0]]), device="cpu"), -np.ones(2)
    )
    negative = wl.LCP(wl.DenseOperator(np.diag([1.0, -1.0]), device="cpu"), -np.ones(2), 0.0, 1.0)
    for problem, message in ((unsymmetric, "is not symmetric"), (negative, "negative diagonal")):
        with pytest.raises(ValueError, match=message):
            AcceleratedProjectedGradient().init(problem)
    for settings in ({"lipschitz": 0.0}, {"estimate_steps": 0}, {"precision": "half"}):
        with pytest.raises(
            ValueError, match=next(iter(settings)) if "precision" not in settings else "half"
        ):
            AcceleratedProjectedGradient(**settings)
    for settings in ({"omega": 0.0}, {"direction": "up"}, {"precision": "half"}):
        with pytest.raises(ValueError, match=r"omega|direction|half"):
            NNCG(**settings)
