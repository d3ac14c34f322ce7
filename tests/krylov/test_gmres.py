"""GMRES against SciPy.

The same iterations, true residuals, restarts, weights, and every reason to stop.
"""

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import warp as wp

import warp_lcp as wl
from warp_lcp.krylov import GMRES
from warp_lcp.krylov.flexible_gmres import FlexibleGMRES


class ScalingPreconditioner:
    """Preconditioner z = s r, on the host."""

    def __init__(self, s, real, device):
        self.r, self.z = (wp.zeros(len(s), dtype=real, device=device) for _ in range(2))
        self.s = s

    def apply(self):
        self.z.assign(self.s * self.r.numpy())


def convection_diffusion(m, peclet):
    """Return central differences with a wind along both axes."""
    T = scipy.sparse.diags_array(
        [-1.0 - peclet, 2.0, -1.0 + peclet], offsets=[-1, 0, 1], shape=(m, m)
    )
    I = scipy.sparse.eye_array(m)
    return (scipy.sparse.kron(T, I) + scipy.sparse.kron(I, T)).tocsr()


def make(matrix, device, real=wp.float64, scale=None, **options):
    n = matrix.shape[0]
    A = wl.SparseOperator(matrix, device=device)
    M = ScalingPreconditioner(np.ones(n) if scale is None else scale, real, device)
    return GMRES(A.product, M, **options), M


@pytest.mark.parametrize("restart", [8, 30, 200])
@pytest.mark.parametrize("scaled", [False, True])
def test_iterations_are_scipys(restart, scaled, device):
    matrix = convection_diffusion(12, 0.6)
    rng = np.random.default_rng(3)
    scale = 1 / rng.uniform(1, 3, 144) if scaled else np.ones(144)
    b = rng.standard_normal(144)
    krylov, M = make(matrix, device, scale=scale, restart=restart)
    M.r.assign(b)
    count, norm = krylov.solve(1e-8 * float(np.linalg.norm(b)), 1000)
    # From the right: A M u = b, x = M u.
    seen = []
    right = scipy.sparse.linalg.LinearOperator((144, 144), matvec=lambda u: matrix @ (scale * u))
    u, info = scipy.sparse.linalg.gmres(
        right,
        b,
        rtol=1e-8,
        restart=restart,
        maxiter=1000,
        callback=seen.append,
        callback_type="pr_norm",
    )
    assert info == 0
    assert abs(count - len(seen)) <= 1
    x = krylov.x.numpy()
    assert norm == pytest.approx(np.linalg.norm(matrix @ x - b), rel=1e-3)
    assert norm <= 1e-8 * np.linalg.norm(b)
    np.testing.assert_allclose(x, scale * u, atol=1e-6)


def test_a_weight_measures_the_residual(device):
    """Weight of the residual norm.

    Without it the stiff rows decide: 1e8 of them would use up the tolerance.
    """
    rng = np.random.default_rng(5)
    stiff = 10 ** rng.uniform(0, 8, 100)
    matrix = (convection_diffusion(10, 0.3) + scipy.sparse.diags_array(stiff)).tocsr()
    d, b = matrix.diagonal(), rng.standard_normal(100) * np.sqrt(stiff)
    krylov, M = make(
        matrix, device, scale=1 / d, weight=wp.array(1 / d, dtype=wp.float64, device=device)
    )
    M.r.assign(b)
    size = np.linalg.norm(b / np.sqrt(d))
    count, norm = krylov.solve(1e-10 * float(size), 200)
    assert count < 40
    residual = (matrix @ krylov.x.numpy() - b) / np.sqrt(d)
    assert norm == pytest.approx(np.linalg.norm(residual), rel=1e-2)
    assert norm <= 1e-10 * size


def test_single_precision_reports_the_true_residual(device):
    matrix = convection_diffusion(12, 0.6)
    b = np.random.default_rng(7).standard_normal(144)
    krylov, M = make(matrix, device, real=wp.float32)
    M.r.assign(b)
    count, norm = krylov.solve(1e-12, 400)  # unreachable: restarts must end
    assert count < 400
    assert norm == pytest.approx(
        np.linalg.norm(matrix @ krylov.x.numpy().astype(np.float64) - b), rel=0.5
    )
    assert norm <= 1e-5


def test_limits_and_endings(device):
    matrix = convection_diffusion(12, 0.6)
    b = np.random.default_rng(11).standard_normal(144)
    krylov, M = make(matrix, device, restart=10)
    M.r.assign(b)
    assert krylov.solve(1e-8, 0)[0] == 0
    assert not krylov.x.numpy().any()
    for most in (1, 7, 23):
        M.r.assign(b)
        count, norm = krylov.solve(1e-30, most)
        assert count == most
        assert norm == pytest.approx(np.linalg.norm(matrix @ krylov.x.numpy() - b), rel=1e-10)
    M.r.assign(np.zeros(144))
    assert krylov.solve(0.0, 50) == (0, 0.0)
    M.r.assign(np.full(144, np.nan))
    count, norm = krylov.solve(1e-8, 50)
    assert count == 0
    assert not np.isfinite(norm)


def test_a_lucky_breakdown_and_a_singular_matrix(device):
    krylov, M = make(scipy.sparse.eye_array(5).tocsr() * 2.0, device)
    M.r.assign(np.arange(5.0))
    count, norm = krylov.solve(1e-12, 50)
    assert count == 1
    assert norm <= 1e-12
    np.testing.assert_allclose(krylov.x.numpy(), np.arange(5.0) / 2)
    krylov, M = make(scipy.sparse.diags_array([1.0, 0.0, 2.0]).tocsr(), device)
    M.r.assign(np.ones(3))  # incompatible: the least residual is 1
    count, norm = krylov.solve(1e-12, 50)
    assert norm == pytest.approx(1.0, rel=1e-2)
    assert np.isfinite(krylov.x.numpy()).all()


def extended(device, ahead, tolerances):
    """Return vectors, estimates and changes of the solution after each tolerance."""
    matrix, n = convection_diffusion(12, 0.3), 144
    A = wl.SparseOperator(matrix, device=device)
    M = ScalingPreconditioner(np.linspace(0.2, 0.5, n), wp.float64, device)
    weight = wp.full(n, 1.0, dtype=wp.float64, device=device)
    krylov = FlexibleGMRES(A.product, M, restart=40, weight=weight, at_once=True)
    krylov.ahead = ahead
    M.r.assign(np.random.default_rng(4).standard_normal(n))
    M.apply()
    norm, results = krylov.begin(), []
    for tolerance in tolerances:
        results.append((*krylov.extend(tolerance * norm), krylov.x.numpy()))
    return results


def test_vectors_added_before_a_reading_do_not_change_the_result(device):
    tolerances = (0.3, 0.2999, 0.02, 1e-4)
    one, several = (extended(device, ahead, tolerances) for ahead in (False, True))
    for (count, left, x), (other_count, other_left, other) in zip(one, several, strict=True):
        assert (count, left) == (other_count, other_left)
        np.testing.assert_array_equal(x, other)
    assert sum(count for count, _, _ in one) > 10
