"""Empty rows of a matrix: y = b there, so x is at the bound of b's sign.

That holds for every method.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from matrices import operator_of
from oracle import lemke, natural_residual
from warp_lcp.problem.operator_protocol import families
from warp_lcp.problem.residual import NaturalResidual

N, EMPTY = 12, (3, 4, 9)
NAMES = [
    name
    for name, cls in wl.METHODS.items()
    if "sparse" in families(cls) and name != "direct-enumeration"
]


def chain():
    """Return a tridiagonal matrix with some unknowns cut out."""
    A = scipy.sparse.diags_array([-1.0, 2.05, -1.0], offsets=[-1, 0, 1], shape=(N, N)).toarray()
    A[list(EMPTY)], A[:, list(EMPTY)] = 0.0, 0.0
    b = np.random.default_rng(8).standard_normal(N)
    b[list(EMPTY)] = 0.2, -0.3, 0.0
    return A, b


@pytest.fixture(params=NAMES)
def method(request):
    if request.param == "quadratic-program":
        pytest.importorskip("piqp")
    return wl.METHODS[request.param]()


@pytest.mark.parametrize("sparse", [False, True])
def test_empty_rows_go_to_the_bound_selected_by_b(method, sparse, device):
    A, b = chain()
    problem = wl.LCP(operator_of(A, "sparse" if sparse else "dense", device), b, -1.0, 1.0)
    result = wl.solve(problem, method, stopping=wl.StoppingCriteria(max_iterations=300))
    x, l, u = result.x.numpy(), np.full(N, -1.0), np.full(N, 1.0)
    assert result, result.status
    np.testing.assert_allclose(x[list(EMPTY[:2])], [-1.0, 1.0], atol=1e-5)
    assert natural_residual(A, b, l, u, x) <= 1.01e-6 * natural_residual(A, b, l, u, np.zeros(N))


@pytest.mark.parametrize("sparse", [False, True])
def test_empty_rows_with_an_infinite_bound_have_no_solution(method, sparse, device):
    A, b = chain()
    problem = wl.LCP(
        operator_of(A, "sparse" if sparse else "dense", device), np.where(b == -0.3, 0.3, b)
    )
    try:
        assert (
            wl.solve(problem, method, stopping=wl.StoppingCriteria(max_iterations=300)).status
            is wl.SolveStatus.CONVERGED
        )
        problem = wl.LCP(operator_of(A, "sparse" if sparse else "dense", device), b)
        assert wl.solve(problem, method).status is wl.SolveStatus.INFEASIBLE
    except ValueError as refusal:  # sweeps refuse it before they start
        assert "unbounded move (row 4, b = -0.3)" in str(refusal)


def test_the_rows_are_found_again_when_the_entries_change(device):
    A, b = chain()
    full = scipy.sparse.csr_array(A + np.eye(N))
    problem = wl.LCP(
        wl.SparseOperator(full, device=device), np.abs(b) * [(-1) ** k for k in range(N)], 0.0, 2.0
    )
    assert problem.A.row_sizes is None
    zeroed = full.copy()
    zeroed.data[full.indptr[4] : full.indptr[5]] = 0.0
    problem.A.update(zeroed)
    assert np.flatnonzero(problem.A.row_sizes.numpy() == 0).tolist() == [4]
    problem.A.update(full)
    assert problem.A.row_sizes is None
    assert lemke(full.toarray(), problem.b.numpy()) is not None


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_x_that_is_not_finite_is_no_solution(value, device):
    """Solution x must be finite: y does not depend on an x whose column is empty."""
    problem = wl.LCP(
        wl.SparseOperator(scipy.sparse.csr_array((2, 2)), device=device),
        np.array([0.0, 0.0]),
        -np.inf,
    )
    x = wp.array([value, 0.0], dtype=wp.float64, device=device)
    assert np.isnan(NaturalResidual(problem).evaluate(x))
