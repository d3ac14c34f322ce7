"""Grid lines as blocks.

One line is solved at once, and strong coefficients along lines cost nothing.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from drawn_stencils import assembled
from method_steps import iterates
from oracle import assemble, boxed, lemke, natural_residual

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=3000, patience=1000)
SHAPES = {wl.GridLines.X: (1, 1, 30), wl.GridLines.Y: (1, 30, 1), wl.GridLines.Z: (30, 1, 1)}


@pytest.mark.parametrize("axis", list(wl.GridLines))
@pytest.mark.parametrize("arrays", [False, True])
def test_a_single_line_is_solved_by_one_sweep(axis, arrays, device):
    """Single line: solved by one sweep.

    With AIR at an end and in the middle, a SOLID cell, and boxes; a wrong face's weight shows in
    the first digits.
    """
    rng = np.random.default_rng(197)
    shape = SHAPES[axis]
    cells = np.ones(30, dtype=int)
    cells[[0, 17]], cells[23] = wl.AIR, wl.SOLID
    cells[29] = wl.AIR
    faces = [1.0, 1.0, 1.0]
    if arrays:
        faces[axis.value] = rng.uniform(0.2, 1.0, [n + (n == 30) for n in shape])
    cells = cells.reshape(shape)
    inside, dense = cells.ravel() == wl.FLUID, assemble(cells, faces)
    b = np.where(inside, 2 * rng.standard_normal(30), 0.0)
    upper = np.where(rng.random(30) < 0.5, rng.random(30), np.inf)
    A = wl.GridPoisson(
        cells,
        **dict(zip(("face_x", "face_y", "face_z"), faces, strict=True)),
        device=device,
        dtype=wp.float64,
    )
    problem = wl.LCP(A, b.reshape(shape), 0.0, upper.reshape(shape))
    result = wl.solve(
        problem, wl.BlockedGaussSeidel(blocks=axis), stopping=wl.StoppingCriteria(rtol=1e-12)
    )
    assert result, result.status
    assert result.iterations == 1
    x = result.x.numpy().ravel()
    low = np.where(inside, 0.0, -np.inf)
    assert natural_residual(dense, b, low, np.where(inside, upper, np.inf), x) <= 1e-11
    assert np.count_nonzero(x[inside] == 0) > 2
    assert np.count_nonzero(x == upper) > 1


@pytest.mark.parametrize("axis", list(wl.GridLines))
def test_strong_coefficients_along_lines_cost_nothing(axis, device):
    """Strong coefficients along lines, without cost.

    Cells 10 times flatter than wide: sweeps over lines across them converge as fast as for cubes,
    over cells not in 10 times the sweeps.
    """
    rng = np.random.default_rng(199)
    cells = np.ones((9, 10, 8), dtype=int)
    cells[-1] = wl.AIR
    inside = cells.ravel() == wl.FLUID
    faces = [1.0, 1.0, 1.0]
    faces[axis.value] = 100.0
    dense = assemble(cells, faces)[np.ix_(inside, inside)]
    x = rng.random(len(dense)) * (rng.random(len(dense)) < 0.6)
    b = np.zeros(cells.size)
    b[inside] = np.where(x == 0, rng.random(len(x)), 0.0) - dense @ x
    A = wl.GridPoisson(
        cells,
        **dict(zip(("face_x", "face_y", "face_z"), faces, strict=True)),
        device=device,
        dtype=wp.float64,
    )
    problem = wl.LCP(A, b.reshape(cells.shape))
    lines = wl.solve(problem, wl.BlockedGaussSeidel(blocks=axis), stopping=TIGHT)
    across = wl.GridLines((axis.value + 1) % 3)
    wrong = wl.solve(problem, wl.BlockedGaussSeidel(blocks=across), stopping=TIGHT)
    assert lines, lines.status
    np.testing.assert_allclose(lines.x.numpy().ravel()[inside], x, atol=1e-7)
    assert lines.iterations <= 60
    assert wrong.iterations >= 3 * lines.iterations


@pytest.mark.parametrize("direction", ["forward", "backward", "symmetric"])
def test_directions_precisions_and_periodic_sides(direction, device):
    rng = np.random.default_rng(211)
    cells = np.ones((5, 6, 4), dtype=int)
    cells[0], cells[3, 2, 1] = wl.AIR, wl.SOLID
    inside, dense = cells.ravel() == wl.FLUID, assemble(cells, periodic=(False, True, False))
    b = np.where(inside, rng.standard_normal(cells.size), 0.0)
    A = wl.GridPoisson(cells, periodic=(False, True, False), device=device)
    problem = wl.LCP(A, b.reshape(cells.shape))
    expected = lemke(dense[np.ix_(inside, inside)], b[inside])
    for precision, rtol in (("mixed", 1e-10), ("single", 1e-4)):
        solver = wl.BlockedGaussSeidel(
            blocks=wl.GridLines.X, direction=direction, precision=precision, omega=1.2
        )
        result = wl.solve(
            problem, solver, stopping=wl.StoppingCriteria(rtol=rtol, max_iterations=500)
        )
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy().ravel()[inside], expected, atol=100 * rtol)


@pytest.mark.parametrize("axis", [wl.GridLines.X, wl.GridLines.Y])
def test_sweeps_over_lines_of_a_stencil_are_those_of_the_algorithm(axis, device):
    """Two sweeps over the lines of a stencil of nine points, against exact solves of each line.

    No two coefficients are equal, so each must stand at its own offset. Even lines come first;
    lines of one color are not coupled.
    """
    rng = np.random.default_rng(1703)
    shape = (5, 6)
    cells = np.where(rng.random(shape) < 0.1, wl.AIR, wl.FLUID)
    coefficients = {
        (j, i): -1.0 - 0.1 * n
        for n, (j, i) in enumerate((j, i) for j in (-1, 0, 1) for i in (-1, 0, 1))
    }
    coefficients[0, 0] = 14.0
    A = wl.Stencil(cells, coefficients, device=device, dtype=wp.float64)
    inside = cells.ravel() == wl.FLUID
    dense = np.zeros((cells.size, cells.size))
    dense[np.ix_(inside, inside)] = assembled(cells, coefficients, None, (False,) * 3, wl.SOLID)
    b, x = np.where(inside, 5 * rng.standard_normal(cells.size), 0.0), np.zeros(cells.size)
    problem = wl.LCP(A, b.reshape(shape), 0.0, 0.5)
    along = np.arange(cells.size).reshape(shape)
    lines = list(along if axis is wl.GridLines.X else along.T)
    for got in iterates(problem, wl.BlockedGaussSeidel(blocks=axis, precision="double"), 2):
        for line in (*lines[::2], *lines[1::2]):
            block = line[inside[line]]
            held = b[block] + dense[block] @ x - dense[np.ix_(block, block)] @ x[block]
            x[block] = boxed(
                dense[np.ix_(block, block)], held, np.zeros(len(block)), np.full(len(block), 0.5)
            )
        stored = got.reshape(problem.layout.stored_shape)[1, 1:-1, 1:-1]
        np.testing.assert_allclose(stored.ravel()[inside], x[inside], atol=1e-12)
    assert min(np.count_nonzero(x[inside] == v) for v in (0.0, 0.5)) > 3


def test_lines_that_are_none_are_refused():
    periodic = wl.LCP(
        wl.GridPoisson(np.array([[0, 1, 1, 1]]), periodic=(True, False), device="cpu"),
        -np.ones((1, 4)),
    )
    odd = wl.LCP(
        wl.GridPoisson(np.ones((3, 4), dtype=int), periodic=(False, True), device="cpu"),
        -np.ones((3, 4)),
    )
    dense = wl.LCP(wl.DenseOperator(np.eye(2), device="cpu"), -np.ones(2))
    for problem, message in (
        (periodic, "cannot run along a periodic axis"),
        (odd, "needs? an even number"),
        (dense, "only for GridPoisson"),
    ):
        with pytest.raises(ValueError, match=message):
            wl.BlockedGaussSeidel(blocks=wl.GridLines.X).init(problem)
