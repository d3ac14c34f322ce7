"""Problems with b = 0 and nonzero bounds: the bounds alone set their size."""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from default_run import by_turns
from oracle import boxed, lemke
from warp_lcp.problem.operator_protocol import families

STOPPING = wl.StoppingCriteria(rtol=1e-8, max_iterations=2000, patience=2000)


def problems(most):
    """Yield A, and bounds of any sign.

    A is symmetric positive definite or has a skew part. Bounds: boxes, one-sided, fixed unknowns,
    equations.
    """
    rng = np.random.default_rng(2718)
    for trial in range(12):
        n = int(rng.integers(2, most + 1))
        Q, K = rng.standard_normal((2, n, n))
        A = Q @ Q.T + 0.1 * np.eye(n) + (0.3 * (K - K.T) if trial % 3 == 1 else 0.0)
        lower = rng.uniform(-2, 2, n)
        upper = lower + rng.uniform(0, 2, n)
        kind = trial % 4
        if kind == 0:
            upper[:] = np.inf
        if kind == 1:
            lower[:] = -np.inf
        if kind == 2:
            upper[0] = lower[0]
        if kind == 3:
            lower[0], upper[0] = -np.inf, np.inf
        yield A, lower, upper


@pytest.mark.parametrize(
    ("name", "family"),
    by_turns(
        [
            (name, family)
            for name, cls in wl.METHODS.items()
            for family in ("dense", "sparse")
            if family in families(cls)
        ]
    ),
)
def test_on_matrices(name, family):
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    solved = 0
    for A, lower, upper in problems(4 if name == "direct-enumeration" else 6):
        matrix = scipy.sparse.csr_array(A) if family == "sparse" else A
        try:
            result = wl.solve(
                wl.LCP(matrix, np.zeros(len(A)), lower, upper),
                wl.METHODS[name](),
                stopping=STOPPING,
            )
        except ValueError as error:
            assert "symmetric" in str(error)
            continue
        assert result, (name, result.status)
        np.testing.assert_allclose(
            result.x.numpy(), boxed(A, np.zeros(len(A)), lower, upper), atol=1e-5
        )
        solved += 1
    assert solved >= 8


@pytest.mark.parametrize(
    "name",
    [
        name
        for name, cls in wl.METHODS.items()
        if "grid" in families(cls) and name != "direct-enumeration"
    ],
)
@pytest.mark.parametrize("lower", [0.3, -0.3])
def test_on_a_membrane_that_an_obstacle_lifts(name, lower):
    """Membrane lifted by an obstacle.

    4 x 5 cells with x = 0 around, x >= lower in the middle; the oracle solves in x - l.
    """
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    cells, bound = np.zeros((6, 7), dtype=int), np.full((6, 7), -np.inf)
    cells[1:-1, 1:-1] = wl.FLUID
    bound[1:-1, 1:-1], bound[2:4, 2:5] = -1.0, lower
    path = [
        scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n)).toarray()
        for n in (5, 4)
    ]
    A, low = np.kron(np.eye(4), path[0]) + np.kron(path[1], np.eye(5)), bound[1:-1, 1:-1].ravel()
    result = wl.solve(
        wl.LCP(wl.GridPoisson(cells, device="cpu"), np.zeros(cells.shape), bound),
        wl.METHODS[name](),
        stopping=STOPPING,
    )
    assert result, result.status
    np.testing.assert_allclose(
        result.x.numpy()[1:-1, 1:-1].ravel(), low + lemke(A, A @ low), atol=1e-6
    )
