"""Default method on unsymmetric stencils.

Their coefficients vary by decades, or they are singular.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering
from drawn_stencils import SINGULAR, drawn_dominant, drawn_singular
from oracle import natural_residual
from warp_lcp.operators.grid_matrix import grid_matrix


def check_dominant(seed):
    stencil, b, lower, upper = drawn_dominant(seed)
    A, inside = stencil.operator(), stencil.inside
    result = wl.solve(
        wl.LCP(A, b, lower, upper), stopping=wl.StoppingCriteria(rtol=1e-8, max_seconds=60)
    )
    assert result, f"{result.status.name} at {result.relative_residual:.1e}"
    matrix = grid_matrix(A)
    data, d = (matrix, b[inside], lower, upper), matrix.diagonal()
    found = natural_residual(*data, result.x.numpy()[inside], d)
    assert found <= 1.001e-8 * natural_residual(*data, np.clip(0 * b[inside], lower, upper), d)


@pytest.mark.parametrize("seed", [9, 34, 60, 68, 103, 184, 214])
def test_dominant_m_matrices_converge(seed):
    check_dominant(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6000, 6120))
def test_more_dominant_m_matrices_converge(seed):
    check_dominant(seed)


@pytest.mark.parametrize("seed", [3, 4, 5, 7])
def test_coefficients_over_decades_take_as_few_steps_as_a_sparse_matrix(seed):
    """Coefficients over decades: as few steps as a sparse matrix.

    Cycles over lines stall on these, and GMRES with the matrix's own multigrid does not.
    """
    rng, shape = np.random.default_rng(seed), (60, 70)
    offsets = [(j, i) for j in (-1, 0, 1) for i in (-1, 0, 1) if (j, i) != (0, 0)]
    given = {o: -(10 ** rng.uniform(-3, 0, shape)) for o in offsets}
    given[0, 0] = 1.001 * sum(-a for a in given.values())
    A = wl.Stencil(np.ones(shape, dtype=int), given, outside=wl.AIR, device="cpu", dtype=wp.float64)
    result = wl.solve(wl.LCP(A, rng.standard_normal(shape), -np.inf, np.inf))
    assert result
    assert result.iterations <= 5


# The sum of b, weighted by the left null vector, over each component; bounds; the end of a solve.
CASES = {
    "compatible": (0.0, -np.inf, np.inf, "CONVERGED"),
    "not compatible": (0.3, -np.inf, np.inf, "INFEASIBLE"),
    "onto lower bounds": (0.3, 0.0, np.inf, "CONVERGED"),
    "onto upper bounds": (-0.3, -np.inf, 0.0, "CONVERGED"),
    "off lower bounds": (-0.3, 0.0, np.inf, "INFEASIBLE"),
}


def check_singular(seed, kind):
    stencil = drawn_singular(seed, kind)
    A, inside = stencil.operator(), stencil.inside
    matrix = grid_matrix(A)
    count, number = scipy.sparse.csgraph.connected_components(matrix, directed=False)
    W = np.zeros((matrix.shape[0], count))
    for c in range(count):
        places = np.flatnonzero(number == c)
        # Of irreducible M-matrices: w > 0.
        W[places, c] = abs(np.linalg.svd(matrix[places][:, places].toarray())[0][:, -1])
    assert abs(W.T @ matrix).max() < 1e-12
    b = np.random.default_rng([seed, 22]).standard_normal(matrix.shape[0])
    b -= W @ (W.T @ b)
    for net, lower, upper, status in CASES.values():
        right, field = b + W @ np.full(count, net), np.zeros(inside.shape)
        field[inside] = right
        result = wl.solve(wl.LCP(A, field, lower, upper))
        assert result.status.name == status, (net, lower, upper)
        if result:
            x = result.x.numpy()[inside]
            found = natural_residual(matrix, right, lower, upper, x, matrix.diagonal())
            assert found <= 1e-5 * np.linalg.norm(right)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(("seed", "kind"), covering([2, 18, 23], list(SINGULAR)))
def test_singular_stencils_are_solved_or_infeasible(seed, kind):
    check_singular(seed, kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SINGULAR)
@pytest.mark.parametrize("seed", range(6200, 6230))
def test_more_singular_stencils_are_solved_or_infeasible(seed, kind):
    check_singular(seed, kind)


def test_a_periodic_stencil_without_a_solution_ends_at_once():
    n = 200
    b = np.random.default_rng(29).standard_normal((n, n))
    stencil = np.array([[-1.0, -2, -1], [-2, 12, -2], [-1, -2, -1]])
    A = wl.Stencil(np.ones((n, n), dtype=int), stencil, periodic=(True, True, False), device="cpu")
    result = wl.solve(wl.LCP(A, b + 0.01 - b.mean(), -np.inf, np.inf))
    assert (result.status, result.iterations) == (wl.SolveStatus.INFEASIBLE, 0)
    assert wl.solve(wl.LCP(A, b - b.mean(), -np.inf, np.inf))


def test_components_are_those_of_the_coefficients():
    """Components by the coefficients.

    Two boxes that touch at a corner, one of them held: coupled by nine points, not by five, nor
    where coefficients are 0.
    """
    cells = np.full((6, 6), wl.SOLID)
    cells[:3, :3] = cells[3:, 3:] = wl.FLUID
    cells[0, 0] = wl.AIR
    five = np.array([[0.0, -1, 0], [-1, 4, -1], [0, -1, 0]])
    nine = np.array([[-1.0, -1, -1], [-1, 8, -1], [-1, -1, -1]])
    assert wl.Stencil(cells, nine, device="cpu").floating_components() is None
    assert wl.Stencil(cells, five, device="cpu").floating_components().count == 1
    zeros = {
        o: np.full((6, 6), nine[o[0] + 1, o[1] + 1])
        for o in np.ndindex(3, 3)
        for o in [(o[0] - 1, o[1] - 1)]
    }
    zeros[1, 1][2, 2] = zeros[-1, -1][3, 3] = 0.0
    zeros[0, 0] = -sum(a for o, a in zeros.items() if any(o))
    assert wl.Stencil(cells, zeros, device="cpu", dtype=wp.float64).floating_components().count == 1
