"""Blocked Gauss-Seidel and staggering, iterate by iterate against plain loops.

The tests cover subproblems, and friction within blocks and across them.
"""

import itertools

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from matrices import dense_and_sparse, spd
from method_steps import iterates
from oracle import assemble, boxed
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.staggering import Staggering

FRICTION = 0.4
ORDERS = {"forward": (1,), "backward": (-1,), "symmetric": (1, -1)}


def held_others(A, b, x, block):
    """Return A_BB and b_B + A_BC x_C of [Book] eq. 2.66, C the other unknowns."""
    others = np.setdiff1d(np.arange(len(b)), block)
    return A[np.ix_(block, block)], b[block] + A[np.ix_(block, others)] @ x[others]


def contact_bounds(normal, x):
    """Return both sides of |t| <= mu n and n >= 0."""
    limit = FRICTION * x[np.maximum(normal, 0)]
    return np.where(normal >= 0, -limit, 0.0), np.where(normal >= 0, limit, np.inf)


def sliding_block(A, b, normal):
    """Solve a block with friction inside, by enumeration.

    Each unknown free, at its lower and at its upper bound, which may be affine in another.
    """
    n = len(b)
    for kind in itertools.product("fLU", repeat=n):
        M, r = A.copy(), -b
        for i, at in enumerate(kind):
            if at == "f":
                continue
            if normal[i] < 0 and at == "U":
                break
            M[i], r[i] = np.eye(n)[i], 0.0
            if normal[i] >= 0:
                M[i, normal[i]] -= -FRICTION if at == "L" else FRICTION
        else:
            x = np.linalg.solve(M, r)
            (lower, upper), y = contact_bounds(normal, x), A @ x + b
            signs = {"f": abs(y) < 1e-9, "L": y > -1e-9, "U": y < 1e-9}
            if (
                (x >= lower - 1e-9).all()
                and (x <= upper + 1e-9).all()
                and all(signs[at][i] for i, at in enumerate(kind))
            ):
                return x
    return None


@pytest.mark.every_case
@pytest.mark.parametrize("direction", list(ORDERS))
@pytest.mark.parametrize("omega", [1.0, 0.7, 1.4])
def test_sweeps_over_blocks_are_those_of_the_algorithm(omega, direction, device):
    """Sweeps over blocks against the algorithm.

    Each block is solved by exhaustive search; x moves by omega of the way and is projected.
    """
    rng = np.random.default_rng(4801)
    A, b = spd(11, 4801, 0.3), 2 * rng.standard_normal(11)
    lower, upper = (
        np.where(rng.random(11) < 0.3, -np.inf, -rng.random(11)),
        np.where(rng.random(11) < 0.3, np.inf, rng.random(11)),
    )
    order = rng.permutation(11)
    blocks = [order[:3], order[3:4], order[4:9], order[9:]]
    expected, x = [], np.zeros(11)
    for _ in range(4):
        for turn in ORDERS[direction]:
            for block in blocks[::turn]:
                solution = boxed(*held_others(A, b, x, block), lower[block], upper[block])
                x[block] = np.clip(
                    x[block] + omega * (solution - x[block]), lower[block], upper[block]
                )
        expected.append(x.copy())
    for operator in dense_and_sparse(A, device):
        method = BlockedGaussSeidel(blocks=blocks, omega=omega, direction=direction)
        if operator.device.is_cuda:
            continue  # in colors, another order
        for got, x in zip(
            iterates(wl.LCP(operator, b, lower, upper), method, 4), expected, strict=True
        ):
            np.testing.assert_allclose(got, x, atol=1e-11)


@pytest.mark.parametrize("omega", [1.0, 0.7])
def test_contacts_with_friction_are_blocks_whose_limits_are_part_of_them(omega, device):
    """Contacts with friction as blocks with their limits.

    n >= 0 and |t| <= mu n at once; the normal force, whose bounds are constant, is projected before
    the forces that it limits.
    """
    normal, states = (
        np.tile([-1, 0, 0], 3) + np.repeat([0, 3, 6], 3) * (np.tile([0, 1, 1], 3)),
        set(),
    )
    for seed in range(4811, 4816):
        rng = np.random.default_rng(seed)
        A, b, x = spd(9, seed, 0.3), 2 * rng.standard_normal(9) - 1.0, np.zeros(9)
        problem = wl.LCP(
            wl.DenseOperator(A, device=device), b, *wl.AffineBounds.friction(normal, FRICTION)
        )
        for got in iterates(problem, BlockedGaussSeidel(blocks=3, omega=omega), 4):
            for first in (0, 3, 6):
                block = np.arange(first, first + 3)
                solution = sliding_block(*held_others(A, b, x, block), np.array([-1, 0, 0]))
                states.add(tuple(np.sign(np.round(solution, 9))))
                x[block] += omega * (solution - x[block])
                x[first] = max(x[first], 0.0)
                x[block] = np.clip(x[block], *(side[block] for side in contact_bounds(normal, x)))
            np.testing.assert_allclose(got, x, atol=1e-10)
    assert len(states) > 3


@pytest.mark.parametrize("method", [Staggering, BlockedGaussSeidel])
@pytest.mark.parametrize("direction", ["forward", "symmetric"])
def test_rounds_over_subproblems_are_those_of_the_algorithm(method, direction, device):
    """Rounds over subproblems against the algorithm.

    A_BB x_B + (b_B + A_BC x_C) within its own bounds, by a method that solves to rounding; A is
    unsymmetric, so that rows and columns differ.
    """
    rng = np.random.default_rng(4821)
    C = rng.standard_normal((12, 12))
    A, b = spd(12, 4821, 0.3) + 0.2 * (C - C.T), 2 * rng.standard_normal(12)
    lower, upper = (
        np.where(rng.random(12) < 0.3, -np.inf, -rng.random(12)),
        np.where(rng.random(12) < 0.3, np.inf, rng.random(12)),
    )
    order = rng.permutation(12)
    blocks, turns = (
        [order[:5], order[5:6], order[6:]],
        ORDERS[direction] if method is BlockedGaussSeidel else (1,),
    )
    expected, x = [], np.zeros(12)
    for _ in range(3):
        for turn in turns:
            for block in blocks[::turn]:
                x[block] = boxed(*held_others(A, b, x, block), lower[block], upper[block])
        expected.append(x.copy())
    if method is BlockedGaussSeidel:
        solver = BlockedGaussSeidel(
            blocks=blocks, sub_solver=wl.Lemke(), direction=direction, eta=1e-12
        )
    else:
        solver = Staggering(
            blocks=blocks,
            solvers=[wl.Lemke(), wl.ProjectedSOR(omega=1.0), wl.MinimumMapNewton(direct=True)],
            eta=1e-12,
        )
    for operator in dense_and_sparse(A, device):
        for got, x in zip(
            iterates(wl.LCP(operator, b, lower, upper), solver, 3), expected, strict=True
        ):
            np.testing.assert_allclose(got, x, atol=1e-9)


def test_normal_and_tangential_forces_in_turn(device):
    """Normal and tangential forces in turn, [Book] 2.2.4.

    Each round solves for normal forces with friction fixed, then for friction within the limits of
    these normal forces.
    """
    normal = np.repeat(np.arange(0, 9, 3), 3)
    normal[::3] = -1
    normals, tangential = np.flatnonzero(normal < 0), np.flatnonzero(normal >= 0)
    slides = sticks = 0
    for seed in range(4831, 4836):
        A, b, x = spd(9, seed, 0.3), 2 * np.random.default_rng(seed).standard_normal(9), np.zeros(9)
        problem = wl.LCP(
            wl.DenseOperator(A, device=device), b, *wl.AffineBounds.friction(normal, FRICTION)
        )
        method = Staggering(
            blocks=[normals, tangential],
            solvers=[wl.Lemke(), wl.MinimumMapNewton(direct=True)],
            eta=1e-12,
        )
        for got in iterates(problem, method, 4):
            for block in (normals, tangential):
                x[block] = boxed(
                    *held_others(A, b, x, block),
                    *(side[block] for side in contact_bounds(normal, x)),
                )
            np.testing.assert_allclose(got, x, atol=1e-9)
        at_limit = np.abs(x[tangential]) == contact_bounds(normal, x)[1][tangential]
        slides, sticks = slides + at_limit.sum(), sticks + (~at_limit).sum()
    assert min(slides, sticks) > 2


def test_grid_blocks_see_the_others_cells_as_boundary_values(device):
    """Grid blocks with the other cells as boundary values.

    Left and right of a 2-D grid with AIR and SOLID in turn, each solved to rounding.
    """
    rng = np.random.default_rng(4841)
    cells = np.ones((3, 6), dtype=int)
    cells[0, 0], cells[1, 3], cells[2, 5] = wl.AIR, wl.SOLID, wl.AIR
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells)
    b, x = np.where(fluid, 2 * rng.standard_normal(18), 0.0), np.zeros(18)
    left = np.broadcast_to(np.arange(6) < 3, cells.shape).ravel()
    blocks = [np.flatnonzero(fluid & left), np.flatnonzero(fluid & ~left)]
    problem = wl.LCP(
        wl.GridPoisson(cells, device=device, dtype=wp.float64), b.reshape(cells.shape), 0.0, 0.6
    )
    place = problem.layout.places()[fluid]
    solver = Staggering(blocks=blocks, solvers=wl.ProjectedMultigrid(precision="double"), eta=1e-12)
    for got in iterates(problem, solver, 3):
        for block in blocks:
            x[block] = boxed(
                *held_others(dense, b, x, block), np.zeros(len(block)), np.full(len(block), 0.6)
            )
        np.testing.assert_allclose(got[place], x[fluid], atol=1e-9)
