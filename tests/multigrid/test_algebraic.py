"""Algebraic multigrid.

Galerkin products against SciPy's, symmetry of the cycle, iterations that do not grow with the grid.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from matrices import poisson
from warp_lcp.krylov import ConjugateGradient
from warp_lcp.multigrid.algebraic import AlgebraicHierarchy
from warp_lcp.multigrid.cycle_settings import AlgebraicSettings


def principal(matrix, free, shift):
    """Return P A P + P D P by SciPy."""
    P = scipy.sparse.diags_array(free.astype(float))
    return (P @ matrix @ P + P @ scipy.sparse.diags_array(shift)).tocsr()


def stored(M):
    """Return a device matrix as SciPy's."""
    parts = M.values.numpy().astype(np.float64), M.indices.numpy(), M.indptr.numpy()
    return scipy.sparse.csr_array(parts, shape=M.shape)


def hierarchy(matrix, free, shift, device, real=wp.float64, settings=None):
    H = AlgebraicHierarchy(wl.SparseOperator(matrix, device=device), real, settings)
    restrict(H, free, shift)
    return H


def restrict(H, free, shift):
    H.restrict(
        wp.array(free.astype(np.uint8), device=H.device),
        None if shift is None else wp.array(shift, dtype=wp.float64, device=H.device),
    )


def iterations(matrix, free, shift, device, real=wp.float64):
    """Return the conjugate-gradient iterations to 1e-6.

    The true residual is checked.
    """
    H = hierarchy(matrix, free, shift, device, real)
    krylov = ConjugateGradient(H.product, H)
    b = np.random.default_rng(3).standard_normal(len(free)) * free
    H.r.assign(b)
    count, _ = krylov.solve(1e-6 * float(np.linalg.norm(b)), 60)
    M = principal(matrix, free, np.zeros(len(free)) if shift is None else shift)
    accuracy = 1.1e-6 if real is wp.float64 else 2e-5
    assert np.linalg.norm(M @ krylov.x.numpy().astype(np.float64) - b) <= accuracy * np.linalg.norm(
        b
    )
    return count


@pytest.mark.parametrize("convection", [0.0, 0.4])
def test_coarse_matrices_are_galerkin_products(convection, device):
    n = 23 * 20
    drift = scipy.sparse.diags_array([-convection, convection], offsets=[-1, 1], shape=(20, 20))
    matrix = (poisson(23, 20) + scipy.sparse.kron(scipy.sparse.eye_array(23), drift)).tocsr()
    rng = np.random.default_rng(5)
    H = hierarchy(
        matrix,
        np.ones(n, dtype=bool),
        None,
        device,
        settings=AlgebraicSettings(coarsest_cpu=8, coarsest_cuda=8),
    )
    assert len(H.levels) >= 3
    d = matrix.diagonal()
    for free, shift in (
        (np.ones(n, dtype=bool), np.zeros(n)),
        (rng.random(n) < 0.6, 10 ** rng.uniform(-4, 8, n)),
        (rng.random(n) < 0.6, np.zeros(n)),
    ):
        restrict(H, free, shift)
        M = principal(matrix, free, shift)
        assert abs(stored(H.levels[0].A) - M).max() <= 1e-15 * shift.max(initial=1.0)
        scale = np.where(free, d / (d + shift), 0.0)
        for k, (fine, coarse) in enumerate(zip(H.levels, H.levels[1:], strict=False)):
            P = stored(fine.P)
            if k == 0:  # the unscaled entries, and the scale of each row
                plain = stored(fine.P)
                plain.data = fine.plain.numpy().copy()
                assert abs(P - scipy.sparse.diags_array(scale) @ plain).max() <= 1e-15
            assert abs(stored(fine.R) - P.T).max() == 0.0
            M = P.T @ M @ P
            assert abs(stored(coarse.A) - M).max() <= 1e-13 * abs(M).max()
        inverse = H._inverse.numpy()
        dense = M.toarray()
        rows = np.flatnonzero(np.abs(np.diag(dense)) > 0)
        np.testing.assert_allclose(
            (inverse @ dense)[np.ix_(rows, rows)], np.eye(len(rows)), atol=1e-8
        )


def test_entries_that_cancel_once_may_not_later(device):
    """Entries that cancel once but not later.

    A pattern taken from the numbers of one product would lack them.
    """
    matrix = poisson(12, 12).tolil()
    matrix[0, 1] = matrix[1, 0] = 0.0  # an explicit zero that an update fills
    pattern = poisson(12, 12)
    zeroed = pattern.copy()
    zeroed.data = np.where((pattern.tocoo().row + pattern.tocoo().col) == 1, 0.0, pattern.data)
    A = wl.SparseOperator(zeroed, device=device)
    H = AlgebraicHierarchy(A, wp.float64, AlgebraicSettings(coarsest_cpu=8, coarsest_cuda=8))
    A.update(pattern)
    restrict(H, np.ones(144, dtype=bool), None)
    M = pattern
    for fine, coarse in zip(H.levels, H.levels[1:], strict=False):
        M = stored(fine.P).T @ M @ stored(fine.P)
        assert abs(stored(coarse.A) - M).max() <= 1e-13


@pytest.mark.parametrize("gamma", [1, 2])
def test_a_cycle_is_symmetric_and_positive(gamma, device):
    rng = np.random.default_rng(7)
    free = rng.random(15 * 14) < 0.8
    settings = AlgebraicSettings(gamma=gamma, coarsest_cpu=4, coarsest_cuda=4)
    H = hierarchy(
        poisson(15, 14), free, 10 ** rng.uniform(-4, 6, len(free)), device, settings=settings
    )
    cycle = []
    for e in np.eye(len(free)) * free:
        H.r.assign(e)
        H.apply()
        cycle.append(H.z.numpy().copy())
    B = np.array(cycle)
    np.testing.assert_allclose(B, B.T, atol=1e-13)
    assert not B[:, ~free].any()
    assert np.linalg.eigvalsh(B[np.ix_(free, free)]).min() > 0


@pytest.mark.parametrize(("dimension", "sizes"), [(2, (33, 65, 129, 257)), (3, (9, 17, 33))])
def test_iterations_do_not_grow_with_the_grid(dimension, sizes, device):
    counts = {
        kind: []
        for kind in ("all", "random mask", "half held", "wide shift", "few stiff", "single")
    }
    for size in sizes:
        matrix, rng = poisson(*[size] * dimension), np.random.default_rng(11)
        n = matrix.shape[0]
        all_rows = np.ones(n, dtype=bool)
        axes = np.meshgrid(*[np.linspace(-1, 1, size)] * dimension, indexing="ij")
        blob = (np.cos(5 * axes[0]) * np.sin(7 * axes[1] + 0.5)).ravel() < 0.2
        counts["all"].append(iterations(matrix, all_rows, None, device))
        counts["random mask"].append(iterations(matrix, rng.random(n) < 0.8, None, device))
        counts["half held"].append(iterations(matrix, blob, None, device))
        counts["wide shift"].append(
            iterations(matrix, all_rows, 10 ** rng.uniform(-6, 8, n), device)
        )
        counts["few stiff"].append(
            iterations(matrix, all_rows, np.where(rng.random(n) < 0.02, 1e8, 0.0), device)
        )
        counts["single"].append(iterations(matrix, blob, None, device, wp.float32))
    for kind, found in counts.items():
        assert found[-1] <= found[0] + 3, (kind, found)
        assert max(found) <= 11, (kind, found)


def test_singular_components_do_not_break_a_cycle(device):
    """Cycle with singular components.

    In a closed domain constants are in the null space, and a compatible right-hand side is solved
    up to them.
    """
    T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(30, 30)).tolil()
    T[0, 0] = T[-1, -1] = 1.0
    matrix = (
        scipy.sparse.kron(T, scipy.sparse.eye_array(30))
        + scipy.sparse.kron(scipy.sparse.eye_array(30), T)
    ).tocsr()
    H = hierarchy(matrix, np.ones(900, dtype=bool), None, device)
    krylov = ConjugateGradient(H.product, H)
    b = np.random.default_rng(13).standard_normal(900)
    b -= b.mean()
    H.r.assign(b)
    count, _ = krylov.solve(1e-8 * float(np.linalg.norm(b)), 40)
    assert count <= 15
    assert np.linalg.norm(matrix @ krylov.x.numpy() - b) <= 1e-7 * np.linalg.norm(b)


@pytest.mark.parametrize(
    "matrix",
    [
        scipy.sparse.diags_array(np.arange(1.0, 301.0)).tocsr(),  # nothing aggregates
        scipy.sparse.csr_array(np.eye(100) + 1 / 100),  # rows as wide as the matrix
        # Empty rows.
        scipy.sparse.block_diag([poisson(9, 9), scipy.sparse.csr_array((40, 40))]).tocsr(),
        poisson(1),
    ],
)
def test_matrices_that_hardly_coarsen(matrix, device):
    n = matrix.shape[0]
    rows = np.asarray(matrix.sum(axis=1)).ravel() != 0
    H = hierarchy(matrix, np.ones(n, dtype=bool), None, device)
    b = np.random.default_rng(17).standard_normal(n) * rows
    H.r.assign(b)
    krylov = ConjugateGradient(H.product, H)
    count, _ = krylov.solve(1e-9 * float(np.linalg.norm(b)), 60)
    assert count < 60
    assert np.linalg.norm(matrix @ krylov.x.numpy() - b) <= 2e-9 * np.linalg.norm(b)


@pytest.mark.parametrize("pairs", [1, 2, 3])
def test_a_coarsest_level_too_large_to_invert_is_swept_forth_and_back(pairs, device):
    """Coarsest level too large to invert: forward and backward sweeps.

    Each pair of sweeps continues from the one before; only the first starts from zero.
    """
    # So strong that nothing aggregates.
    settings = AlgebraicSettings(strength=0.9, coarsest_cpu=0, coarsest_cuda=0, last_sweeps=pairs)
    H = hierarchy(poisson(5, 6), np.ones(30, dtype=bool), None, device, settings=settings)
    (level,) = H.levels
    M, inverse, b = (
        stored(level.A),
        level.inverse.numpy(),
        np.random.default_rng(19).standard_normal(30),
    )
    first, second = settings.weights
    expected = np.zeros(30)
    for pair in range(pairs):
        for omega in (first, second) if pair % 2 == 0 else (second, first):
            expected += omega * inverse * (b - M @ expected)
    H.r.assign(b)
    H.apply()
    np.testing.assert_allclose(H.z.numpy(), expected, rtol=1e-12)


def test_two_hierarchies_of_one_matrix_are_the_same(device):
    matrix = poisson(20, 21)
    first, second = (hierarchy(matrix, np.ones(420, dtype=bool), None, device) for _ in range(2))
    for one, other in zip(first.levels, second.levels, strict=True):
        assert np.array_equal(one.A.values.numpy(), other.A.values.numpy())
    assert (
        1.0
        < sum(level.A.values.size for level in first.levels) / first.levels[0].A.values.size
        < 1.6
    )
