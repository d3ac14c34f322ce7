"""Scale d of the natural residual; no wrong answer passes if the diagonal is tiny."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp
from scipy.optimize import linprog

import warp_lcp as wl
from matrices import operator_of
from oracle import lemke, natural_scale
from warp_lcp.problem.operator_protocol import families
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.residual_scaling import scale_by_products, scale_of_matrix

# The solution is x = (1, 1); (1, 1e-8) and (71, 0.95) once passed.
TINY = (np.array([[1e-8, -1.0], [1.0, 1e-8]]), np.array([1.0, -1.0]))
SOLVE_IT = ["interior-point", "lemke", "minimum-map-newton", "primal-dual-active-set"]


class OperatorWithoutEntries:
    """User-defined operator: products and the diagonal, no entries."""

    def __init__(self, A):
        self._A, self.shape, self.dtype, self.device = (
            A,
            (len(A),),
            wp.float64,
            wp.get_device("cpu"),
        )
        self.symmetric = bool((A == A.T).all())

    def apply(self, x, out=None, A=None):
        out = wp.zeros_like(x) if out is None else out
        out.assign((self._A if A is None else A) @ x.numpy())
        return out

    def apply_transpose(self, x, out=None):
        return self.apply(x, out, self._A.T)

    def diagonal(self):
        return wp.array(np.diag(self._A).copy(), dtype=wp.float64, device="cpu")

    def masked(self, free, shift=None):
        p, d = np.diag(free.numpy() != 0), 0.0 if shift is None else np.diag(shift.numpy())
        return OperatorWithoutEntries(p @ (self._A + d) @ p)


def program(seed, m=20, n=20):
    """Return a linear program with its dual, as an LCP with eps I, and c, G, h.

    The program is min c'x, G x >= h, x >= 0, of 40 unknowns.
    """
    rng = np.random.default_rng([7919, seed])
    G, x, u = (
        rng.uniform(-1, 1, (m, n)),
        rng.random(n) * (rng.random(n) < 0.5),
        rng.random(m) * (rng.random(m) < 0.5),
    )
    h, c = (
        G @ x - np.where(u > 0, 0.0, rng.random(m)),
        G.T @ u + np.where(x > 0, 0.0, rng.random(n)),
    )
    M = np.block([[np.zeros((n, n)), -G.T], [G, np.zeros((m, m))]]) + 10.0 ** rng.uniform(
        -12, -7
    ) * np.eye(n + m)
    return M, np.r_[c, -h], c, G, h


def semidefinite(rng, n, rank):
    B, D = rng.standard_normal((n, rank)), 10.0 ** rng.uniform(-6, 6, n)
    A = D[:, None] * (B @ B.T) * D
    return (A + A.T) / 2


def unscaled(M, b, x):
    """Return ||min(x, y)|| over that at x = 0, of matrices with entries near 1."""
    return np.linalg.norm(np.minimum(x, M @ x + b)) / np.linalg.norm(np.minimum(0.0, b))


@pytest.mark.parametrize("kind", ["dense", "sparse"])
@pytest.mark.parametrize(
    "method", [n for n, cls in wl.METHODS.items() if families(cls) and n != "blocked-gauss-seidel"]
)
def test_a_tiny_diagonal_does_not_hide_other_rows(method, kind):
    M, b = TINY
    try:
        problem = wl.LCP(operator_of(M, kind), b)
        result = wl.solve(problem, wl.default_chain(wl.METHODS[method](), problem))
    except ValueError:
        assert method not in SOLVE_IT
        return
    assert result or method not in SOLVE_IT
    if result:
        np.testing.assert_allclose(result.x.numpy(), 1.0, atol=1e-5)


@pytest.mark.parametrize("kind", ["dense", "sparse"])
@pytest.mark.parametrize("method", ["fischer-newton", *SOLVE_IT])
def test_linear_programs_have_their_optimum_or_are_not_solved(method, kind):
    for seed in range(4):
        M, b, c, G, h = program(seed)
        problem = wl.LCP(operator_of(M, kind), b)
        result = wl.solve(problem, wl.default_chain(wl.METHODS[method](), problem))
        assert result or (method, kind) in {
            ("fischer-newton", "dense"),
            ("fischer-newton", "sparse"),
            ("primal-dual-active-set", kind),
        }
        if result:
            best = linprog(c, A_ub=-G, b_ub=-h).fun
            assert c @ result.x.numpy()[:20] == pytest.approx(best, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("method", ["interior-point", "lemke", "minimum-map-newton"])
def test_units_of_rows_and_columns_are_the_users(method):
    """Solutions in the user's units of rows and columns.

    The matrix is diag(R) M diag(C) with sixteen orders of magnitude among columns and eight among
    rows. It is judged in units of M.
    """
    for seed in range(4):
        M, b, *_ = program(seed)
        rng = np.random.default_rng(seed)
        R, C = (
            10.0 ** rng.uniform(-4, 4, 40) if seed % 2 else np.ones(40),
            10.0 ** rng.uniform(-8, 8, 40),
        )
        problem = wl.LCP(operator_of(R[:, None] * M * C, "dense"), R * b)
        result = wl.solve(problem, wl.default_chain(wl.METHODS[method](), problem))
        assert result, (seed, result.status)
        assert unscaled(M, b, C * result.x.numpy()) < 1e-4


def test_the_scale_by_assignment():
    """Scale by assignment, against the oracle's, which has no potentials.

    The largest entry of each row and column becomes 1.
    """
    rng, leads = np.random.default_rng(613), 0
    for k in range(200):
        n = int(rng.integers(1, 9))
        A = rng.standard_normal((n, n)) * (rng.random((n, n)) < rng.uniform(0.2, 1.0))
        A = (A, A @ A.T, 0.3 * A + np.diag(10.0 ** rng.uniform(-3, 2, n)))[k % 3]
        if k % 5 == 0:
            A[n // 2] = A[:, n // 2] = 0.0
        A = 10.0 ** rng.uniform(-4, 4, n)[:, None] * A * 10.0 ** rng.uniform(-4, 4, n)
        d, own = scale_of_matrix(A), np.abs(np.diag(A))
        np.testing.assert_allclose(d, natural_scale(A), rtol=1e-12)
        np.testing.assert_allclose(scale_of_matrix(scipy.sparse.csr_array(A)), d, rtol=1e-14)
        leads += int((d == np.where(own > 0, own, 1.0)).all())
        assert (d >= (1 - 1e-12) * own).all()
        C = 10.0 ** rng.uniform(-8, 8, n)
        full = (A != 0).any(axis=0)
        np.testing.assert_allclose(scale_of_matrix(A * C)[full], (C * d)[full], rtol=1e-12)
    assert 50 < leads < 180


@pytest.mark.parametrize("rank", [3, 40])
def test_semidefinite_matrices_keep_their_diagonal(rank):
    """Diagonal of semi-definite matrices: unchanged bit for bit.

    Also stored in float32, and where rows and columns are in other units.
    """
    rng = np.random.default_rng(617)
    for n in (4, 40):
        A = semidefinite(rng, n, rank)
        R, C = 10.0 ** rng.uniform(-8, 8, (2, n))
        for matrix in (A, R[:, None] * A * C):
            np.testing.assert_array_equal(scale_of_matrix(matrix), np.diag(matrix))
        single = A.astype(np.float32).astype(np.float64)
        np.testing.assert_array_equal(scale_of_matrix(single), np.diag(single))
        for kind in ("dense", "sparse"):
            problem = wl.LCP(operator_of(A, kind), np.ones(n))
            np.testing.assert_array_equal(NaturalResidual(problem).diagonal.numpy(), np.diag(A))


def test_grids_keep_their_stencil():
    A = wl.GridPoisson(np.array([[1, 1, 2], [1, 1, 0]]), device="cpu")
    problem = wl.LCP(A, np.ones((2, 3)))
    assert NaturalResidual(problem).diagonal.ptr == A.stencil.d.ptr
    low = wl.LowRankOperator(np.ones((2, 3, 1)), np.array([2.0]), device="cpu")
    coupled = wl.SumOperator(A, low)
    found = NaturalResidual(wl.LCP(coupled, np.ones((2, 3))))
    inside = problem.unknown.numpy() == 1
    np.testing.assert_array_equal(
        found.diagonal.numpy()[inside],
        problem.layout.load(coupled.diagonal(), wp.float64).numpy()[inside],
    )


def test_an_operator_that_shows_its_diagonal_only():
    """Scale of an operator with its diagonal only.

    |A_ii| where that is at least a tenth of the sizes of row and column, otherwise about those
    sizes.
    """
    M, b = TINY
    residual = NaturalResidual(wl.LCP(OperatorWithoutEntries(M), b))
    wrong = wp.array([1.0, 1e-8], dtype=wp.float64, device="cpu")
    assert residual.evaluate(wrong) > 0.5
    result = wl.solve(wl.LCP(OperatorWithoutEntries(M), b), wl.MinimumMapNewton())
    assert not result or np.abs(result.x.numpy() - 1.0).max() < 1e-5
    rng = np.random.default_rng(619)
    K = np.triu(rng.standard_normal((30, 30)), 1)
    skew, grid = K - K.T + 1e-9 * np.eye(30), 2.0 * np.eye(30) - np.eye(30, k=1) - np.eye(30, k=-1)
    d = scale_by_products(np.diag(skew), skew.__matmul__, skew.T.__matmul__)
    assert (d >= scale_of_matrix(skew) / 2).all()
    assert (d <= 12 * scale_of_matrix(skew)).all()
    np.testing.assert_array_equal(
        NaturalResidual(wl.LCP(OperatorWithoutEntries(grid), np.ones(30))).diagonal.numpy(), 2.0
    )


def test_entries_that_change_change_the_scale():
    M, b = TINY
    A = wl.SparseOperator(scipy.sparse.csr_array(M + np.diag([3.0, 3.0])), device="cpu")
    problem = wl.LCP(A, b)
    chain = wl.default_chain(wl.MinimumMapNewton(), problem)
    work = chain.init(problem)
    np.testing.assert_array_equal(work.residual.diagonal.numpy(), 3.0 + 1e-8)
    A.update(scipy.sparse.csr_array(M))
    result = wl.solve(problem, chain, workspace=work)
    np.testing.assert_array_equal(work.residual.diagonal.numpy(), 1.0)
    np.testing.assert_allclose(result.x.numpy(), lemke(M, b), atol=1e-6)


@pytest.mark.parametrize("keep", [False, True])
def test_the_start_is_projected_and_nothing_beside_it_is_written(keep):
    problem = wl.LCP(wl.DenseOperator(np.eye(5), device="cpu"), np.ones(5), -1.0, 0.5)
    stored = problem.layout.zeros(wp.float64).size
    memory = wp.full(stored + 1, 7.0, dtype=wp.float64, device="cpu")
    x = memory[:stored]
    wl.ProjectedSOR().init(problem).residual.start(x, keep=keep)
    assert (x.numpy()[problem.layout.places()] == (0.5 if keep else 0.0)).all()
    assert memory.numpy()[stored] == 7.0
