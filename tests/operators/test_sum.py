"""Sums and low-rank operators against dense assembly, alone and in solvers."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp
from scipy.spatial.transform import Rotation

import warp_lcp as wl
from oracle import assemble, lemke

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=2000)


def dense_of(A):
    """Return the dense matrix of an operator, by products with unit vectors."""
    n = int(np.prod(A.shape))
    columns = [
        A.apply(wp.array(e.reshape(A.shape), dtype=wp.float64, device=A.device)).numpy().ravel()
        for e in np.eye(n)
    ]
    return np.array(columns).T


@pytest.fixture
def cells():
    cells = np.random.default_rng(3).choice(3, (5, 6), p=[0.15, 0.75, 0.1])
    cells[0, 0] = wl.AIR
    return cells


@pytest.mark.parametrize(
    "weights",
    [np.array([2.0, 0.5, 1.0]), np.array([[1.0, 0.2, 0.0], [-0.3, 2.0, 0.1], [0.0, 0.0, 1.0]])],
)
@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_low_rank_products(weights, dtype, device):
    U = np.random.default_rng(5).standard_normal((17, 3))
    W = np.diag(weights) if weights.ndim == 1 else weights
    A = wl.LowRankOperator(U, weights, device=device, dtype=dtype)
    x = wp.array(np.random.default_rng(7).standard_normal(17), dtype=wp.float64, device=device)
    accuracy = 1e-13 if dtype is wp.float64 else 1e-5
    np.testing.assert_allclose(A.apply(x).numpy(), U @ W @ U.T @ x.numpy(), atol=accuracy)
    np.testing.assert_allclose(
        A.apply_transpose(x).numpy(), U @ W.T @ U.T @ x.numpy(), atol=accuracy
    )
    np.testing.assert_allclose(A.diagonal().numpy(), np.diag(U @ W @ U.T), atol=accuracy)
    assert A.symmetric == (weights.ndim == 1)
    free = np.arange(17) % 3 != 0
    P = np.diag(free.astype(float))
    np.testing.assert_allclose(
        A.masked(free.astype(np.uint8)).apply(x).numpy(),
        P @ U @ W @ U.T @ P @ x.numpy(),
        atol=accuracy,
    )
    with pytest.raises(ValueError, match="not of low rank"):
        A.masked(free.astype(np.uint8), np.ones(17))


def test_sums_of_vectors(device):
    rng = np.random.default_rng(11)
    S, U = (
        scipy.sparse.random_array((20, 20), density=0.2, rng=rng).tocsr(),
        rng.standard_normal((20, 2)),
    )
    A = wl.SumOperator(
        wl.SparseOperator(S, device=device), wl.LowRankOperator(U, [1.0, 2.0], device=device)
    )
    dense = S.toarray() + U @ np.diag([1.0, 2.0]) @ U.T
    np.testing.assert_allclose(dense_of(A), dense, atol=1e-13)
    x = wp.array(rng.standard_normal(20), dtype=wp.float64, device=device)
    np.testing.assert_allclose(A.apply_transpose(x).numpy(), dense.T @ x.numpy(), atol=1e-13)
    np.testing.assert_allclose(A.diagonal().numpy(), np.diag(dense), atol=1e-13)
    free, shift = np.arange(20) % 2, rng.random(20)
    P = np.diag(free.astype(float))
    for order in (A, wl.SumOperator(A.second, A.first)):
        masked = order.masked(free.astype(np.uint8), shift)
        np.testing.assert_allclose(dense_of(masked), P @ dense @ P + P @ np.diag(shift), atol=1e-13)


def test_a_body_coupled_to_a_grid(cells, device):
    rng = np.random.default_rng(13)
    grid = wl.GridPoisson(cells, device=device, dtype=wp.float64)
    U = rng.standard_normal((*cells.shape, 3)) * (cells == wl.FLUID)[..., None]
    A = wl.SumOperator(grid, wl.LowRankOperator(U, [0.5, 1.0, 2.0], device=device))
    u = U.reshape(-1, 3)
    dense, fluid = assemble(cells) + u @ np.diag([0.5, 1.0, 2.0]) @ u.T, cells.ravel() == wl.FLUID
    np.testing.assert_allclose(dense_of(A), dense, atol=1e-12)
    assert A.symmetric
    b = rng.standard_normal(cells.shape)
    for precision in ("mixed", "double"):
        result = wl.solve(wl.LCP(A, b), wl.MinimumMapNewton(precision=precision), stopping=TIGHT)
        assert result, result.status
        expected = lemke(dense[np.ix_(fluid, fluid)], b.ravel()[fluid])
        np.testing.assert_allclose(result.x.numpy().ravel()[fluid], expected, atol=1e-7)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_weights_that_are_symmetric_but_for_rounding(cells, dtype, device):
    """Weights that are symmetric up to rounding.

    Those of a turned body: R I^-1 R' of equal moments is diagonal, and its off-diagonal rounding
    errors have no symmetry.
    """
    rng, grid = np.random.default_rng(19), wl.GridPoisson(cells, device=device, dtype=dtype)
    U = rng.standard_normal((*cells.shape, 3)) * (cells == wl.FLUID)[..., None]
    fluid, b = cells.ravel() == wl.FLUID, rng.standard_normal(cells.shape)
    uneven = 0
    for moments in (
        [1.0, 1.0, 1.0],
        [0.2, 0.2, 0.2],
        [1.0, 1.0, 3.0],
        [0.7, 1.9, 4.0],
        [1e-9, 2e-9, 2e-9],
    ):
        for rotation in Rotation.random(40, rng=rng).as_matrix():
            W = rotation @ np.diag(moments) @ rotation.T
            uneven += not np.array_equal(W, W.T)
            low = wl.LowRankOperator(U, W, device=device, dtype=dtype)
            assert low.symmetric
            W[0, 1] += 1e-12 * W[0, 0]
            assert not wl.LowRankOperator(U, W, device=device, dtype=dtype).symmetric
            low.update(W)
            assert not low.symmetric
    assert uneven > 100
    W = rotation @ np.eye(3) @ rotation.T
    A, u = (
        wl.SumOperator(grid, wl.LowRankOperator(U, W, device=device, dtype=dtype)),
        U.reshape(-1, 3),
    )
    result = wl.solve(
        wl.LCP(A, b),
        wl.MinimumMapNewton(precision="double" if dtype is wp.float64 else "mixed"),
        stopping=TIGHT,
    )
    assert result, result.status
    expected = lemke((assemble(cells) + u @ u.T)[np.ix_(fluid, fluid)], b.ravel()[fluid])
    np.testing.assert_allclose(
        result.x.numpy().ravel()[fluid], expected, atol=1e-7 if dtype is wp.float64 else 1e-5
    )


@pytest.mark.parametrize("felt", [(), (0,), (1,), (0, 2), (0, 1, 2)])
def test_chambers_coupled_to_a_body_do_not_float(felt, device):
    """Chambers coupled to a body do not float.

    Of three closed chambers, the null space is the constants of those that no column touches.
    """
    cells, U = np.full((4, 11), wl.SOLID), np.zeros((4, 11, 1))
    chambers = [
        np.arange(44).reshape(4, 11)[chamber].ravel()
        for chamber in (np.s_[:, :3], np.s_[:3, 4:7], np.s_[1:, 8:])
    ]
    cells.ravel()[np.concatenate(chambers)] = wl.FLUID
    for k in felt:
        U.ravel()[chambers[k]] = 1.0
    A = wl.SumOperator(
        wl.GridPoisson(cells, device=device), wl.LowRankOperator(U, [2.0], device=device)
    )
    found = A.floating_components()
    count = 0 if found is None else found.count
    label = (
        np.zeros(44)
        if found is None
        else found.label.reshape(A.layout.stored_shape)[1, 1:-1, 1:-1].ravel()
    )
    assert {frozenset(np.flatnonzero(label == c)) for c in range(count)} == {
        frozenset(c) for k, c in enumerate(chambers) if k not in felt
    }
    fluid = cells.ravel() == wl.FLUID
    block = dense_of(A)[np.ix_(fluid, fluid)]
    # One column removes one constant.
    assert len(block) - np.linalg.matrix_rank(block) == count + max(0, len(felt) - 1)


def test_an_unsymmetric_sum_in_a_solver(device):
    rng = np.random.default_rng(17)
    S = (
        scipy.sparse.random_array((30, 30), density=0.1, rng=rng) + 4 * scipy.sparse.eye_array(30)
    ).tocsr()
    U = rng.standard_normal((30, 2))
    A = wl.SumOperator(
        wl.SparseOperator(S, device=device), wl.LowRankOperator(U, [0.5, 1.0], device=device)
    )
    dense, b = S.toarray() + U @ np.diag([0.5, 1.0]) @ U.T, rng.standard_normal(30)
    result = wl.solve(wl.LCP(A, b), wl.MinimumMapNewton(), stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), lemke(dense, b), atol=1e-7)


def test_mismatched_terms_are_refused(cells):
    U = np.ones((*cells.shape, 1))
    sparse = wl.SparseOperator(scipy.sparse.eye_array(4), device="cpu")
    with pytest.raises(ValueError, match="B has shape"):
        wl.SumOperator(sparse, wl.LowRankOperator(U, [1.0], device="cpu"))
    for columns, weights, message in (
        (np.ones(3), [1.0], "columns has shape"),
        (np.ones((3, 2)), [1.0], "weights has shape"),
        (np.full((3, 1), np.inf), [1.0], "columns holds"),
        (np.ones((3, 1)), [np.nan], "weights holds"),
    ):
        with pytest.raises(ValueError, match=message):
            wl.LowRankOperator(columns, weights, device="cpu")
    summed = wl.SumOperator(sparse, wl.LowRankOperator(np.ones((4, 1)), [1.0], device="cpu"))
    with pytest.raises(ValueError, match="ProjectedSOR needs an operator with a sweep"):
        wl.solve(wl.LCP(summed, -np.ones(4)), wl.ProjectedSOR())
    with pytest.raises(ValueError, match="x has shape"):
        summed.apply(wp.zeros(5, dtype=wp.float64, device="cpu"))
