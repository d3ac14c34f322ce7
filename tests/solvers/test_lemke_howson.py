"""Bimatrix games: equilibria by definition, as best responses.

Problems that are no games keep Lemke's own start.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from warp_lcp.solvers.lemke import strategies

EXACT = wl.StoppingCriteria(rtol=1e-10, max_iterations=1000)


def game(seed, *, integer):
    """Return the costs of two players."""
    rng = np.random.default_rng([seed, 4711])
    shape = tuple(rng.integers(1, 25, 2))
    draw = (
        (lambda: rng.integers(1, 4, shape).astype(float))
        if integer
        else (lambda: rng.uniform(0.1, 3, shape))
    )
    return draw(), draw()


def problem(E, F):
    """Return the LCP of costs E, F.

    E y >= 1 and F'x >= 1 are complementary to x, y >= 0.
    """
    A = np.zeros((sum(E.shape),) * 2)
    A[: len(E), len(E) :], A[len(E) :, : len(E)] = E, F.T
    return A, -np.ones(len(A))


@pytest.mark.default_cases(10)
@pytest.mark.parametrize("integer", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_equilibria_are_best_answers_to_each_other(seed, integer):
    """Equilibria as best responses to each other.

    No strategy that a player uses costs more than another; integers make degenerate games, with
    ties at each pivot.
    """
    E, F = game(seed, integer=integer)
    A, b = problem(E, F)
    for method in (wl.Lemke(), None):
        result = wl.solve(wl.LCP(A, b), method, stopping=EXACT)
        assert result
        x, y = np.split(result.x.numpy(), [len(E)])
        x, y = x / x.sum(), y / y.sum()
        for used, costs in ((x, E @ y), (y, F.T @ x)):
            assert used.min() >= 0
            assert costs[used > 1e-9].max() <= costs.min() + 1e-9


def test_order_and_units_do_not_matter():
    """Order and units without influence.

    Permuted and scaled by rows and columns, a game stays a game.
    """
    E, F = game(3, integer=False)
    A, b = problem(E, F)
    rng = np.random.default_rng(9)
    order, r, c = (
        rng.permutation(len(A)),
        10 ** rng.uniform(-2, 2, len(A)),
        10 ** rng.uniform(-2, 2, len(A)),
    )
    result = wl.solve(
        wl.LCP((r[:, None] * A * c)[order][:, order], (r * b)[order]), wl.Lemke(), stopping=EXACT
    )
    assert result
    x = np.empty(len(A))
    x[order] = result.x.numpy()
    x *= c
    assert (A @ x + b).min() >= -1e-9
    assert abs(x @ (A @ x + b)) <= 1e-9


def test_problems_that_are_no_game_use_the_lemke_start():
    A, b = problem(*game(5, integer=False))
    assert strategies(A, b) is not None
    negative, within, positive, zero = A.copy(), A.copy(), b.copy(), A.copy()
    negative[0, -1], within[0, 0], positive[0], zero[0, -1] = -1.0, 1.0, 1.0, 0.0
    for matrix, side in (
        (negative, b),
        (within, b),
        (A, positive),
        (zero, b),
        (np.zeros_like(A), b),
    ):
        assert strategies(matrix, side) is None


def test_sparse_games_are_games():
    A, b = problem(*game(7, integer=False))
    assert wl.solve(wl.LCP(scipy.sparse.csr_array(A), b), stopping=EXACT)
