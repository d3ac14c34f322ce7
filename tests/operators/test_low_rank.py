"""Columns stored by their rows, in blocks, and rewritten in place."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.operators.low_rank import BlockColumns

# Two rows belong to both blocks.
ROWS, BLOCKS = np.array([2, 2, 5, 9, 9, 11]), np.array([0, 1, 1, 0, 1, 0])


def columns_on(device, seed):
    """Return columns of two blocks of three, and the same as a dense matrix."""
    values = np.random.default_rng(seed).standard_normal((len(ROWS), 3))
    columns, dense = BlockColumns(12, 2, 3, wp.float64, wp.get_device(device)), np.zeros((12, 6))
    columns.assign(ROWS, BLOCKS, values)
    for row, block, value in zip(ROWS, BLOCKS, values, strict=True):
        dense[row, 3 * block : 3 * block + 3] = value
    return columns, dense


def test_rows_that_two_blocks_share_are_added_up(device):
    columns, U = columns_on(device, 23)
    rng = np.random.default_rng(29)
    x, f, base = rng.standard_normal(12), rng.standard_normal(6), rng.standard_normal(12)
    stored = wp.array(x, dtype=wp.float64, device=device)
    np.testing.assert_allclose(columns.gather(stored).numpy(), U.T @ x, atol=1e-14)
    out = wp.array(base, dtype=wp.float64, device=device)
    columns.scatter(wp.array(f, dtype=wp.float64, device=device), out, out)
    np.testing.assert_allclose(out.numpy(), base + U @ f, atol=1e-14)
    mask = np.arange(12) != 9
    out.assign(base)
    columns.scatter(
        wp.array(f, dtype=wp.float64, device=device),
        out,
        out,
        mask=wp.array(mask.astype(np.uint8), dtype=wp.uint8, device=device),
    )
    np.testing.assert_allclose(out.numpy(), base + np.where(mask, U @ f, 0.0), atol=1e-14)


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_the_diagonal_is_of_the_type_of_the_fields(dtype, device):
    U = np.random.default_rng(41).standard_normal((12, 6))
    diagonal = wl.LowRankOperator(U, np.eye(6), dtype=dtype, device=device).diagonal()
    assert diagonal.dtype is dtype
    np.testing.assert_allclose(diagonal.numpy(), (U**2).sum(axis=1), rtol=1e-6, atol=1e-14)


def test_an_operator_takes_what_its_columns_have_become(device):
    columns, U = columns_on(device, 31)
    W = np.diag([1.0, 2.0, 0.5, 0.0, 3.0, 1.0])
    W[0, 1] = W[1, 0] = 0.3
    plain = wl.DenseOperator(np.eye(12), device=device)
    low = wl.LowRankOperator.of_blocks(plain, columns, W)
    A = wl.SumOperator(plain, low)
    x = wp.array(np.random.default_rng(37).standard_normal(12), dtype=wp.float64, device=device)
    np.testing.assert_allclose(A.apply(x).numpy(), x.numpy() + U @ W @ U.T @ x.numpy(), atol=1e-13)
    np.testing.assert_allclose(A.diagonal().numpy(), 1.0 + np.diag(U @ W @ U.T), atol=1e-13)
    version = A.version
    rows, blocks, values = columns.entries()
    columns.assign(rows, blocks, 2.0 * values)
    low.update(3.0 * W)
    assert A.version > version
    np.testing.assert_allclose(
        A.apply(x).numpy(), x.numpy() + 12.0 * U @ W @ U.T @ x.numpy(), atol=1e-12
    )
    with pytest.raises(ValueError, match="weights has shape"):
        low.update(np.eye(5))
    with pytest.raises(ValueError, match="columns are for fields"):
        wl.LowRankOperator.of_blocks(wl.DenseOperator(np.eye(5), device=device), columns, W)


def test_only_rows_that_are_not_zero_are_stored(device):
    U = np.zeros((40, 50, 2))
    U[3, 4], U[30, 7] = [1.0, 2.0], [0.0, -1.0]
    low = wl.LowRankOperator(U, [1.0, 2.0], device=device)
    assert low.columns.capacity == 2
    grid = wl.GridPoisson(np.ones((40, 50), dtype=int), device=device, dtype=wp.float64)
    A = wl.SumOperator(grid, low)
    assert A.second.columns.capacity == 2
    x = np.random.default_rng(41).standard_normal((40, 50))
    field = wp.array(x, dtype=wp.float64, device=device)
    u = U.reshape(-1, 2)
    expected = grid.apply(field).numpy().ravel() + u @ np.diag([1.0, 2.0]) @ u.T @ x.ravel()
    np.testing.assert_allclose(A.apply(field).numpy().ravel(), expected, atol=1e-12)


@pytest.mark.parametrize(("column", "floats"), [([1.0, -1.0], True), ([1.0, 1.0], False)])
def test_a_column_that_feels_the_constants_grounds_a_closed_component(column, floats, device):
    """Column that is not orthogonal to constants: it grounds a closed component.

    A body that is moved by the mean pressure of a chamber closes it as a piston does; one in its
    interior does not.
    """
    cells = np.ones((4, 4), dtype=int)
    U = np.zeros((4, 4, 1))
    U[1, 1], U[1, 2] = column[0], column[1]
    A = wl.SumOperator(
        wl.GridPoisson(cells, device=device), wl.LowRankOperator(U, [2.0], device=device)
    )
    assert (A.floating_components() is not None) == floats
