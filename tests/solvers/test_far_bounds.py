"""Far finite bounds, 1e15 to 1e308: the same solution, or an honest status."""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from default_run import covering
from oracle import boxed
from warp_lcp.problem.protocol import families

DRAWS = 2  # problems for each method, dense and sparse, each with two sizes of bounds
SIZES = (1e15, 1e20, 1e30, 1e60, 1e100, 1e160, 1e200, 1e300, 1e308)
# Dense: these methods always solve it.
ANSWERS = (
    "lemke",
    "fischer-newton",
    "minimum-map-newton",
    "direct-enumeration",
    "incremental-pivoting",
)


def drawn(seed, symmetric):
    """Return A, positive definite, b, the bounds, and far bounds for infinity."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    root, turn = rng.standard_normal((n, n)), rng.standard_normal((n, n))
    A, b = (
        root @ root.T + 0.3 * np.eye(n) + (0 if symmetric else turn - turn.T),
        rng.standard_normal(n) * rng.choice([1.0, 1e3]),
    )
    lower = np.where(rng.random(n) < 0.5, rng.uniform(-1, 0.5, n), -np.inf)
    upper = np.where(rng.random(n) < 0.5, rng.uniform(0.6, 2, n), np.inf)
    far = rng.choice(SIZES, 2)
    keep = rng.random(n) < 0.2
    return (
        A,
        b,
        lower,
        upper,
        np.where(np.isinf(lower), -far[0], lower),
        np.where(np.isinf(upper) & ~keep, far[1], upper),
    )


def check(name, seeds, sparse):
    """Check that there is no exception, false CONVERGED or INFEASIBLE.

    Warnings are errors too.
    """
    method, converged = wl.METHODS[name], 0
    for seed in seeds:
        A, b, lower, upper, low, high = drawn(
            seed, "symmetric" in getattr(method, "needs", "") or seed % 2
        )
        result = wl.solve(
            wl.LCP(scipy.sparse.csr_array(A) if sparse else A, b, low, high), method()
        )
        assert result.status is not wl.SolveStatus.INFEASIBLE, (name, seed)
        if result:
            expected = boxed(A, b, lower, upper)
            np.testing.assert_allclose(
                result.x.numpy(),
                expected,
                atol=1e-4 * max(1.0, np.abs(expected).max()),
                err_msg=f"{name} {seed}",
            )
        converged += bool(result)
    return converged


def named(sparse):
    return [
        name
        for name, kind in wl.METHODS.items()
        if ("sparse" if sparse else "dense") in families(kind)
    ]


@pytest.mark.parametrize("name", named(sparse=False))
def test_dense(name):
    seeds = range(7100, 7100 + DRAWS)
    converged = check(name, seeds, sparse=False)
    assert converged == len(seeds) or name not in ANSWERS


@pytest.mark.parametrize("name", named(sparse=True))
def test_sparse(name):
    check(name, range(7200, 7200 + DRAWS), sparse=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*named(sparse=False), *named(sparse=True)}))
def test_many(name):
    for sparse in (False, True):
        if name in named(sparse):
            check(name, range(7300, 7360), sparse)


@pytest.mark.parametrize(("size", "method"), covering(SIZES, [wl.Lemke(), wl.FischerNewton()]))
def test_both_sides_far(method, size):
    """Far bounds on both sides.

    1 = x, whatever the far bounds are. A solution at a far bound may be missed, but never reported
    not to exist.
    """
    A, b = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.array([-1.0, -1.0])
    result = wl.solve(wl.LCP(A, b, -size, size), method)
    assert result
    np.testing.assert_allclose(result.x.numpy(), 1.0, atol=1e-5)
    flat = wl.solve(wl.LCP(np.zeros((2, 2)), b, -size, size), method)
    assert flat.status is not wl.SolveStatus.INFEASIBLE
    assert not flat or (flat.x.numpy() == size).all()
