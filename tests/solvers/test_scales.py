"""Units of A and x: a method takes the same path in any units."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import by_turns, chosen
from warp_lcp.problem.operator_protocol import families

N = 20
GRID = np.array([[0] * 5] + [[1] * 5] * 3)
SCALES = [(1e8, 1.0), (1.0, 1e8), (1e-8, 1e-8)]  # of A and of x: large and small
CASES = [
    (name, family)
    for name, cls in wl.METHODS.items()
    for family in ("dense", "sparse", "grid")
    if family in families(cls) and name != "direct-enumeration"
]
PRECISIONS = ("mixed", "single")


def problem(family, a, x, device):
    rng = np.random.default_rng(5)
    B, b = rng.standard_normal((N, N)), a * x * rng.standard_normal(N)
    if family == "grid":
        return wl.LCP(
            wl.GridPoisson(GRID, face_x=a, face_y=a, device=device),
            b.reshape(GRID.shape) * GRID,
            0.0,
            2 * x,
        )
    if family == "dense":
        return wl.LCP(wl.DenseOperator(a * (B @ B.T / N + np.eye(N)), device=device), b, 0.0, 2 * x)
    T = scipy.sparse.diags_array([-a, 2.05 * a, -a], offsets=[-1, 0, 1], shape=(N, N))
    return wl.LCP(wl.SparseOperator(T, device=device), b, 0.0, 2 * x)


@pytest.mark.parametrize(("name", "family"), by_turns(CASES))
def test_iterations_do_not_depend_on_units(name, family, device):
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    stopping = wl.StoppingCriteria(max_iterations=2000)
    plain = wl.solve(problem(family, 1.0, 1.0, device), wl.METHODS[name](), stopping=stopping)
    for a, x in SCALES:
        result = wl.solve(problem(family, a, x, device), wl.METHODS[name](), stopping=stopping)
        assert result, (a, x, result.status)
        assert abs(result.iterations - plain.iterations) <= max(2, 0.1 * plain.iterations), (a, x)
        np.testing.assert_allclose(result.x.numpy() / x, plain.x.numpy(), atol=1e-4)


@pytest.mark.default_cases(len(wl.METHODS))
@pytest.mark.parametrize(
    ("name", "family", "precision"),
    chosen(
        [(*case, precision) for case in CASES for precision in PRECISIONS],
        [(*case, PRECISIONS[number % 2]) for number, case in enumerate(CASES)],
    ),
)
def test_a_power_of_two_in_x_changes_no_step(name, family, precision, device):
    """Power of two in x: no changed step.

    Rounding is not affected: a difference shows a number without x's unit.
    """
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    cls, stopping = wl.METHODS[name], wl.StoppingCriteria(rtol=1e-4, max_iterations=50)
    method = cls(precision=precision) if hasattr(cls, "precision") else cls()
    plain = wl.solve(problem(family, 1.0, 1.0, device), method, stopping=stopping)
    for unit in (2.0**-20, 2.0**20):
        result = wl.solve(problem(family, 1.0, unit, device), method, stopping=stopping)
        assert (result.status, result.iterations, result.linear_iterations) == (
            plain.status,
            plain.iterations,
            plain.linear_iterations,
        )
        np.testing.assert_array_equal(result.x.numpy(), plain.x.numpy() * unit)


def test_enumeration_of_rows_in_different_units(device):
    """Enumeration of rows in different units.

    S A S with S from 1e-8 to 1e8: pivots differ by 1e32, and all count.
    """
    rng = np.random.default_rng(77)
    B, S = rng.standard_normal((4, 4)), np.array([1e-8, 1.0, 1e8, 1.0])
    A, b = B @ B.T / 4 + np.eye(4), np.array([-1.0, 0.4, -2.0, 0.1])
    plain = wl.solve(wl.LCP(wl.DenseOperator(A, device=device), b), wl.DirectEnumeration())
    scaled = wl.LCP(wl.DenseOperator(S[:, None] * A * S, device=device), S * b)
    assert np.count_nonzero(plain.x.numpy()) >= 2
    np.testing.assert_allclose(
        wl.solve(scaled, wl.DirectEnumeration()).x.numpy() * S, plain.x.numpy(), atol=1e-12
    )
    np.testing.assert_allclose(
        wl.DirectEnumeration().solutions(scaled) * S, [plain.x.numpy()], atol=1e-12
    )


@pytest.mark.parametrize("dtype", [wp.float64, wp.float32])
@pytest.mark.parametrize("n", [2, 3, 4])
def test_batches_of_rows_in_different_units(n, dtype, device):
    """Batches of rows in different units.

    D A D with D powers of 2 from 2^-13 to 2^13 is the same problem bit for bit: the unit of each
    row and column is removed.
    """
    rng = np.random.default_rng(79)
    m = 200
    B = rng.standard_normal((m, n, n))
    A, b = B @ B.transpose(0, 2, 1) / n + np.eye(n), rng.standard_normal((m, n))
    low, high = -rng.random((m, n)), rng.random((m, n))
    D = 2.0 ** rng.integers(-13, 14, (m, n))

    def solved(*fields):
        return wl.enumerate_batch(*(wp.array(f, dtype=dtype, device=device) for f in fields))

    plain, scaled = (
        solved(A, b, low, high),
        solved(D[:, :, None] * A * D[:, None, :], D * b, low / D, high / D),
    )
    assert (plain.sets.numpy() >= 0).all()
    assert len(np.unique(plain.sets.numpy())) > n
    np.testing.assert_allclose(
        scaled.x.numpy() * D, plain.x.numpy(), atol=1e-12 if dtype is wp.float64 else 1e-5
    )
    np.testing.assert_array_equal(scaled.sets.numpy(), plain.sets.numpy())


def test_fischer_newton_of_rows_in_different_units(device):
    """Fischer-Newton on rows in different units.

    S A S and S b: plain entries of J'J would differ by 1e24, and nu would dominate the small ones.
    """
    rng = np.random.default_rng(83)
    B, S = rng.standard_normal((N, N)), 2.0 ** rng.integers(-20, 21, N)
    A, b = B @ B.T / N + np.eye(N), rng.standard_normal(N)
    plain = wl.solve(wl.LCP(wl.DenseOperator(A, device=device), b, 0.0, 2.0), wl.FischerNewton())
    rows = wl.LCP(wl.DenseOperator(S[:, None] * A * S, device=device), S * b, 0.0, 2.0 / S)
    scaled = wl.solve(rows, wl.FischerNewton(), stopping=wl.StoppingCriteria(rtol=1e-13))
    assert plain, plain.status
    np.testing.assert_allclose(scaled.x.numpy() * S, plain.x.numpy(), atol=1e-4)
