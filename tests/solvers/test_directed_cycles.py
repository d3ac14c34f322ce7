"""Directed graphs, I - rho S with a stochastic S.

Couplings go one way along cycles, where algebraic multigrid fails.
"""

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import warp as wp

import warp_lcp as wl
from default_run import chosen
from warp_lcp.subproblems.principal_system import principal_system


def stochastic(rng, n, kind):
    """Return S with row sums 1.

    A shift in natural order, one cycle or several in a random order, or a weighted graph of 2 to 5
    arcs per node.
    """
    order, ones = rng.permutation(n), np.ones(n)
    if kind == "shift":
        return scipy.sparse.csr_array((ones, (np.arange(n), (np.arange(n) + 1) % n)), shape=(n, n))
    if kind == "one cycle":
        return scipy.sparse.csr_array((ones, (order, np.roll(order, -1))), shape=(n, n))
    if kind == "several cycles":
        return scipy.sparse.csr_array((ones, (np.arange(n), order)), shape=(n, n))
    arcs = int(rng.integers(2, 6))
    ends = np.repeat(np.arange(n), arcs), np.r_[rng.integers(0, n, n * (arcs - 1)), order]
    W = scipy.sparse.csr_array((rng.uniform(0.1, 1, n * arcs), ends), shape=(n, n))
    return scipy.sparse.diags_array(1 / np.asarray(W.sum(axis=1)).ravel()) @ W


def drawn(seed, largest):
    """Return A = I - rho S with rho from 0.9 to 1 - 1e-9, and b."""
    rng = np.random.default_rng([seed, 52])
    n, rho = int(np.exp(rng.uniform(np.log(300), np.log(largest)))), 1 - 10 ** rng.uniform(-9, -1)
    S = stochastic(rng, n, rng.choice(["shift", "one cycle", "several cycles", "graph"]))
    b = rng.standard_normal(n) - rng.choice([0.0, 0.3, 1.0, 3.0])
    return (scipy.sparse.eye_array(n) - rho * S).tocsr(), -np.abs(b) if rng.random() < 0.3 else b


def by_active_sets(A, b):
    """Return x by active sets and SuperLU.

    For an M-matrix each set is part of the one before.
    """
    x, active = np.zeros(len(b)), np.zeros(len(b), dtype=bool)
    for _ in range(len(b)):
        rows = np.flatnonzero(~active)
        x[:] = 0.0
        x[rows] = scipy.sparse.linalg.splu(A[rows][:, rows].tocsc()).solve(-b[rows])
        y = A @ x + b
        y[rows] = 0.0
        new = np.where(active, y >= 0, x < 0)
        if (new == active).all():
            return x
        active = new
    raise AssertionError


def check(seed, largest):
    A, b = drawn(seed, largest)
    result = wl.solve(wl.LCP(wl.SparseOperator(A, device="cpu"), b))
    assert result, (seed, result.status, result.relative_residual)
    x = result.x.numpy()
    assert np.linalg.norm(np.minimum(x, A @ x + b)) <= 2e-6 * np.linalg.norm(np.minimum(b, 0.0)), (
        seed
    )
    return A, b, result


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("seed", chosen(range(16), [2, 10, 11, 12]))  # one of each kind
def test_cycles_are_solved_by_default(seed):
    """Half of these ended MAX_ITERATIONS or STAGNATED, with relative residuals up to .96."""
    check(seed, 3000)


def test_the_solution_is_that_of_active_sets():
    A, b, _ = check(seed := 9, 3000)
    exact = by_active_sets(A, b)
    tight = wl.StoppingCriteria(rtol=1e-12, max_iterations=200)
    x = wl.solve(
        wl.LCP(wl.SparseOperator(A, device="cpu"), b),
        wl.MinimumMapNewton(precision="double"),
        stopping=tight,
    ).x.numpy()
    inverse = np.abs(exact).max() / np.abs(b).max()  # factor of A's inverse on a residual
    assert np.abs(x - exact).max() <= 1e-10 * inverse * np.abs(exact).max(), seed


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_factors_take_over_from_a_hierarchy_that_fails(real):
    """Factors after a failure of the hierarchy.

    They stay for the next free set; an update of the entries gives the hierarchy another chance.
    """
    rng, n = np.random.default_rng(8), 2500
    A = (scipy.sparse.eye_array(n) - 0.999999 * stochastic(rng, n, "several cycles")).tocsr()
    operator = wl.SparseOperator(A, device="cpu")
    system, r = (
        principal_system(wl.LCP(operator, np.zeros(n)), real, bounded=False),
        rng.standard_normal(n),
    )
    for share in (1.0, 0.9):
        free = (rng.random(n) < share).astype(np.uint8)
        system.restrict(wp.array(free, device="cpu"))
        system.r.assign(free * r)
        before = system._substitute is not None
        iterations, _ = system.solve(1e-5 * system.norm(), 200)
        inside = np.flatnonzero(free)
        e = system.e.numpy()[inside].astype(np.float64)
        # Rounding error of e itself.
        stored = np.finfo(wp.dtype_to_numpy(real)).eps * np.linalg.norm(e)
        assert (
            np.linalg.norm(A[inside][:, inside] @ e - r[inside])
            <= 2e-5 * np.linalg.norm(r) + stored
        )
        assert not before or iterations <= 4
    assert system._substitute is not None
    operator.update((A + 0.5 * scipy.sparse.eye_array(n)).tocsr())
    system.refresh()
    system.restrict(wp.array(np.ones(n, dtype=np.uint8), device="cpu"))
    system.r.assign(r)
    assert system.solve(1e-5 * system.norm(), 200)[0] <= 30
    assert system._substitute is None


def test_shifts_are_weighed_as_before():
    """Norms of shifted systems, in units of the shifted diagonal for every solver."""
    rng, n = np.random.default_rng(9), 1200
    A = (scipy.sparse.eye_array(n) - 0.9999999 * stochastic(rng, n, "shift")).tocsr()
    system = principal_system(
        wl.LCP(wl.SparseOperator(A, device="cpu"), np.zeros(n)),
        wp.float64,
        bounded=False,
        shifted=True,
    )
    D, r = (
        np.where(np.arange(n) % 200 == 0, 10.0 ** rng.uniform(2, 6, n), 0.0),
        rng.standard_normal(n),
    )
    system.restrict(
        wp.array(np.ones(n, dtype=np.uint8), device="cpu"),
        wp.array(D, dtype=wp.float64, device="cpu"),
    )
    system.r.assign(r)
    tolerance = 1e-9 * system.norm()
    _, norm = system.solve(tolerance, 200)
    left = (A @ system.e.numpy() + D * system.e.numpy() - r) / np.sqrt(1 + D)
    assert norm <= tolerance
    assert np.linalg.norm(left) <= 1.01 * tolerance


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 220))
def test_many_cycles_are_solved_by_default(seed):
    check(seed, 10000)
