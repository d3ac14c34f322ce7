"""Sparse operators against SciPy.

Products, symmetry, coloring, sweeps in row order and by color, updates, bad input.
"""

import itertools
import pickle

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering
from matrices import poisson
from oracle import boxed, lemke

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=20_000, patience=2000)


def random_matrix(n, seed, density=0.1):
    """Return an unsymmetric matrix with empty rows and unordered, repeated entries."""
    rng = np.random.default_rng(seed)
    count = int(density * n * n)
    rows, columns = rng.integers(0, n, count), rng.integers(0, n, count)
    keep = rows % 7 != 3
    values = rng.standard_normal(count)
    return scipy.sparse.coo_array((values[keep], (rows[keep], columns[keep])), shape=(n, n))


@pytest.mark.every_case
@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("real", [wp.float32, wp.float64])
@pytest.mark.parametrize("n", [1, 2, 83])
def test_products_agree_with_scipy(n, dtype, real, device):
    matrix = random_matrix(n, 3)
    A = wl.SparseOperator(matrix, device=device, dtype=dtype)
    x = np.random.default_rng(5).standard_normal(n)
    field = wp.array(x, dtype=real, device=device)
    accuracy = 1e-13 if dtype is real is wp.float64 else 3e-6
    np.testing.assert_allclose(A.apply(field).numpy(), matrix @ x, atol=accuracy)
    np.testing.assert_allclose(A.apply_transpose(field).numpy(), matrix.T @ x, atol=accuracy)
    plus = wp.zeros_like(field)
    A.apply_plus(field, field, plus)
    np.testing.assert_allclose(plus.numpy(), matrix @ x + x, atol=accuracy)
    np.testing.assert_allclose(A.diagonal().numpy(), matrix.tocsr().diagonal(), atol=accuracy)
    assert isinstance(A, wl.Operator)


def test_symmetry_is_judged_by_size():
    base = poisson(6, 7)
    assert wl.SparseOperator(base, device="cpu").symmetric
    skew = base.tolil()
    skew[3, 4] += 1e-9
    assert not wl.SparseOperator(skew, device="cpu").symmetric
    skew[3, 4] = base[3, 4] * (1 + 2e-16)
    assert wl.SparseOperator(skew, device="cpu").symmetric
    scaled = scipy.sparse.block_diag(
        [1e12 * base, scipy.sparse.csr_array([[1.0, 0.5], [0.4, 1.0]])]
    )
    # A small block counts, whatever the size of the large one.
    assert not wl.SparseOperator(scaled, device="cpu").symmetric


def test_masked_is_the_principal_system(device):
    matrix = random_matrix(40, 7)
    rng = np.random.default_rng(11)
    free, shift = rng.random(40) < 0.6, rng.random(40)
    A = wl.SparseOperator(matrix, device=device).masked(free.astype(np.uint8), shift)
    P = np.diag(free.astype(float))
    np.testing.assert_allclose(
        A.matrix().toarray(), P @ matrix.toarray() @ P + P @ np.diag(shift), atol=1e-14
    )


@pytest.mark.parametrize(
    "matrix",
    [random_matrix(90, 13), poisson(9, 8), poisson(4, 5, 6), scipy.sparse.csr_array((5, 5))],
)
def test_no_two_rows_of_a_color_see_each_other(matrix, device):
    A = wl.SparseOperator(matrix, device=device)
    color = A.coloring()
    entries = matrix.tocoo()
    apart = entries.row != entries.col
    assert (color[entries.row] != color[entries.col])[apart].all()
    rows, starts = A.colors
    assert np.array_equal(np.sort(rows.numpy()), np.arange(matrix.shape[0]))
    for c, (start, end) in enumerate(itertools.pairwise(starts)):
        assert (color[rows.numpy()[start:end]] == c).all()


def test_stencils_are_red_and_black():
    color = wl.SparseOperator(poisson(4, 5, 6), device="cpu").coloring()
    assert np.array_equal(
        color, np.add.outer(np.add.outer(np.arange(4), np.arange(5)), np.arange(6)).ravel() % 2
    )


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize("colored", [True, False])
def test_a_sweep_is_the_textbooks(colored, forward, device):
    matrix = (
        random_matrix(60, 17) + scipy.sparse.diags_array(np.r_[0.0, np.full(59, 3.0)])
    ).tocsr()
    A = wl.SparseOperator(matrix, device=device)
    rng = np.random.default_rng(19)
    x, b, lower = rng.random(60), rng.standard_normal(60), -0.2 * rng.random(60)
    upper, dense = lower + 0.3, matrix.toarray()
    order = np.argsort(A.coloring(), kind="stable") if colored else np.arange(60)
    expected = x.copy()
    for i in order if forward else order[::-1]:
        if dense[i, i] != 0:
            expected[i] = np.clip(
                expected[i] - 1.3 * (dense[i] @ expected + b[i]) / dense[i, i], lower[i], upper[i]
            )
    fields = [wp.array(v, dtype=wp.float64, device=device) for v in (x, b, lower, upper)]
    A.relax(*fields, 1.3, forward=forward, colored=colored)
    np.testing.assert_allclose(fields[0].numpy(), expected, atol=1e-13)


def test_values_are_updated_in_place(device):
    matrix = random_matrix(30, 23).tocsr()
    matrix.sum_duplicates()
    A = wl.SparseOperator(matrix, device=device)
    x = wp.array(np.random.default_rng(29).standard_normal(30), dtype=wp.float64, device=device)
    A.apply_transpose(x)  # so that a stored transpose must be updated
    diagonal = A.diagonal()
    assert A.version == 1  # the entries have been updated once
    other = matrix.copy()
    other.data = np.random.default_rng(31).standard_normal(matrix.nnz)
    for values in (other.data, wp.array(other.data, dtype=wp.float64, device=device), other):
        A.update(np.ones(matrix.nnz))
        A.update(values)
        np.testing.assert_allclose(A.apply(x).numpy(), other @ x.numpy(), atol=1e-13)
        np.testing.assert_allclose(A.apply_transpose(x).numpy(), other.T @ x.numpy(), atol=1e-13)
        np.testing.assert_allclose(diagonal.numpy(), other.diagonal())
    assert A.version == 7
    with pytest.raises(ValueError, match="different sparsity pattern"):
        A.update(poisson(5, 6))
    with pytest.raises(ValueError, match=r"expected \("):
        A.update(np.ones(3))
    with pytest.raises(ValueError, match="not finite"):
        A.update(np.full(matrix.nnz, np.nan))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "expected a scipy.sparse matrix"),
        (scipy.sparse.csr_array((3, 4)), r"shape \(3, 4\)"),
        (scipy.sparse.csr_array((0, 0)), r"shape \(0, 0\)"),
        (scipy.sparse.eye_array(3) * 1j, "real numbers"),
        (scipy.sparse.eye_array(3) * np.nan, "not finite"),
    ],
)
def test_bad_matrices_are_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        wl.SparseOperator(matrix, device="cpu")
    with pytest.raises(ValueError, match="x has shape"):
        wl.SparseOperator(poisson(3), device="cpu").apply(
            wp.zeros(4, dtype=wp.float64, device="cpu")
        )


@pytest.mark.parametrize(
    "kind", [scipy.sparse.csr_array, scipy.sparse.coo_matrix, scipy.sparse.csc_array, np.asarray]
)
def test_problems_take_scipy_and_numpy_matrices(kind):
    rng = np.random.default_rng(37)
    dense = poisson(4, 5).toarray()
    b = rng.standard_normal(20)
    problem = wl.LCP(kind(dense), b)
    assert isinstance(problem.A, wl.DenseOperator if kind is np.asarray else wl.SparseOperator)
    result = wl.solve(problem, stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), lemke(dense, b), atol=1e-8)


def test_arguments_that_are_no_matrix_are_named():
    with pytest.raises(ValueError, match="A is a list"):
        wl.LCP([[1.0]], np.ones(1))


@pytest.mark.parametrize(
    ("solver", "symmetric"),
    covering(
        [
            wl.MinimumMapNewton(),
            wl.MinimumMapNewton(precision="double"),
            wl.ProjectedSOR(omega=1.0),
        ],
        [True, False],
    ),
)
def test_boxed_problems_against_enumeration(solver, symmetric, device):
    for seed in range(20):
        rng = np.random.default_rng(41 + seed)
        n = 6
        B = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.5)
        dense = B @ B.T + 0.5 * np.eye(n)
        if not symmetric:
            dense += 0.3 * (B - B.T)
        b, lower, upper = (
            rng.standard_normal(n),
            -rng.random(n),
            np.where(rng.random(n) < 0.5, np.inf, rng.random(n)),
        )
        A = wl.SparseOperator(scipy.sparse.csr_array(dense), device=device)
        result = wl.solve(wl.LCP(A, b, lower, upper), solver, stopping=TIGHT)
        assert result, (seed, result.status)
        np.testing.assert_allclose(result.x.numpy(), boxed(dense, b, lower, upper), atol=1e-8)


@pytest.mark.parametrize("convection", [0.0, 0.5])
@pytest.mark.parametrize("counts", [(33, 33), (11, 12, 13)])
def test_a_planted_obstacle_problem(counts, convection, device):
    n = int(np.prod(counts))
    drift = scipy.sparse.diags_array(
        [-convection, convection], offsets=[-1, 1], shape=(counts[-1],) * 2
    )
    matrix = poisson(*counts) + scipy.sparse.kron(scipy.sparse.eye_array(n // counts[-1]), drift)
    axes = np.meshgrid(*(np.linspace(-1, 1, m) for m in counts), indexing="ij")
    wave = (np.cos(3 * axes[0]) * np.sin(4 * axes[1] + 0.5)).ravel()
    x, y = np.maximum(wave, 0), 1e-2 * np.maximum(-wave, 0)
    A = wl.SparseOperator(matrix, device=device)
    result = wl.solve(
        wl.LCP(A, y - matrix @ x), wl.MinimumMapNewton(), stopping=wl.StoppingCriteria(rtol=1e-9)
    )
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), x, atol=1e-7)
    assert result.iterations <= 16


@pytest.mark.parametrize(
    "B",
    [
        np.ones((5, 1)),
        np.ones((4, 13)),
        np.zeros((4, 2)),
        np.full((4, 1), np.nan),
        np.ones((4, 1, 1)),
    ],
)
def test_a_near_null_space_must_be_fields(B):
    with pytest.raises(ValueError, match="near_null_space"):
        wl.SparseOperator(scipy.sparse.eye_array(4), device="cpu", near_null_space=B)


def test_blocks_are_found_and_a_pickle_keeps_the_near_null_space():
    blocks = scipy.sparse.kron(
        scipy.sparse.diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(8, 8)),
        np.eye(3) + 0.2,
    )
    A = wl.SparseOperator(blocks, device="cpu", near_null_space=np.ones(24))
    assert (A.block, A.near_null_space.shape) == (3, (24, 1))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(A)).near_null_space, A.near_null_space)
    assert wl.SparseOperator(blocks, device="cpu").block == 1


@pytest.mark.every_case
@pytest.mark.parametrize("form", ["csr", "csc", "coo", "bsr"])
@pytest.mark.parametrize("index", [2_000_000, -1, 50])
def test_indices_out_of_range_are_refused(form, index):
    """Refusal of indices out of range, which once crashed the process."""
    A = (
        scipy.sparse.random_array((50, 50), density=0.2, rng=np.random.default_rng(1))
        + 20 * scipy.sparse.eye_array(50)
    ).asformat(form)
    indices = A.col if form == "coo" else A.indices
    indices[5] = index
    with pytest.raises(ValueError, match="matrix is not a valid sparse matrix"):
        wl.SparseOperator(A, device="cpu")


def test_row_starts_that_fall_are_refused():
    A = scipy.sparse.csr_array(np.eye(4))
    A.indptr[2] = 4
    with pytest.raises(ValueError, match="matrix is not a valid sparse matrix"):
        wl.SparseOperator(A, device="cpu")


@pytest.mark.parametrize("full", [False, True])
def test_the_rows_of_a_matrix_are_the_matrix(full):
    A = np.random.default_rng(677).standard_normal((7, 7))
    if not full:
        A[np.abs(A) < 0.8] = 0.0
    operator = (
        wl.DenseOperator(A, device="cpu")
        if full
        else wl.SparseOperator(scipy.sparse.csr_array(A), device="cpu")
    )
    rows = operator.rows().matrix()
    np.testing.assert_array_equal(rows if full else rows.toarray(), A)
