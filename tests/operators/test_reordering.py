"""Matrices with random numbering: solved in another order.

Results come back in the caller's order.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from warp_lcp.operators.reordering import renumbering

N = 260  # n^2 unknowns are enough for another order to pay


def shuffled(n=N, *, block=1, wind=0.0, seed=30211):
    """Return an obstacle problem with randomly numbered nodes: A, b, l, numbers.

    Each node has `block` components.
    """
    second = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n))
    convection = scipy.sparse.diags_array([-wind, wind], offsets=[-1, 0], shape=(n, n))
    one = scipy.sparse.eye_array(n)
    A = scipy.sparse.kron(
        scipy.sparse.kron(one, second + convection) + scipy.sparse.kron(second, one),
        np.eye(block) + 0.1,
    ).tocsr()
    rng = np.random.default_rng(seed)
    order = (block * rng.permutation(n * n)[:, None] + np.arange(block)).ravel()
    x = np.linspace(-1, 1, n)
    lower = np.repeat((0.4 - x[:, None] ** 2 - x**2).ravel(), block)
    A = A[order][:, order].tocsr()
    A.sort_indices()
    return A, np.full(len(order), 8.0 / n**2), lower[order], order


@pytest.mark.parametrize("block", [1, 2])
def test_the_order_is_a_permutation_that_gathers_entries(block):
    A = shuffled(block=block)[0]
    found = renumbering(scipy.sparse.csr_array(A), block)
    np.testing.assert_array_equal(np.sort(found.order), np.arange(A.shape[0]))
    np.testing.assert_array_equal(found.place[found.order], np.arange(A.shape[0]))
    assert (found.order.reshape(-1, block) % block == np.arange(block)).all()
    moved = found.matrix(scipy.sparse.csr_array(A))
    assert abs(moved - A[found.order][:, found.order]).max() == 0
    entries = moved.tocoo()
    assert np.abs(entries.row - entries.col).max() < 4 * block * N


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("wind", [0.0, 0.4])
def test_results_come_back_in_the_numbering_of_the_problem(wind):
    A, b, lower, order = shuffled(wind=wind)
    seen = []
    result = wl.solve(wl.LCP(wl.SparseOperator(A, device="cpu"), b, lower), callback=seen.append)
    assert result
    assert seen == result.history
    x, d = result.x.numpy(), A.diagonal()
    scale = np.linalg.norm(
        d
        * (
            np.maximum(lower, 0)
            - np.maximum(np.maximum(lower, 0) - (A @ np.maximum(lower, 0) + b) / d, lower)
        )
    )
    assert np.linalg.norm(d * (x - np.maximum(x - (A @ x + b) / d, lower))) <= 1.01e-6 * scale
    again = wl.solve(wl.LCP(wl.SparseOperator(A, device="cpu"), b, lower), x0=result.x)
    assert again.iterations == 0
    np.testing.assert_array_equal(again.x.numpy(), x)
    back = np.argsort(order)
    plain = wl.solve(
        wl.LCP(wl.SparseOperator(A[back][:, back], device="cpu"), b[back], lower[back])
    )
    np.testing.assert_allclose(x[back], plain.x.numpy(), atol=1e-4)


def test_other_entries_are_taken():
    A = shuffled()[0]
    operator = wl.SparseOperator(A, device="cpu")
    first = operator.renumbered()[1]
    assert operator.renumbered()[1] is first
    operator.update(2 * A.data)
    assert abs(operator.renumbered()[1].matrix() - 2 * first.matrix()).max() == 0


def test_wrong_guesses_and_limits_have_the_usual_messages():
    A, b, lower, _ = shuffled()
    problem = wl.LCP(wl.SparseOperator(A, device="cpu"), b, lower)
    with pytest.raises(ValueError, match="x0"):
        wl.solve(problem, x0=np.zeros(3))
    assert (
        wl.solve(problem, stopping=wl.StoppingCriteria(max_seconds=1e-6)).status
        is wl.SolveStatus.TIME_LIMIT
    )


def test_good_orders_small_matrices_and_graphs_without_an_order_are_left_alone():
    A, order = shuffled()[0], shuffled()[3]
    back = np.argsort(order)
    rng = np.random.default_rng(30219)
    assert renumbering(scipy.sparse.csr_array(A[back][:, back])) is None
    assert renumbering(scipy.sparse.csr_array(shuffled(40)[0])) is None
    n = N * N
    edges = scipy.sparse.coo_array(
        (np.ones(4 * n), (rng.integers(0, n, 4 * n), rng.integers(0, n, 4 * n))), shape=(n, n)
    ).tocsr()
    assert renumbering((edges + edges.T).tocsr()) is None
