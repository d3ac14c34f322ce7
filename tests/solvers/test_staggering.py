"""Staggering: partitions of one problem, and blocks that are operators of their own."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from oracle import assemble, lemke
from warp_lcp.solvers.coupled_problem import StaggeredRound, solve_coupled
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.staggering import Staggering

TIGHT = wl.StoppingCriteria(rtol=1e-9, max_iterations=500, patience=100)


def spd(n, seed, shift=0.5):
    B = np.random.default_rng(seed).standard_normal((n, n))
    return B @ B.T / n + shift * np.eye(n)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_blocks_with_a_method_each(count, device):
    rng = np.random.default_rng(179)
    A, b = spd(24, 7), rng.standard_normal(24)
    blocks = np.array_split(rng.permutation(24), count)
    solvers = [Lemke(), wl.ProjectedSOR(), wl.MinimumMapNewton(), wl.ProjectedSOR(omega=1.0)][:count]
    for operator in (wl.DenseOperator(A, device=device), wl.SparseOperator(scipy.sparse.csr_array(A), device=device)):
        result = wl.solve(wl.LCP(operator, b), Staggering(blocks=blocks, solvers=solvers), stopping=TIGHT)
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-7)


def test_grid_blocks_are_grids(device):
    """Left and right halves of a box with a solid: each is solved by grid multigrid with the other's cells as boundary values."""
    cells = np.ones((6, 8, 8), dtype=int)
    cells[-1], cells[2, 3:5, 3:5] = wl.AIR, wl.SOLID
    faces = np.random.default_rng(181).uniform(0.5, 1.0, (6, 8, 9))
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells, (faces, 1.0, 1.0))
    b = np.where(cells == wl.FLUID, np.random.default_rng(191).standard_normal(cells.shape), 0.0)
    left = np.broadcast_to(np.arange(8) < 4, cells.shape).ravel()
    problem = wl.LCP(wl.GridPoisson(cells, face_x=faces, device=device, dtype=wp.float64), b, 0.0, 2.0)
    solver = Staggering(blocks=[np.flatnonzero(fluid & left), np.flatnonzero(fluid & ~left)], solvers=[wl.ProjectedMultigrid()])
    result = wl.solve(problem, solver, stopping=TIGHT)
    whole = wl.solve(problem, wl.ProjectedMultigrid(), stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), whole.x.numpy(), atol=1e-6)
    x = result.x.numpy().ravel()[fluid]
    y = dense[np.ix_(fluid, fluid)] @ x + b.ravel()[fluid]
    assert np.abs(x - np.clip(x - y, 0, 2)).max() <= 1e-6


def test_operators_that_change_in_place_are_taken_again(device):
    rng = np.random.default_rng(193)
    matrices = [scipy.sparse.csr_array(spd(12, seed)) for seed in (8, 9)]
    A = wl.SparseOperator(matrices[0], device=device)
    b = rng.standard_normal(12)
    problem, solver = wl.LCP(A, b), Staggering()
    work = solver.init(problem)
    for matrix in matrices:
        A.update(matrix.toarray().ravel())
        result = wl.solve(problem, solver, stopping=TIGHT, workspace=work)
        assert result
        np.testing.assert_allclose(result.x.numpy(), lemke(matrix.toarray(), b), atol=1e-7)


class Normal:
    """Normal force n >= 0 of a contact whose friction t is another problem's: y = 2 n + t / 2 - 1."""

    def __init__(self, shared, device):
        self.shared = shared
        self.b = wp.zeros(1, dtype=wp.float64, device=device)
        self.problem = wl.LCP(wl.DenseOperator(np.array([[2.0]]), device=device), self.b)

    def couple(self):
        self.b.assign([0.5 * self.shared["t"][0] - 1.0])

    def guess(self):
        return wp.array(self.shared["n"], dtype=wp.float64, device=self.problem.device)

    def accept(self, result):
        self.shared["n"] = result.x.numpy().copy()


class Friction:
    """Friction t of two directions on a sparse operator, |t| <= mu n: y = 3 t + n / 2 + pull."""

    def __init__(self, shared, device):
        self.shared = shared
        self.b, self.low, self.high = (wp.zeros(2, dtype=wp.float64, device=device) for _ in range(3))
        A = wl.SparseOperator(scipy.sparse.csr_array(3 * np.eye(2)), device=device)
        self.problem = wl.LCP(A, self.b, self.low, self.high)

    def couple(self):
        n = self.shared["n"][0]
        self.b.assign([0.5 * n - self.shared["pull"], 0.0])
        self.low.assign([-0.4 * n] * 2)
        self.high.assign([0.4 * n] * 2)

    def guess(self):
        return wp.array(self.shared["t"], dtype=wp.float64, device=self.problem.device)

    def accept(self, result):
        self.shared["t"] = result.x.numpy().copy()


@pytest.mark.parametrize("pull", [0.4, 5.0])
def test_blocks_of_different_operators_meet_at_their_common_solution(pull, device):
    """By hand: sticking, t = (pull - n / 2) / 3 with 2 n + t / 2 = 1; sliding, t = 0.4 n and n = 1 / 2.2."""
    shared = {"n": np.zeros(1), "t": np.zeros(2), "pull": pull}
    blocks = [Normal(shared, device), Friction(shared, device)]
    result = solve_coupled(blocks, [Lemke(), wl.ProjectedSOR(omega=1.0)], stopping=wl.StoppingCriteria(rtol=1e-10))
    assert result, result.status
    n = np.linalg.solve([[2.0, 0.5], [0.5, 3.0]], [1.0, pull])
    expected = n if n[1] <= 0.4 * n[0] else np.array([1 / 2.2, 0.4 / 2.2])
    assert (pull > 1) == (n[1] > 0.4 * n[0])
    np.testing.assert_allclose([shared["n"][0], shared["t"][0]], expected, atol=1e-9)
    assert shared["t"][1] == pytest.approx(0.0, abs=1e-12)
    assert result.residual == pytest.approx(np.linalg.norm(result.blocks))
    assert len(result.history) == result.iterations + 1
    assert result.iterations <= 12


def test_a_coupled_solve_says_how_it_failed(device):
    shared = {"n": np.zeros(1), "t": np.zeros(2), "pull": 0.4}
    blocks = [Normal(shared, device), Friction(shared, device)]
    few = solve_coupled(blocks, [wl.ProjectedSOR()] * 2, stopping=wl.StoppingCriteria(rtol=1e-12, max_iterations=1))
    assert few.status is wl.SolveStatus.MAX_ITERATIONS
    assert not few
    shared["pull"] = np.nan
    assert solve_coupled(blocks, [wl.ProjectedSOR()] * 2).status is wl.SolveStatus.NON_FINITE
    with pytest.raises(ValueError, match="1 for 2 blocks"):
        StaggeredRound(blocks, [wl.ProjectedSOR()], eta=0.1, max_iterations=10)


def test_what_cannot_be_taken_apart_is_refused():
    class Ring:
        shape, dtype, device, symmetric = (3,), wp.float64, wp.get_device("cpu"), True

        def apply(self, x, out=None):
            return x

        apply_transpose = masked = apply

        def diagonal(self):
            return wp.full(3, 1.0, dtype=wp.float64, device="cpu")

    with pytest.raises(ValueError, match=r"Staggering needs an operator with rows .* or blocks .*; Ring has none"):
        Staggering().init(wl.LCP(Ring(), -np.ones(3)))
    for settings in ({"blocks": 0}, {"eta": 1.0}, {"max_block_iterations": 0}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            Staggering(**settings)


def test_one_method_serves_all_blocks():
    problem = wl.LCP(wl.DenseOperator(spd(8, 3), device="cpu"), np.random.default_rng(197).standard_normal(8))
    alone, listed = (wl.solve(problem, Staggering(solvers=solvers), stopping=TIGHT) for solvers in (Lemke(), [Lemke()]))
    assert alone
    assert alone.iterations == listed.iterations
    np.testing.assert_array_equal(alone.x.numpy(), listed.x.numpy())


@pytest.mark.parametrize("blocks", [2.5, "ab", None])
@pytest.mark.parametrize("method", [wl.BlockedGaussSeidel, Staggering])
def test_blocks_of_another_kind_are_named(method, blocks):
    if blocks is None and method is wl.BlockedGaussSeidel:
        pytest.skip("None means 3 unknowns there")
    with pytest.raises(ValueError, match=r"blocks = .*for each block a list of indices"):
        wl.solve(wl.LCP(wl.DenseOperator(np.eye(4), device="cpu"), -np.ones(4)), method(blocks=blocks))
