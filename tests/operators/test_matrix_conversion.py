"""Restated problems: solutions, starts and bounds of the original one.

The residual is computed by NumPy.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from default_run import covering
from matrices import laplacian
from oracle import natural_residual
from warp_lcp.operators import reordering
from warp_lcp.operators.matrix_conversion import as_dense, as_grid, as_sparse, renumbered


def small(seed, *, sparse):
    A = laplacian(6, 2.1) + scipy.sparse.diags_array(np.random.default_rng(seed).uniform(0, 1, 36))
    return scipy.sparse.csr_array(A) if sparse else A.toarray()


def shuffled(seed):
    A, order = laplacian(48, 2.1), np.random.default_rng(seed).permutation(48 * 48)
    return scipy.sparse.csr_array(A[order][:, order])


FORMS = {
    "dense": (as_dense, lambda seed: small(seed, sparse=True)),
    "sparse": (as_sparse, lambda seed: small(seed, sparse=False)),
    "grid": (as_grid, lambda seed: laplacian(48, 2.1)),
    "renumbered": (renumbered, shuffled),
}


@pytest.mark.parametrize(("name", "seed"), covering(list(FORMS), [5101, 5102]))
def test_solutions_and_starts_are_those_of_the_given_problem(name, seed, monkeypatch):
    monkeypatch.setattr(reordering, "SMALLEST", 100)
    form, make = FORMS[name]
    A, rng = make(seed), np.random.default_rng(seed)
    n, dense = A.shape[0], A.toarray() if scipy.sparse.issparse(A) else A
    b, low = rng.standard_normal(n), -rng.random(n)
    high = low + rng.uniform(0.1, 2, n)
    problem = wl.LCP(A, b, low, high)
    restated = form(problem)
    assert restated is not None
    stopping = wl.StoppingCriteria(rtol=1e-9, max_iterations=200)
    found = restated.result(
        wl.solve(restated.problem, wl.MinimumMapNewton(precision="double"), stopping=stopping)
    )
    x = found.x.numpy()
    assert found.problem is problem
    assert x.shape == (n,)
    first = natural_residual(dense, b, low, high, np.clip(np.zeros(n), low, high))
    assert natural_residual(dense, b, low, high, x) <= 1.01e-9 * first
    again = wl.solve(
        restated.problem, "psor", x0=restated.start(x), stopping=wl.StoppingCriteria(rtol=1e-8)
    )
    assert again.iterations == 0
