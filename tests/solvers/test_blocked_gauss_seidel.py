"""Blocked Gauss-Seidel.

Blocks of one are projected Gauss-Seidel, one block is its solver; in between, strong coupling
inside blocks costs nothing.
"""

import itertools

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from matrices import dense_and_sparse, spd
from oracle import assemble, boxed, lemke
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.staggering import color_blocks

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=5000, patience=2000)


def block_sweep(A, b, lower, upper, x, blocks):
    """Return one sweep with exhaustive search in the blocks."""
    for block in blocks:
        rest = b[block] + A[block] @ x - A[np.ix_(block, block)] @ x[block]
        x[block] = boxed(A[np.ix_(block, block)], rest, lower[block], upper[block])
    return x


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6])
def test_a_sweep_solves_each_block_exactly(size, device):
    rng = np.random.default_rng(149 + size)
    A, b = spd(13, size, 0.2), 2 * rng.standard_normal(13)
    lower, upper = (
        np.where(rng.random(13) < 0.3, -np.inf, -rng.random(13)),
        np.where(rng.random(13) < 0.3, np.inf, rng.random(13)),
    )
    order = rng.permutation(13)
    blocks = [order[i : i + size] for i in range(0, 13, size)]
    expected = block_sweep(A, b, lower, upper, np.clip(np.zeros(13), lower, upper), blocks)
    for operator in dense_and_sparse(A, device):
        problem = wl.LCP(operator, b, lower, upper)
        result = wl.solve(
            problem,
            BlockedGaussSeidel(blocks=blocks),
            stopping=wl.StoppingCriteria(rtol=0.0, max_iterations=1),
        )
        work_x = result.x.numpy() if result.residual < result.history[0].residual else None
        assert work_x is not None
        np.testing.assert_allclose(work_x, expected, atol=1e-11)


def test_contacts_in_space_are_blocks_without_being_asked_for(device):
    """Default blocks of 3-D contacts: three unknowns each.

    Where nothing else couples them, one sweep solves all.
    """
    rng = np.random.default_rng(163)
    contacts, b = [spd(3, seed, 0.2) for seed in range(5)], -rng.random(15)
    A = scipy.sparse.block_diag(contacts).toarray()
    expected = np.concatenate(
        [
            boxed(a, b[3 * i : 3 * i + 3], np.zeros(3), np.full(3, np.inf))
            for i, a in enumerate(contacts)
        ]
    )
    for operator in dense_and_sparse(A, device):
        result = wl.solve(wl.LCP(operator, b), BlockedGaussSeidel(), stopping=TIGHT)
        assert (result.status, result.iterations) == (wl.SolveStatus.CONVERGED, 1)
        np.testing.assert_allclose(result.x.numpy(), expected, atol=1e-12)


def test_blocks_of_one_are_projected_gauss_seidel(device):
    rng = np.random.default_rng(151)
    A, b = spd(20, 3, 0.2), rng.standard_normal(20)
    for operator in dense_and_sparse(A, device):
        problem = wl.LCP(operator, b)
        for direction in ("forward", "backward", "symmetric"):
            scalar = wl.solve(
                problem, wl.ProjectedSOR(omega=1.0, direction=direction), stopping=TIGHT
            )
            blocks = wl.solve(
                problem, BlockedGaussSeidel(blocks=1, direction=direction), stopping=TIGHT
            )
            assert scalar
            assert blocks.iterations == scalar.iterations
            np.testing.assert_allclose(
                [r.residual for r in blocks.history],
                [r.residual for r in scalar.history],
                rtol=1e-6,
                atol=1e-13,
            )


@pytest.mark.parametrize("sub_solver", [None, wl.MinimumMapNewton(), Lemke()])
def test_one_block_is_its_solver(sub_solver, device):
    rng = np.random.default_rng(157)
    A, b = spd(25, 4, 0.2), rng.standard_normal(25)
    for operator in dense_and_sparse(A, device):
        result = wl.solve(
            wl.LCP(operator, b),
            BlockedGaussSeidel(blocks=25, sub_solver=sub_solver, eta=1e-12),
            stopping=TIGHT,
        )
        assert result, result.status
        assert result.iterations == 1
        np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-9)


def test_strong_coupling_inside_blocks_costs_no_sweeps(device):
    """Strong coupling inside blocks, at no cost in sweeps.

    Pairs are coupled by 0.999, weakly with others: scalar sweeps contract by 0.998, block sweeps at
    once.
    """
    pairs, rng = 10, np.random.default_rng(163)
    A = np.kron(np.eye(pairs), [[1.0, 0.999], [0.999, 1.0]])
    A += 1e-4 * spd(2 * pairs, 5, 0.2)
    b = -A @ rng.uniform(0.1, 1.0, 2 * pairs)
    for operator in dense_and_sparse(A, device):
        problem = wl.LCP(operator, b)
        blocks = wl.solve(problem, BlockedGaussSeidel(blocks=2), stopping=TIGHT)
        scalar = wl.solve(
            problem,
            wl.ProjectedSOR(omega=1.0),
            stopping=wl.StoppingCriteria(rtol=1e-10, max_iterations=500),
        )
        assert blocks
        assert blocks.iterations <= 10
        assert scalar.status is wl.SolveStatus.MAX_ITERATIONS
        np.testing.assert_allclose(blocks.x.numpy(), lemke(A, b), atol=1e-7)


def test_blocks_that_active_sets_cycle_on_are_solved_all_the_same(device):
    """Blocks on which active sets cycle: solved nevertheless.

    Newton's changes of the set cycle on this P-matrix; the least index ends that. Every right-hand
    side of signs +-1.
    """
    A = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        b = np.array(signs)
        result = wl.solve(
            wl.LCP(wl.DenseOperator(A, device=device), b),
            BlockedGaussSeidel(blocks=3),
            stopping=TIGHT,
        )
        assert result
        np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-10)


def test_singular_blocks_take_a_set_that_is_regular(device):
    """Singular blocks: a regular set is used.

    Rank one: x_0 + x_1 = 1 has many solutions, of which one at a bound is returned.
    """
    problem = wl.LCP(wl.DenseOperator(np.ones((2, 2)), device=device), -np.ones(2), 0.0, 1.0)
    result = wl.solve(problem, BlockedGaussSeidel(blocks=2), stopping=TIGHT)
    assert result
    assert result.x.numpy().sum() == pytest.approx(1.0)


def test_unsymmetric_blocks_read_rows_not_columns(device):
    rng = np.random.default_rng(167)
    A = rng.uniform(-1, 1, (12, 12)) / 4 + 2 * np.eye(12)
    b = rng.standard_normal(12)
    for operator in dense_and_sparse(A, device):
        for blocks, sub_solver in ((3, None), (5, None), (7, None), (4, Lemke())):
            result = wl.solve(
                wl.LCP(operator, b),
                BlockedGaussSeidel(blocks=blocks, sub_solver=sub_solver),
                stopping=TIGHT,
            )
            assert result, result.status
            np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-8)


def test_grids_take_given_blocks_with_a_solver(device):
    cells = np.ones((4, 6), dtype=int)
    cells[0], cells[2, 3] = wl.AIR, wl.SOLID
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells)
    b = np.where(cells == wl.FLUID, np.random.default_rng(173).standard_normal(cells.shape), 0.0)
    rows = [np.flatnonzero(fluid & (np.arange(24) // 6 == j)) for j in (1, 2, 3)]
    problem = wl.LCP(wl.GridPoisson(cells, device=device, dtype=wp.float64), b)
    result = wl.solve(
        problem, BlockedGaussSeidel(blocks=rows, sub_solver=wl.ProjectedSOR()), stopping=TIGHT
    )
    assert result
    np.testing.assert_allclose(
        result.x.numpy().ravel()[fluid],
        lemke(dense[np.ix_(fluid, fluid)], b.ravel()[fluid]),
        atol=1e-8,
    )
    with pytest.raises(
        ValueError,
        match="gives no access to rows: give BlockedGaussSeidel GridLines, or lists as blocks",
    ):
        BlockedGaussSeidel(blocks=3).init(problem)


def test_colors_separate_coupled_blocks():
    A = scipy.sparse.csr_array(assemble(np.ones((8, 8), dtype=int)))
    owner = np.arange(64) // 4
    colors = color_blocks(A, owner, 16)
    assert sorted(np.concatenate(colors).tolist()) == list(range(16))
    for color in colors:
        inside = np.isin(owner, color)
        block = A[inside][:, inside].tocoo()
        numbers = owner[inside]
        assert (numbers[block.row] == numbers[block.col]).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"blocks": 0}, "blocks = 0"),
        ({"omega": 0.0}, "omega = 0"),
        ({"omega": 1.5, "sub_solver": wl.ProjectedSOR()}, "must be 1 with a sub_solver"),
        ({"direction": "up"}, "direction"),
        ({"eta": 0.0}, "eta"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        BlockedGaussSeidel(**settings)


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        ([[0, 1]], "index 2 0 times"),
        ([[0, 1], [1, 2]], "index 1 2 times"),
        ([[0, 1], [], [2]], r"blocks\[1\] is empty"),
        ([[0, 1], [2, 3]], r"blocks\[1\] has indices from 2 to 3"),
    ],
)
def test_blocks_that_are_no_partition_are_named(blocks, message):
    problem = wl.LCP(wl.DenseOperator(np.eye(3), device="cpu"), -np.ones(3))
    with pytest.raises(ValueError, match=message):
        BlockedGaussSeidel(blocks=blocks).init(problem)
