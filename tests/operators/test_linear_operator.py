"""Operators by their products alone.

Functions, SciPy's LinearOperator, and subclasses of wl.Operator with only an `apply`.
"""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import warp as wp
from scipy.sparse.linalg import LaplacianNd, aslinearoperator
from scipy.sparse.linalg import LinearOperator as Linear

import warp_lcp as wl
from default_run import covering
from oracle import boxed, lemke
from warp_lcp.problem.operator_protocol import families, takes

STOPPING = wl.StoppingCriteria(rtol=1e-8, max_iterations=20_000, patience=5000)
N = 8


def matrix(symmetric, seed=31):
    """Return a positive definite matrix with rows and columns of 0.03 to 30."""
    rng = np.random.default_rng(seed)
    B, D = rng.standard_normal((N, N)), 10.0 ** rng.uniform(-0.75, 0.75, N)
    skew = 0.0 if symmetric else B - B.T
    return D[:, None] * (B @ B.T / N + np.eye(N) + skew) * D


def given(A, kind):
    """Return the same matrix in several forms, with decreasing information."""
    linear = Linear(A.shape, matvec=lambda v: A @ v, dtype=np.float64)
    return {
        "bare": lambda: linear,
        "with rmatvec": lambda: aslinearoperator(A),
        "function": lambda: wl.LinearOperator(
            lambda x: A @ x, (N,), symmetric=bool((A == A.T).all()), diagonal=np.diag(A)
        ),
        "said": lambda: wl.LinearOperator(linear, symmetric=bool((A == A.T).all())),
        "product": lambda: wl.LinearOperator(scipy.sparse.csr_array(A)),
        "own": lambda: UserOperator(A),
    }[kind]()


class UserOperator(wl.Operator):
    def __init__(self, A):
        self._A, self.shape, self.device, self.symmetric = (
            A,
            (len(A),),
            wp.get_device("cpu"),
            bool((A == A.T).all()),
        )

    def apply(self, x, out=None):
        out = wp.zeros_like(x) if out is None else out
        out.assign(self._A @ x.numpy())
        return out


METHODS = [
    name
    for name, cls in wl.METHODS.items()
    if families(cls) and not getattr(cls, "supports", ()) and getattr(cls, "most_unknowns", N) >= N
]


@pytest.mark.parametrize(
    ("name", "kind", "symmetric"),
    covering(
        METHODS,
        ["bare", "with rmatvec", "function", "said", "product", "own"],
        [True, False],
        count=2 * len(METHODS),
    ),
)
def test_methods_that_need_only_products_accept_a_linear_operator(name, kind, symmetric):
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    A, b = matrix(symmetric), np.random.default_rng(17).standard_normal(N)
    problem = wl.LCP(given(A, kind), b)
    assert takes(wl.METHODS[name], problem.A)
    slow = {"max_iterations": 500} if name == "gradient-descent" else {}
    try:
        result = wl.solve(problem, wl.METHODS[name](), stopping=replace(STOPPING, **slow))
    except ValueError as refusal:
        # Symmetry is needed and not known, or products with the transpose are not available.
        assert "symmetric" in str(refusal) or "transpose" in str(refusal)
        assert not problem.A.symmetric
        return
    assert result or name == "gradient-descent" or (name == "projected-jacobi" and not symmetric), (
        result.status
    )
    if result:
        np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-4)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("seed", [5, 6, 7, 9])
def test_boxes_by_the_default_method(seed, symmetric):
    rng = np.random.default_rng(seed)
    A, b, lower, upper = (
        matrix(symmetric, seed),
        rng.standard_normal(N),
        np.full(N, -np.inf),
        rng.uniform(0.0, 0.1, N),
    )
    lower[::2] = -upper[::2]
    result = wl.solve(wl.LCP(given(A, "bare"), b, lower, upper), stopping=STOPPING)
    assert result
    np.testing.assert_allclose(result.x.numpy(), boxed(A, b, lower, upper), atol=1e-6)


def test_symmetry_is_known_of_operators_that_are_their_own_adjoint():
    laplacian = LaplacianNd((4, 5), boundary_conditions="dirichlet")
    assert wl.LinearOperator(laplacian).symmetric
    assert not wl.LinearOperator(aslinearoperator(np.eye(3))).symmetric
    A = wl.LinearOperator(laplacian, (4, 5), symmetric=True)
    x = np.random.default_rng(3).standard_normal((4, 5))
    np.testing.assert_allclose(
        A.apply(wp.array(x, device="cpu")).numpy().ravel(),
        laplacian.toarray() @ x.ravel(),
        atol=1e-12,
    )


def test_sizes_stand_for_a_diagonal_that_is_not_given():
    """Estimated diagonal: positive, as large as the largest entries of the rows.

    It is in the units of A's entries.
    """
    n = 200
    D = scipy.sparse.diags_array(np.geomspace(1e-3, 1e3, n))
    A = D @ scipy.sparse.diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(n, n)) @ D
    for operator in (
        wl.LinearOperator(aslinearoperator(A), symmetric=True),
        UserOperator(A.toarray()),
    ):
        ratio = operator.diagonal().numpy() / A.diagonal()
        assert ratio.min() > 0.3
        assert ratio.max() < 10.0


def test_products_neither_see_nor_keep_the_iterate():
    kept = []

    def product(x):
        kept.append(x)
        image = 2 * x
        x[:] = np.nan  # the array belongs to the function
        return image

    A = wl.LinearOperator(product, (3,), symmetric=True)
    x = wp.array([1.0, 2.0, 3.0], dtype=wp.float64, device="cpu")
    np.testing.assert_array_equal(A.apply(x).numpy(), [2.0, 4.0, 6.0])
    np.testing.assert_array_equal(x.numpy(), [1.0, 2.0, 3.0])
    assert A.apply(wp.array([1.0, 2.0, 3.0], dtype=wp.float32, device="cpu")).dtype is wp.float32


def test_fields_of_a_grid_and_pickles():
    T = scipy.sparse.diags_array([4.0, -1.0, -1.0], offsets=[0, 1, -1], shape=(6, 6))
    A = wl.LinearOperator(aslinearoperator(T), (2, 3), symmetric=True)
    b = np.array([[1.0, -2.0, 1.0], [-3.0, 0.5, -1.0]])
    problem = pickle.loads(pickle.dumps(wl.LCP(A, b)))
    assert isinstance(problem.A, wl.LinearOperator)
    assert problem.A.symmetric
    x = wl.solve(problem, stopping=STOPPING).x.numpy()
    np.testing.assert_allclose(x.ravel(), lemke(T.toarray(), b.ravel()), atol=1e-7)


def shaped(image, **options):
    return Linear((3, 3), matvec=lambda v: image, dtype=np.float64, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: wl.LCP(aslinearoperator(np.ones((3, 4))), np.ones(3)),
            r"A has shape \(3, 4\): expected \(n, n\)",
        ),
        (
            lambda: wl.LCP(aslinearoperator(1j * np.eye(3)), np.ones(3)),
            "A has type complex128: expected real numbers",
        ),
        (
            lambda: wl.LCP(shaped(np.ones(4)), np.ones(3)),
            r"A fails to multiply an array of shape \(3,\): cannot reshape",
        ),
        (
            lambda: wl.LCP(shaped(np.full(3, np.nan)), np.ones(3)),
            "the product of A with normally distributed numbers is not finite",
        ),
        (
            lambda: wl.LCP(shaped(np.ones(3) + 1j), np.ones(3)),
            "A gives a product of type complex128",
        ),
        (lambda: wl.LinearOperator(lambda x: x), "shape: must be given if A is a function"),
        (
            lambda: wl.LinearOperator(lambda x: x[:2], (3,)),
            r"A gives a product of shape \(2,\): expected \(3,\)",
        ),
        (lambda: wl.LinearOperator(lambda x: x, (0,)), r"shape = \(0,\): expected integers >= 1"),
        (
            lambda: wl.LinearOperator(lambda x: x, "ab"),
            "shape = 'ab': expected a tuple of integers",
        ),
        (
            lambda: wl.LinearOperator(aslinearoperator(np.eye(6)), (2, 4)),
            r"shape = \(2, 4\): expected .* whose product is 6",
        ),
        (
            lambda: wl.LinearOperator(lambda x: np.triu(np.ones((3, 3))) @ x, (3,), symmetric=True),
            "symmetric: A is not",
        ),
        (
            lambda: wl.LinearOperator(lambda x: x, (3,), diagonal=np.ones(4)),
            r"diagonal has shape \(4,\): expected a number or \(3,\)",
        ),
        (
            lambda: wl.LinearOperator(lambda x: x, (3,), diagonal=np.nan),
            "diagonal holds a value that is not finite",
        ),
        (
            lambda: wl.LinearOperator(lambda x: x, (3,), transpose=3),
            "transpose is a int: expected a function",
        ),
        (lambda: wl.LinearOperator(3), "A is a int: expected a function"),
        (lambda: wl.LCP(lambda x: x, np.ones(3)), "A is a function: pass wl.LinearOperator"),
    ],
)
def test_invalid_operators_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_operators_without_a_product_cannot_be_made():
    class OperatorWithoutProduct(wl.Operator):
        shape = (3,)

    with pytest.raises(TypeError, match="apply"):
        OperatorWithoutProduct()


def test_non_finite_products_are_reported():
    calls = []

    def product(x):
        calls.append(0)
        return 2 * x if len(calls) < 25 else np.full_like(x, np.nan)

    result = wl.solve(
        wl.LCP(wl.LinearOperator(product, (3,), symmetric=True), -np.ones(3)),
        wl.AcceleratedProjectedGradient(),
    )
    assert not result
    assert result.status is wl.SolveStatus.NON_FINITE


def test_a_buffer_that_is_handed_out_twice():
    rng = np.random.default_rng(5)
    F, out = rng.standard_normal((20, 20)), np.empty(20)
    M = F @ F.T + 20 * np.eye(20)
    A = wl.LinearOperator(lambda x: np.matmul(M, x, out=out), shape=(20,), symmetric=True)
    result = wl.solve(wl.LCP(A, -np.ones(20)))
    x = result.x.numpy()
    assert result and np.linalg.norm(np.minimum(x, M @ x - 1)) < 1e-4


def test_a_symmetric_operator_is_its_own_transpose():
    A, x = matrix(True), np.arange(1.0, N + 1.0)
    linear = Linear((N, N), matvec=lambda v: A @ v, dtype=np.float64)
    operator = wl.LinearOperator(linear, symmetric=True)
    field = wp.array(x, dtype=wp.float64, device="cpu")
    np.testing.assert_allclose(operator.apply_transpose(field).numpy(), A @ x, rtol=1e-12)
