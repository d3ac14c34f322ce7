"""Every method on every operator against dense oracles.

Lemke, exhaustive search, NumPy's linear solve.
"""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_lcp as wl
from default_run import covering
from matrices import planted_solution
from oracle import assemble, boxed, lemke, natural_residual

METHODS = {
    "newton": wl.MinimumMapNewton(),
    "newton-double": wl.MinimumMapNewton(precision="double"),
    "newton-no-cycles": wl.MinimumMapNewton(monotone_cycles=0),
    "multigrid": wl.ProjectedMultigrid(),
    "multigrid-double": wl.ProjectedMultigrid(precision="double"),
    "multigrid-no-cycles": wl.ProjectedMultigrid(monotone_cycles=0),
    "psor": wl.ProjectedSOR(),
    "pgs": wl.ProjectedSOR(omega=1.0),
    "psor-backward": wl.ProjectedSOR(direction="backward"),
    "psor-symmetric": wl.ProjectedSOR(direction="symmetric"),
}
TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=20_000, patience=2000)


@pytest.mark.parametrize("name", [name for name in METHODS if not name.startswith("multigrid")])
def test_dense_planted(name, device):
    rng = np.random.default_rng(17)
    B = rng.standard_normal((40, 40))
    A = B @ B.T / 40 + np.eye(40)
    b, x = planted_solution(A, rng, 0.3)
    result = wl.solve(wl.LCP(wl.DenseOperator(A, device=device), b), METHODS[name], stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), x, atol=1e-8)
    np.testing.assert_allclose(lemke(A, b), x, atol=1e-8)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("shape", "arrays"), covering([(7, 6, 9), (13, 11), (1, 9, 8), (5, 1)], [False, True])
)
def test_grid_planted(name, shape, arrays, device):
    rng = np.random.default_rng(23)
    cells = rng.choice(3, shape, p=[0.15, 0.75, 0.1])
    cells.ravel()[0] = wl.AIR
    faces = [
        rng.uniform(0.2, 1.0, [s + (q == len(shape) - 1 - a) for q, s in enumerate(shape)])
        if arrays
        else 1.0
        for a in range(len(shape))
    ]
    dense = assemble(cells, faces)
    fluid = cells.ravel() == wl.FLUID
    A = wl.GridPoisson(
        cells,
        **{f"face_{c}": f for c, f in zip("xyz", faces, strict=False)},
        device=device,
        dtype=wp.float64,
    )
    b, x = np.zeros(cells.size), np.zeros(cells.size)
    b[fluid], x[fluid] = planted_solution(dense[np.ix_(fluid, fluid)], rng, 0.3)
    result = wl.solve(wl.LCP(A, b.reshape(shape)), METHODS[name], stopping=TIGHT)
    assert result, result.status
    assert result.relative_residual <= 1e-10
    got = result.x.numpy().ravel()
    bounds = np.where(fluid, 0, -np.inf), np.full(cells.size, np.inf)
    assert natural_residual(dense, b, *bounds, got) == pytest.approx(
        result.residual, rel=1e-6, abs=1e-12
    )
    np.testing.assert_allclose(got, x, atol=1e-7)


@pytest.mark.parametrize("name", METHODS)
def test_mixed_and_boxed_rows_on_a_grid(name, device):
    rng = np.random.default_rng(29)
    cells = np.array([[0, 1, 1, 1], [1, 1, 2, 1]])
    fluid = cells.ravel() == wl.FLUID
    for _ in range(5):
        b = rng.standard_normal(8) * 2
        kind = rng.integers(0, 4, 8)
        lower = np.where(np.isin(kind, (0, 2)), -rng.random(8), -np.inf)
        upper = np.where(np.isin(kind, (1, 2)), rng.random(8), np.inf)
        A = wl.GridPoisson(cells, device=device, dtype=wp.float64)
        problem = wl.LCP(A, b.reshape(2, 4), lower.reshape(2, 4), upper.reshape(2, 4))
        result = wl.solve(problem, METHODS[name], stopping=TIGHT)
        block = assemble(cells)[np.ix_(fluid, fluid)]
        expected = boxed(block, b[fluid], lower[fluid], upper[fluid])
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy().ravel()[fluid], expected, atol=1e-8)


@pytest.mark.parametrize("name", ["newton", "multigrid", "psor"])
@pytest.mark.parametrize("periodic", [(True, False, False), (True, True, True)])
def test_periodic_equations_are_linear_solves(name, periodic, device):
    rng = np.random.default_rng(31)
    cells = np.ones((4, 6, 8), dtype=int)
    cells[0, 0, 0] = wl.AIR
    dense, fluid = assemble(cells, periodic=periodic), cells.ravel() == wl.FLUID
    b = rng.standard_normal(cells.shape)
    A = wl.GridPoisson(cells, periodic=periodic, device=device)
    result = wl.solve(wl.LCP(A, b, lower=-np.inf), METHODS[name], stopping=TIGHT)
    expected = np.linalg.solve(dense[np.ix_(fluid, fluid)], -b.ravel()[fluid])
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy().ravel()[fluid], expected, atol=1e-7)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 5))
def test_small_boxed_dense_problems(seed, n):
    rng = np.random.default_rng(seed)
    B = rng.standard_normal((n, n))
    A, b = B @ B.T + 0.2 * np.eye(n), rng.standard_normal(n)
    lower, upper = -rng.random(n), rng.random(n)
    result = wl.solve(
        wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper),
        wl.MinimumMapNewton(),
        stopping=TIGHT,
    )
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), boxed(A, b, lower, upper), atol=1e-8)


def test_unsymmetric_p_matrix_with_a_cycle_of_period_three():
    A = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])
    result = wl.solve(
        wl.LCP(wl.DenseOperator(A, device="cpu"), -np.ones(3)),
        wl.MinimumMapNewton(),
        stopping=TIGHT,
    )
    assert result, result.status
    np.testing.assert_allclose(A @ result.x.numpy(), np.ones(3), atol=1e-9)
