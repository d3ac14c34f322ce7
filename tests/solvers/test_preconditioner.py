"""User-defined preconditioner: fewer iterations, equal solutions.

There is no false success.
"""

import numpy as np
import pyamg
import pytest
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, aslinearoperator, spilu

import warp_lcp as wl
from default_run import covering
from warp_lcp.problem.operator_protocol import families

M = 24
A = pyamg.gallery.poisson((M, M), format="csr")
B = 0.1 * np.random.default_rng(23).standard_normal(M * M) - 0.02
STOPPING = wl.StoppingCriteria(rtol=1e-9)
EXACT = wl.solve(wl.LCP(A, B), wl.Lemke(), stopping=wl.StoppingCriteria(rtol=1e-11)).x.numpy()


def solve(A, M, method=None, b=B):
    return wl.solve(
        wl.LCP(A, b, preconditioner=M), method or wl.MinimumMapNewton(), stopping=STOPPING
    )


@pytest.mark.parametrize("kind", ["sparse", "products", "dense"])
def test_multigrid_of_pyamg_takes_few_iterations(kind):
    operator = {
        "sparse": A,
        "products": wl.LinearOperator(aslinearoperator(A), symmetric=True),
        "dense": A.toarray(),
    }[kind]
    found = solve(operator, pyamg.smoothed_aggregation_solver(A).aspreconditioner())
    assert found
    np.testing.assert_allclose(found.x.numpy(), EXACT, atol=1e-6)
    if kind == "products":
        assert 3 * found.linear_iterations < solve(operator, None).linear_iterations


@pytest.mark.parametrize(
    "name",
    [name for name, method in wl.METHODS.items() if getattr(method, "preconditioned", False)],
)
def test_methods_that_declare_it_accept_a_preconditioner(name):
    calls = []

    def count(r):
        calls.append(0)
        return r / 4

    found = solve(A, LinearOperator(A.shape, matvec=count, dtype=np.float64), wl.METHODS[name]())
    assert found
    np.testing.assert_allclose(found.x.numpy(), EXACT, atol=1e-6)
    assert len(calls) > 2  # two of them check it


@pytest.mark.parametrize(
    "name",
    [
        name
        for name, cls in wl.METHODS.items()
        if families(cls) and not getattr(cls, "preconditioned", False)
    ],
)
def test_methods_that_make_no_use_of_one_refuse_it(name):
    with pytest.raises(
        ValueError, match=r"preconditioner: .* does not use one: use MinimumMapNewton"
    ):
        solve(A, scipy.sparse.eye_array(M * M), wl.METHODS[name]())


def test_unsymmetric_systems_take_incomplete_factors():
    convection = (A + scipy.sparse.diags_array([0.8, -0.8], offsets=[1, -1], shape=A.shape)).tocsc()
    factors = spilu(convection, drop_tol=1e-3)
    operator = wl.LinearOperator(aslinearoperator(convection))
    found = solve(operator, LinearOperator(A.shape, matvec=factors.solve, dtype=np.float64))
    assert found
    exact = wl.solve(wl.LCP(convection, B), wl.Lemke(), stopping=STOPPING).x.numpy()
    np.testing.assert_allclose(found.x.numpy(), exact, atol=1e-6)
    assert 2 * found.linear_iterations < solve(operator, None).linear_iterations


def varying():
    rng = np.random.default_rng(6)
    return LinearOperator(
        A.shape, matvec=lambda r: r * rng.uniform(0.1, 1.0, r.size), dtype=np.float64
    )


def failing():
    calls = []

    def late(r):
        calls.append(0)
        return r if len(calls) < 6 else np.full_like(r, np.nan)

    return LinearOperator(A.shape, matvec=late, dtype=np.float64)


WRONG = {
    "negative": lambda: -scipy.sparse.eye_array(M * M),
    "indefinite": lambda: scipy.sparse.diags_array(np.where(np.arange(M * M) % 2, 1.0, -1.0)),
    "singular": lambda: scipy.sparse.diags_array((np.arange(M * M) % 2).astype(float)),
    "zero": lambda: scipy.sparse.csr_array((M * M, M * M)),
    "unsymmetric": lambda: scipy.sparse.eye_array(M * M) + 5 * scipy.sparse.eye_array(M * M, k=1),
    "varying": varying,
    "failing": failing,
}


@pytest.mark.parametrize(
    ("kind", "operator"), covering(list(WRONG), [A, wl.LinearOperator(aslinearoperator(A))])
)
def test_an_unsuitable_preconditioner_causes_no_false_success(kind, operator):
    """Invalid preconditioner: no false success.

    It may cost iterations, or the solution; a converged result is the solution.
    """
    found = solve(operator, WRONG[kind]())
    assert np.isfinite(found.x.numpy()).all()
    if found:
        np.testing.assert_allclose(found.x.numpy(), EXACT, atol=1e-5)
    else:
        assert found.relative_residual > 1e-9
    assert bool(found) or kind != "negative"  # GMRES works with that


def test_definite_preconditioners_are_recognized():
    """Preconditioners that conjugate gradients can use: symmetric and positive definite."""
    definite = {
        "identity": scipy.sparse.eye_array(M * M),
        "matrix": A,
        "multigrid": pyamg.smoothed_aggregation_solver(A).aspreconditioner(),
    }
    for name, given in definite.items():
        assert wl.LCP(A, B, preconditioner=given).preconditioner.definite, name
    for name in ("negative", "unsymmetric", "zero"):
        assert not wl.LCP(A, B, preconditioner=WRONG[name]()).preconditioner.definite, name


def test_recommendations_take_it():
    advice = wl.recommend(wl.LCP(A, B, preconditioner=scipy.sparse.eye_array(M * M)))
    assert advice.name == "minimum-map-newton"
    assert not advice.method.direct
    assert set(advice.alternatives) == {"primal-dual-active-set"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (3.0, "preconditioner is a float: expected an object with products M @ r"),
        (
            pyamg.smoothed_aggregation_solver(A),
            r"preconditioner is a MultilevelSolver: .* PyAMG's is ml.aspreconditioner\(\)",
        ),
        (np.eye(3), r"preconditioner has shape \(3, 3\): expected \(576, 576\)"),
        (
            1j * scipy.sparse.eye_array(M * M),
            "preconditioner gives products of shape .* and type complex128",
        ),
        (
            np.nan * scipy.sparse.eye_array(M * M),
            "preconditioner gives products that are not finite",
        ),
    ],
)
def test_invalid_preconditioners_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        wl.LCP(A, B, preconditioner=given)


def test_grids_use_their_own_preconditioner():
    with pytest.raises(ValueError, match="preconditioner: cannot be given for systems on grids"):
        wl.LCP(
            wl.GridPoisson(np.ones((4, 4), dtype=int), shift=1.0, device="cpu"),
            np.ones((4, 4)),
            preconditioner=np.eye(16),
        )
