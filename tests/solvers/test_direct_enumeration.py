"""Direct enumeration against exhaustive search and by hand; batches."""

import itertools
from functools import partial

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_lcp as wl
from default_run import covering
from matrices import solve_matrix
from oracle import boxed, natural_residual
from warp_lcp.solvers.direct_enumeration import BatchResult, DirectEnumeration, enumerate_batch
from warp_lcp.subproblems.enumeration_kernels import enumeration_kernels

TIGHT = wl.StoppingCriteria(rtol=1e-12)


solve = partial(solve_matrix, solver=DirectEnumeration(), stopping=TIGHT)


def random_bounds(rng, n):
    """Return all kinds of rows: equations, one-sided, boxes, fixed values."""
    kind = rng.integers(0, 5, n)
    lower = np.where(np.isin(kind, (1, 3)), -rng.random(n), np.where(kind == 4, 0.3, -np.inf))
    upper = np.where(np.isin(kind, (2, 3)), rng.random(n), np.where(kind == 4, 0.3, np.inf))
    return lower, upper


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 4))
def test_any_matrix_any_bounds(seed, n):
    """Any matrix with any bounds.

    Unsymmetric and indefinite: exhaustive search in NumPy decides whether a solution exists.
    """
    rng = np.random.default_rng(seed)
    A, b = rng.standard_normal((n, n)), rng.standard_normal(n)
    lower, upper = random_bounds(rng, n)
    expected = boxed(A, b, lower, upper)
    result = solve(A, b, lower, upper)
    if expected is None:
        assert result.status is wl.SolveStatus.INFEASIBLE
    else:
        assert result, result.status
        assert natural_residual(A, b, lower, upper, result.x.numpy()) <= 1e-10 * max(
            1.0, np.abs(result.x.numpy()).max()
        )


@pytest.mark.parametrize(
    ("A", "b", "expected"),
    [
        ([[2.0, 1.0], [1.0, 2.0]], [-3.0, -3.0], [[1.0, 1.0]]),  # a P-matrix: one
        ([[1.0, 2.0], [2.0, 1.0]], [-1.0, -1.0], [[1.0, 0.0], [0.0, 1.0], [1 / 3, 1 / 3]]),
        ([[-1.0, 0.0], [0.0, 1.0]], [-1.0, 1.0], []),  # y_0 = -x_0 - 1 < 0 for all x_0 >= 0
        ([[-1.0, 0.0], [0.0, 1.0]], [1.0, 1.0], [[0.0, 0.0], [1.0, 0.0]]),
    ],
)
def test_all_solutions(A, b, expected):
    found = DirectEnumeration().solutions(
        wl.LCP(wl.DenseOperator(np.array(A), device="cpu"), np.array(b))
    )
    assert found.shape == (len(expected), 2)
    for x in expected:
        assert np.abs(found - x).max(axis=1).min() < 1e-12


def test_singular_free_blocks():
    """Singular free blocks.

    Two equations with one unknown too many have a basic solution; incompatible ones have none.
    """
    A = np.array([[1.0, 1.0], [1.0, 1.0]])
    result = solve(A, np.array([-2.0, -2.0]), lower=-np.inf)
    assert result
    assert result.x.numpy().sum() == pytest.approx(2.0)
    assert solve(A, np.array([-2.0, -1.0]), lower=-np.inf).status is wl.SolveStatus.INFEASIBLE


def test_too_many_unknowns_are_refused():
    with pytest.raises(
        ValueError, match="5 unknowns: DirectEnumeration is a dense method for at most 4"
    ):
        DirectEnumeration().init(wl.LCP(wl.DenseOperator(np.eye(5), device="cpu"), np.ones(5)))


@pytest.mark.parametrize(("n", "dtype"), covering([1, 2, 3, 4], [wp.float64, wp.float32]))
def test_batch(n, dtype, device):
    rng = np.random.default_rng(300 + n)
    m, exact = 400, dtype is wp.float64
    A, b = rng.standard_normal((m, n, n)) + np.eye(n), rng.standard_normal((m, n))
    bounds = [random_bounds(rng, n) for _ in range(m)]
    lower, upper = (np.array([pair[k] for pair in bounds]) for k in (0, 1))
    given = [wp.array(v, dtype=dtype, device=device) for v in (A, b, lower, upper)]
    result = enumerate_batch(*given)
    x, sets = result.x.numpy().astype(float), result.sets.numpy()
    A, b, lower, upper = (v.numpy().astype(float) for v in given)
    wrong = 0
    for k in range(m):
        expected = boxed(A[k], b[k], lower[k], upper[k])
        wrong += (expected is None) != (sets[k] < 0)
        if sets[k] >= 0:
            scale = np.abs(A[k]).sum() * np.abs(x[k]).max() + np.abs(b[k]).sum()
            assert (
                natural_residual(A[k], b[k], lower[k], upper[k], x[k])
                <= (1e-10 if exact else 1e-4) * scale
            )
            for i in range(n):  # the set determines x
                assert [x[k, i] == lower[k, i], True, x[k, i] == upper[k, i]][sets[k] // 3**i % 3]
    # float32 cannot distinguish the nearly parallel ones.
    assert wrong == 0 if exact else wrong <= m // 100


def test_batch_bounds_of_one_row_and_numbers_and_reused_memory():
    rng = np.random.default_rng(311)
    A, b = np.eye(3) * 2 + 0.1 * rng.standard_normal((50, 3, 3)), rng.standard_normal((50, 3))
    low = np.array([-0.2, 0.0, -np.inf])
    one = enumerate_batch(A, b, low, 0.3, device="cpu")
    each = enumerate_batch(A, b, np.tile(low, (50, 1)), np.full((50, 3), 0.3), device="cpu")
    np.testing.assert_array_equal(one.x.numpy(), each.x.numpy())
    again = enumerate_batch(A, -b, low, 0.3, device="cpu", out=one)
    assert again is one
    expected = [boxed(A[k], -b[k], low, np.full(3, 0.3)) for k in range(50)]
    np.testing.assert_allclose(one.x.numpy(), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.ones((2, 5, 5)), np.ones((2, 5))), "A has shape"),
        ((np.ones((2, 3, 2)), np.ones((2, 3))), "A has shape"),
        ((np.ones((2, 3, 3)), np.ones((3, 3))), "b has shape"),
        ((np.ones((2, 3, 3)), np.full((2, 3), np.nan)), "b holds a value that is not finite"),
        ((np.ones((2, 3, 3)), np.ones((2, 3)), np.zeros(2)), "lower has shape"),
        ((np.ones((2, 3, 3)), np.ones((2, 3)), 1.0, 0.0), "need lower <= upper"),
    ],
)
def test_bad_batches_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        enumerate_batch(*arguments, device="cpu")


def test_out_of_another_shape_is_refused():
    out = BatchResult(
        wp.empty((2, 2), dtype=wp.float64, device="cpu"), wp.empty(2, dtype=wp.int32, device="cpu")
    )
    with pytest.raises(ValueError, match="out holds x of shape"):
        enumerate_batch(np.ones((2, 3, 3)), np.ones((2, 3)), device="cpu", out=out)


def test_kernels_compile_for_cuda(tmp_path):
    for n in (1, 4):
        name = enumeration_kernels(n, wp.float64).batch.module.name
        wp.compile_aot_module(
            name, device=None, arch=[90], module_dir=tmp_path / str(n), use_ptx=True
        )
        assert list((tmp_path / str(n)).rglob("*.ptx"))


def python_enumeration(A, b):
    """Return the solution by a plain search in NumPy, the first one found."""
    n = len(b)
    for free in itertools.product((False, True), repeat=n):
        rows = np.flatnonzero(free)
        x = np.zeros(n)
        if len(rows):
            x[rows] = np.linalg.solve(A[np.ix_(rows, rows)], -b[rows])
        if (x >= -1e-12).all() and (A @ x + b >= -1e-12).all():
            return x
    return None


@pytest.mark.slow
def test_a_large_batch_finds_what_a_python_loop_finds():
    rng = np.random.default_rng(317)
    m, sample = 100_000, 2000
    B = rng.standard_normal((m, 3, 3))
    A, b = B @ B.transpose(0, 2, 1) + 0.1 * np.eye(3), rng.standard_normal((m, 3))
    given = [wp.array(v, dtype=wp.float64, device="cpu") for v in (A, b)]
    result = enumerate_batch(*given)
    enumerate_batch(*given, out=result)
    expected = [python_enumeration(A[k], b[k]) for k in range(sample)]
    np.testing.assert_allclose(result.x.numpy()[:sample], expected, rtol=1e-6, atol=1e-8)
