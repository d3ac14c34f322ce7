"""Gradients for every kind of operator against dense implicit differentiation.

The multipliers solve A_FF' mu_F = -g_F.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import few
from drawn_stencils import KINDS, drawn, drawn_singular, neighbor
from warp_lcp.operators.grid_matrix import grid_matrix

F64 = {"device": "cpu", "dtype": wp.float64}
OTHERS = ("dense", "sparse", "products", "low rank and sparse", "low rank and grid", "poisson")


def operator(kind, seed):
    """Return an operator, its matrix by NumPy, and the places of unknowns."""
    rng, n = np.random.default_rng([seed, 5]), 24
    if kind in KINDS:
        stencil = drawn([seed, 11], kind)
        return stencil.operator(), stencil.matrix(), stencil.inside
    weights = rng.uniform(0.5, 2, 3)
    if kind == "low rank and grid":
        stencil = drawn([seed, 13], "arrays")
        columns = rng.standard_normal((*stencil.cells.shape, 3)) * stencil.inside[..., None]
        inner = columns[stencil.inside]
        A = wl.SumOperator(stencil.operator(), wl.LowRankOperator(columns, weights, **F64))
        return A, stencil.matrix() + inner * weights @ inner.T, stencil.inside
    if kind == "poisson":
        cells = rng.choice([wl.AIR, *[wl.FLUID] * 3, wl.SOLID], (4, 5))
        cells[0, 0] = wl.FLUID
        A = wl.GridPoisson(
            cells, shift=rng.uniform(0.1, 1, (4, 5)), face_x=rng.uniform(0.1, 1, (4, 6)), **F64
        )
        return A, grid_matrix(A).toarray(), cells == wl.FLUID
    M, columns = (
        rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.3) + 8 * np.eye(n),
        rng.standard_normal((n, 3)),
    )
    sparse = wl.SparseOperator(scipy.sparse.csr_array(M), **F64)
    inside = np.ones(n, dtype=bool)
    if kind == "low rank and sparse":
        return (
            wl.SumOperator(sparse, wl.LowRankOperator(columns, weights, **F64)),
            M + columns * weights @ columns.T,
            inside,
        )
    if kind == "products":
        return (
            wl.LinearOperator(
                lambda x: M @ x, transpose=lambda x: M.T @ x, shape=(n,), symmetric=False
            ),
            M,
            inside,
        )
    return (wl.DenseOperator(M, **F64) if kind == "dense" else sparse), M, inside


def check(kind, seed):
    A, M, inside = operator(kind, seed)
    # Some operators are float32.
    rng, within = np.random.default_rng([seed, 6]), 1e-4 if kind == "functions" else 1e-7
    x, free = rng.standard_normal(inside.shape) * inside, rng.random(inside.shape) < 0.5
    y = np.where(free, 0, rng.choice([-1, 1], inside.shape) * rng.uniform(0.5, 1.5, inside.shape))
    b = np.zeros(inside.shape)
    b[inside] = y[inside] - M @ x[inside]
    lower, upper = np.where(y > 0, x, x - 1), np.where(y < 0, x, x + 1)
    result = wl.solve(
        wl.LCP(A, b, lower, upper),
        stopping=wl.StoppingCriteria(rtol=1e-12, atol=1e-11, max_iterations=300),
    )
    np.testing.assert_allclose(result.x.numpy()[inside], x[inside], atol=within)
    g = rng.standard_normal(inside.shape)
    gradients = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-12))
    F, mu = free[inside], np.zeros(len(M))
    mu[F] = np.linalg.solve(M[F][:, F].T, -g[inside][F])
    z = g[inside] + M.T @ mu
    for found, expected in (
        (gradients.b, mu),
        (gradients.lower, z * (y[inside] > 0)),
        (gradients.upper, z * (y[inside] < 0)),
    ):
        np.testing.assert_allclose(found.numpy()[inside], expected, atol=within)
    if kind in KINDS:
        check_coefficients(
            drawn([seed, 11], kind), gradients.coefficients["coefficients"], x, mu, within
        )


def check_coefficients(stencil, found, x, mu, within):
    """Compare with mu_i times the factor of cell i's coefficient."""
    cells = stencil.cells
    for offset, gradient in found.items():
        expected = np.zeros(cells.shape)
        for cell, m in zip(np.argwhere(stencil.inside), mu, strict=True):
            there, kind = neighbor(cells, tuple(cell), offset, stencil.periodic, stencil.outside)
            value = {
                wl.SOLID: x[tuple(cell)],
                wl.AIR: 0.0,
                wl.FLUID: x[tuple(np.clip(np.array(there) - 1, 0, np.array(x.shape) - 1))],
            }
            expected[tuple(cell)] = m * value[kind]
        gradient = gradient.numpy() if isinstance(gradient, wp.array) else np.asarray(gradient)
        np.testing.assert_allclose(
            gradient, expected if gradient.ndim else expected.sum(), atol=within
        )


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("kind", [*KINDS, *OTHERS])
@pytest.mark.parametrize("seed", few([1, 5], 1))
def test_gradients_are_those_of_the_matrix(kind, seed):
    check(kind, seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*KINDS, *OTHERS])
@pytest.mark.parametrize("seed", range(7000, 7020))
def test_more_gradients_are_those_of_the_matrix(kind, seed):
    check(kind, seed)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("kind", ["rows", "columns", "circulant"])
def test_gradients_of_singular_stencils_are_those_of_the_pseudo_inverse(kind):
    """Gradients of singular stencils: those of the pseudo-inverse.

    With g compatible, mu is defined up to a left null vector, which has no effect on b or on a step
    of x.
    """
    stencil = drawn_singular(18, kind)
    A, inside, rng = stencil.operator(), stencil.inside, np.random.default_rng(19)
    M = grid_matrix(A).toarray()
    b, g = np.zeros(inside.shape), np.zeros(inside.shape)
    b[inside], g[inside] = M @ rng.standard_normal(len(M)), M.T @ rng.standard_normal(len(M))
    result = wl.solve(wl.LCP(A, b, -np.inf, np.inf), stopping=wl.StoppingCriteria(rtol=1e-10))
    mu = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-9)).b.numpy()[inside]
    np.testing.assert_allclose(M.T @ mu, -g[inside], atol=1e-7)
