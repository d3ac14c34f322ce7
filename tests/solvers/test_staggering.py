"""Staggering: partitions of a problem into blocks, each with its own method."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from matrices import spd
from oracle import assemble, lemke
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.staggering import Staggering

TIGHT = wl.StoppingCriteria(rtol=1e-9, max_iterations=500, patience=100)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_blocks_with_a_method_each(count, device):
    rng = np.random.default_rng(179)
    A, b = spd(24, 7, 0.5), rng.standard_normal(24)
    blocks = np.array_split(rng.permutation(24), count)
    solvers = [Lemke(), wl.ProjectedSOR(), wl.MinimumMapNewton(), wl.ProjectedSOR(omega=1.0)][
        :count
    ]
    for operator in (
        wl.DenseOperator(A, device=device),
        wl.SparseOperator(scipy.sparse.csr_array(A), device=device),
    ):
        result = wl.solve(
            wl.LCP(operator, b), Staggering(blocks=blocks, solvers=solvers), stopping=TIGHT
        )
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-7)


def test_grid_blocks_are_grids(device):
    """Grid blocks as grids.

    Left and right halves of a box with a solid: grid multigrid solves each with the other's cells
    as boundary values.
    """
    cells = np.ones((6, 8, 8), dtype=int)
    cells[-1], cells[2, 3:5, 3:5] = wl.AIR, wl.SOLID
    faces = np.random.default_rng(181).uniform(0.5, 1.0, (6, 8, 9))
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells, (faces, 1.0, 1.0))
    b = np.where(cells == wl.FLUID, np.random.default_rng(191).standard_normal(cells.shape), 0.0)
    left = np.broadcast_to(np.arange(8) < 4, cells.shape).ravel()
    problem = wl.LCP(
        wl.GridPoisson(cells, face_x=faces, device=device, dtype=wp.float64), b, 0.0, 2.0
    )
    solver = Staggering(
        blocks=[np.flatnonzero(fluid & left), np.flatnonzero(fluid & ~left)],
        solvers=[wl.ProjectedMultigrid()],
    )
    result = wl.solve(problem, solver, stopping=TIGHT)
    whole = wl.solve(problem, wl.ProjectedMultigrid(), stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), whole.x.numpy(), atol=1e-6)
    x = result.x.numpy().ravel()[fluid]
    y = dense[np.ix_(fluid, fluid)] @ x + b.ravel()[fluid]
    assert np.abs(x - np.clip(x - y, 0, 2)).max() <= 1e-6


def test_operators_that_change_in_place_are_taken_again(device):
    rng = np.random.default_rng(193)
    matrices = [scipy.sparse.csr_array(spd(12, seed, 0.5)) for seed in (8, 9)]
    A = wl.SparseOperator(matrices[0], device=device)
    b = rng.standard_normal(12)
    problem, solver = wl.LCP(A, b), Staggering()
    work = solver.init(problem)
    for matrix in matrices:
        A.update(matrix.toarray().ravel())
        result = wl.solve(problem, solver, stopping=TIGHT, workspace=work)
        assert result
        np.testing.assert_allclose(result.x.numpy(), lemke(matrix.toarray(), b), atol=1e-7)


@pytest.mark.parametrize("pull", [0.4, 5.0])
def test_normal_force_and_friction_meet_at_their_common_solution(pull, device):
    """Common solution of normal force and friction.

    By hand, y = A (n, t) + b and |t| <= 0.4 n: sticking, t_1 = (pull - n / 2) / 3 with 2 n + t_1 /
    2 = 1; sliding, n = 1 / 2.2.
    """
    A = np.array([[2.0, 0.5, 0.0], [0.5, 3.0, 0.0], [0.0, 0.0, 3.0]])
    low, high = wl.AffineBounds.friction([-1, 0, 0], 0.4)
    problem = wl.LCP(wl.DenseOperator(A, device=device), np.array([-1.0, -pull, 0.0]), low, high)
    method = Staggering(blocks=[[0], [1, 2]], solvers=[Lemke(), wl.ProjectedSOR(omega=1.0)])
    result = wl.solve(problem, method, stopping=wl.StoppingCriteria(rtol=1e-10))
    assert result, result.status
    sticking = np.linalg.solve([[2.0, 0.5], [0.5, 3.0]], [1.0, pull])
    slides = sticking[1] > 0.4 * sticking[0]
    assert (pull > 1) == slides
    np.testing.assert_allclose(
        result.x.numpy(),
        [*(np.array([1 / 2.2, 0.4 / 2.2]) if slides else sticking), 0.0],
        atol=1e-9,
    )
    assert result.iterations <= 12
    with pytest.raises(ValueError, match="solvers: 3 for 2 blocks"):
        Staggering(blocks=[[0], [1, 2]], solvers=[Lemke()] * 3).init(problem)


def test_problems_that_cannot_be_split_are_refused():
    class OperatorWithoutBlocks:
        shape, dtype, device, symmetric = (3,), wp.float64, wp.get_device("cpu"), True

        def apply(self, x, out=None):
            return x

        apply_transpose = masked = apply

        def diagonal(self):
            return wp.full(3, 1.0, dtype=wp.float64, device="cpu")

    with pytest.raises(
        ValueError,
        match=r"Staggering needs an operator with rows .* or blocks .*; "
        r"OperatorWithoutBlocks has none",
    ):
        Staggering().init(wl.LCP(OperatorWithoutBlocks(), -np.ones(3)))
    for settings in ({"blocks": 0}, {"eta": 1.0}, {"max_block_iterations": 0}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            Staggering(**settings)


def test_one_method_serves_all_blocks():
    problem = wl.LCP(
        wl.DenseOperator(spd(8, 3, 0.5), device="cpu"),
        np.random.default_rng(197).standard_normal(8),
    )
    alone, listed = (
        wl.solve(problem, Staggering(solvers=solvers), stopping=TIGHT)
        for solvers in (Lemke(), [Lemke()])
    )
    assert alone
    assert alone.iterations == listed.iterations
    np.testing.assert_array_equal(alone.x.numpy(), listed.x.numpy())


@pytest.mark.parametrize("blocks", [2.5, "ab", None])
@pytest.mark.parametrize("method", [wl.BlockedGaussSeidel, Staggering])
def test_blocks_of_another_kind_are_named(method, blocks):
    if blocks is None and method is wl.BlockedGaussSeidel:
        pytest.skip("None means 3 unknowns there")
    with pytest.raises(ValueError, match=r"blocks = .*for each block a list of indices"):
        wl.solve(
            wl.LCP(wl.DenseOperator(np.eye(4), device="cpu"), -np.ones(4)), method(blocks=blocks)
        )
