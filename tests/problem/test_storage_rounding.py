"""Tolerances below the rounding of float32 storage.

CONVERGED refers to the caller's coefficients; rounded ones give FLOOR.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from oracle import assemble

TIGHT, USUAL = (wl.StoppingCriteria(rtol=rtol, max_iterations=200) for rtol in (1e-10, 1e-7))
EXACT = ("dyadic", "ones")  # float32 represents them, and sums of a row of them
KINDS = ("any", "of float32", *EXACT)


def drawn(rng, kind, shape):
    """Return coefficients in [1/4, 1]."""
    values = rng.uniform(0.25, 1.0, shape)
    if kind == "of float32":  # float32 does not represent their sums
        return values.astype(np.float32).astype(np.float64)
    return {"any": values, "dyadic": np.ceil(values * 64) / 64, "ones": np.ones(shape)}[kind]


def grid(rng, kind, dtype):
    """Return a GridPoisson of random cells, and its matrix."""
    shape = tuple(int(n) for n in rng.integers(3, 8, rng.integers(2, 4)))
    cells = rng.choice(3, shape, p=[0.2, 0.7, 0.1])
    cells[(0,) * len(shape)] = wl.FLUID
    faces = [
        drawn(rng, kind, tuple(n + (k == len(shape) - 1 - a) for k, n in enumerate(shape)))
        for a in range(len(shape))
    ]
    shift = drawn(rng, kind, shape) if rng.random() < 0.5 else None
    names = dict(zip(("face_x", "face_y", "face_z"), faces, strict=False))
    A = wl.GridPoisson(cells, **names, shift=shift, device="cpu", dtype=dtype)
    return A, assemble(cells, (*faces, 1.0)[:3], shift), cells.ravel() == wl.FLUID


def stencil(rng, kind, dtype):
    """Return a dominant, unsymmetric stencil, and its matrix."""
    n, m = (int(k) for k in rng.integers(4, 9, 2))
    around = {o: -drawn(rng, kind, (n, m)) for o in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1))}
    center = (5.25 if kind in EXACT else 5.3) - sum(around.values()) * 0.5
    matrix = np.diag(center.ravel())
    for (j, i), values in around.items():
        rows = np.argwhere(np.ones((n, m)))
        for row in rows:
            there = row + np.array([j, i])
            if ((there >= 0) & (there < (n, m))).all():
                matrix[row[0] * m + row[1], there[0] * m + there[1]] = values[tuple(row)]
    A = wl.Stencil(
        np.full((n, m), wl.FLUID),
        {(0, 0): center, **around},
        outside=wl.AIR,
        device="cpu",
        dtype=dtype,
    )
    return A, matrix, np.ones(n * m, dtype=bool)


def matrix(rng, kind, dtype, dense):
    n = int(rng.integers(5, 40))
    A = -drawn(rng, kind, (n, n)) * (rng.random((n, n)) < 0.2)
    np.fill_diagonal(A, 2.0 ** np.ceil(np.log2(1 - A.sum(axis=1))))
    given = A if dense else scipy.sparse.csr_array(A)
    return (
        (wl.DenseOperator if dense else wl.SparseOperator)(given, device="cpu", dtype=dtype),
        A,
        np.ones(n, dtype=bool),
    )


FAMILIES = {
    "grid": grid,
    "stencil": stencil,
    "sparse": lambda rng, kind, dtype: matrix(rng, kind, dtype, False),
    "dense": lambda rng, kind, dtype: matrix(rng, kind, dtype, True),
}


def residual(matrix, b, x):
    d = matrix.diagonal()
    return np.linalg.norm(d * np.minimum(x, (matrix @ x + b) / d))


def check(family, kind, seed, dtype=wp.float32):
    """Solve to 1e-10 and to 1e-7; return the first status."""
    rng = np.random.default_rng([seed, 10])
    A, M, inside = FAMILIES[family](rng, kind, dtype)
    M, b = M[np.ix_(inside, inside)], rng.standard_normal(A.shape)
    problem = wl.LCP(A, b)
    tight, usual = wl.solve(problem, stopping=TIGHT), wl.solve(problem, stopping=USUAL)
    if usual.status is wl.SolveStatus.INFEASIBLE:  # a floating component
        return None
    assert usual, (seed, usual.status)
    b, x = b.ravel()[inside], tight.x.numpy().ravel()[inside]
    size = residual(M, b, np.zeros_like(b))
    if size == 0:
        return None
    assert tight.relative_residual <= 1e-10, (seed, tight.status)
    assert (tight.status is wl.SolveStatus.FLOOR) == (A.storage_rounding() > 1e-10), seed
    # There sums on the diagonal are rounded.
    if tight and not (kind == "of float32" and dtype is wp.float32):
        assert residual(M, b, x) <= 2e-10 * size, seed
    return tight.status


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("kind", KINDS)
def test_convergence_holds_for_the_unrounded_coefficients(family, kind):
    for seed in range(6):
        found = check(family, kind, seed)
        # Its center is a sum.
        rounded = kind == "any" or (kind == "of float32" and family == "stencil")
        assert found in (None, wl.SolveStatus.FLOOR if rounded else wl.SolveStatus.CONVERGED), (
            seed,
            found,
        )


@pytest.mark.parametrize("family", FAMILIES)
def test_float64_is_never_called_rounded(family):
    for seed in range(3):
        assert check(family, "any", seed, wp.float64) in (None, wl.SolveStatus.CONVERGED)


def test_the_rounding_is_the_largest_relative_one():
    faces = {"face_x": np.full((3, 5), 0.1), "face_y": np.full((4, 4), 0.25)}
    A = wl.GridPoisson(np.ones((3, 4), dtype=int), **faces, device="cpu")
    of_tenth = abs(float(np.float32(0.1)) - 0.1) / 0.1
    assert A.storage_rounding() == pytest.approx(of_tenth)
    assert (
        wl.GridPoisson(
            np.ones((3, 4), dtype=int), face_x=0.1, face_y=0.1, device="cpu"
        ).storage_rounding()
        == 0.0
    )
    entries = np.array([[1.0, -0.1], [0.0, 1.0]])
    sparse = wl.SparseOperator(scipy.sparse.csr_array(entries), device="cpu", dtype=wp.float32)
    for A in (wl.DenseOperator(entries, device="cpu", dtype=wp.float32), sparse):
        assert A.storage_rounding() == pytest.approx(of_tenth, rel=1e-6)
        assert wl.SumOperator(A, A).storage_rounding() == A.storage_rounding()
    A = wl.DenseOperator(entries, device="cpu", dtype=wp.float32)
    A.update(np.eye(2))
    assert A.storage_rounding() == 0.0


def test_float32_arrays_are_stored_unrounded():
    """Arrays of float32 are not rounded.

    A simulator's arrays on the device: the stored A meets tolerances below float32, and the status
    is CONVERGED.
    """
    cells = np.ones((6, 7), dtype=int)
    cells[0] = wl.AIR
    face = wp.array(np.full((3, 8, 9), 0.1), dtype=wp.float32, device="cpu")
    problem = wl.LCP(
        wl.GridPoisson(cells, face_x=face, device="cpu"),
        np.random.default_rng(4).standard_normal(cells.shape),
    )
    assert wl.solve(problem, stopping=TIGHT)


def test_other_numberings_know_the_rounding():
    T, I = (
        scipy.sparse.diags_array([-0.1, 0.21, -0.1], offsets=[-1, 0, 1], shape=(260, 260)),
        scipy.sparse.eye_array(260),
    )
    A, order = (
        (scipy.sparse.kron(T, I) + scipy.sparse.kron(I, T)).tocsr(),
        np.random.default_rng(6).permutation(260**2),
    )
    for dtype in (wp.float32, wp.float64):
        operator = wl.SparseOperator(A[order][:, order], device="cpu", dtype=dtype)
        found = operator.renumbered()
        assert found is not None
        assert found[1].storage_rounding() == operator.storage_rounding()
        assert (operator.storage_rounding() > 0) == (dtype is wp.float32)
