"""`wl.Stencil` against matrices that NumPy assembles cell by cell."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import few
from drawn_stencils import KINDS, border_sums, drawn, rising, rising_in_space
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.stencil import StoredStencil

NINE = np.array([[-1.0, -4.0, -1.0], [-4.0, 20.0, -4.0], [-1.0, -4.0, -1.0]]) / 6


def changed(A, cells):
    """Set other cells."""
    A.update(
        wp.array(np.pad(cells.reshape(A.layout.padding.counts), 1).astype(np.int8), device=A.device)
    )


def same(found, expected, kind):
    """Compare to the accuracy of float32 functions or float64 arrays."""
    np.testing.assert_allclose(
        found, expected, rtol=1e-9, atol=2e-5 if kind == "functions" else 1e-11
    )


def check_definition(seed, kind, device):
    """Compare all results of a stencil with the definition, on other cells, too."""
    stencil, rng = drawn([seed, 9], kind), np.random.default_rng(seed)
    A, expected, inside = stencil.operator(device), stencil.matrix(), stencil.inside
    x = rng.standard_normal(stencil.cells.shape)
    field = wp.array(x, dtype=wp.float64, device=device)
    same(A.apply(field).numpy()[inside], expected @ x[inside], kind)
    same(A.apply_transpose(field).numpy()[inside], expected.T @ x[inside], kind)
    same(A.diagonal().numpy()[inside], expected.diagonal(), kind)
    same(grid_matrix(A).toarray(), expected, kind)
    same(grid_matrix(A.transposed()).toarray(), expected.T, kind)
    same(grid_matrix(pickle.loads(pickle.dumps(A))).toarray(), expected, kind)
    assert A.symmetric <= np.allclose(expected, expected.T, atol=1e-14)
    assert A.symmetric or kind not in ("mirrored", "half mirrored")
    around = [
        v(*np.argwhere(inside).T) if callable(v) else np.broadcast_to(v, x.shape)[inside]
        for o, v in stencil.plain.items()
        if any(o)
    ]
    assert A.monotone == all((np.ravel(v) <= 0).all() for v in around)
    padded = rng.standard_normal([n + 2 for n in x.shape])
    same(A.boundary_term(padded).numpy(), border_sums(stencil, padded), kind)
    cells = rng.choice([wl.AIR, wl.FLUID, wl.FLUID, wl.SOLID], x.shape)
    cells.flat[0] = wl.FLUID
    other = replace(stencil, cells=cells)
    again, where = A.on_cells(np.pad(cells.reshape(A.layout.padding.counts), 1)), other.inside
    changed(A, cells)
    for B in (A, again):
        same(grid_matrix(B).toarray(), other.matrix(), kind)
        same(B.apply_transpose(field).numpy()[where], other.matrix().T @ x[where], kind)
        assert B.symmetric <= np.allclose(other.matrix(), other.matrix().T, atol=1e-14)


@pytest.mark.default_cases(5)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", few(range(5200, 5205), 2))
def test_products_and_matrices_are_those_of_the_definition(seed, kind, device):
    check_definition(seed, kind, device)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(5300, 5340))
def test_more_products_and_matrices_are_those_of_the_definition(seed, kind, device):
    check_definition(seed, kind, device)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [5403, 5404])
def test_solutions_are_those_of_the_matrix(seed, kind, device):
    stencil = drawn([seed, 9], kind)
    b = np.random.default_rng(seed).standard_normal(stencil.cells.shape)
    result = wl.solve(
        wl.LCP(stencil.operator(device), b, -np.inf, np.inf),
        stopping=wl.StoppingCriteria(rtol=1e-10),
    )
    assert result
    same(
        result.x.numpy()[stencil.inside],
        np.linalg.solve(stencil.matrix(), -b[stencil.inside]),
        kind,
    )


def test_sides_towards_solid_and_air_have_the_coefficients_given(device):
    """Coefficients of sides towards SOLID and AIR.

    Between the two cells the coefficients are equal, so that A is symmetric; at the sides they are
    not.
    """
    coefficients = {
        (0, 0): np.full((1, 2), 20.0),
        (0, 1): np.array([[-1.0, -5.0]]),
        (0, -1): np.array([[-3.0, -1.0]]),
    }
    options = {"device": device, "dtype": wp.float64}
    closed = wl.Stencil(np.ones((1, 2), dtype=int), coefficients, **options)
    assert closed.symmetric
    np.testing.assert_array_equal(closed.diagonal().numpy(), [[17.0, 15.0]])
    term = wl.Stencil(
        np.ones((1, 2), dtype=int), coefficients, outside=wl.AIR, **options
    ).boundary_term(np.pad([[0.0, 0.0]], 1, constant_values=2.0))
    np.testing.assert_array_equal(term.numpy(), [[-6.0, -10.0]])


def test_a_periodic_axis_of_one_cell_is_beside_itself(device):
    given = {(0, 0): 9.0, (1, 0): -1.0, (1, 1): -2.0, (0, 1): -3.0}
    A = wl.Stencil(
        np.ones((1, 3), dtype=int),
        given,
        periodic=(False, True),
        outside=wl.AIR,
        device=device,
        dtype=wp.float64,
    )
    np.testing.assert_array_equal(grid_matrix(A).toarray(), [[8, -5, 0], [0, 8, -5], [0, 0, 8]])


def test_other_cells_may_make_a_stencil_unsymmetric(device):
    """Other cells that make a stencil unsymmetric.

    A pair of cells has two coefficients; one of them is SOLID at first.
    """
    right, left = np.full((1, 3), -1.0), np.full((1, 3), -1.0)
    right[0, 1] = -2.0
    cells = np.array([[wl.FLUID, wl.FLUID, wl.SOLID]])
    A = wl.Stencil(
        cells,
        {(0, 0): 6.0, (0, 1): right, (0, -1): left},
        outside=wl.AIR,
        device=device,
        dtype=wp.float64,
    )
    assert A.symmetric
    np.testing.assert_array_equal(grid_matrix(A).toarray(), [[6, -1], [-1, 4]])
    changed(A, np.ones((1, 3), dtype=int))
    assert not A.symmetric
    np.testing.assert_array_equal(grid_matrix(A).toarray(), [[6, -1, 0], [-1, 6, -2], [0, -1, 6]])


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("periodic", [False, True])
def test_sides_across_a_periodic_end_count_for_symmetry(axis, periodic, device):
    """Sides across a periodic end, in the test of symmetry.

    The coefficient of the first cell toward the last is not that of the last toward the first.
    """
    shape, step = ((3, 2), (2, 3))[axis], ((1, 0), (0, 1))[axis]
    lower = np.full(shape, -1.0)
    lower[(0, slice(None)) if axis == 0 else (slice(None), 0)] = -2.0
    given = {(0, 0): 6.0, step: np.full(shape, -1.0), (-step[0], -step[1]): lower}
    wraps = (periodic and axis == 1, periodic and axis == 0)
    A = wl.Stencil(
        np.ones(shape, dtype=int),
        given,
        periodic=wraps,
        outside=wl.AIR,
        device=device,
        dtype=wp.float64,
    )
    matrix = grid_matrix(A).toarray()
    assert A.symmetric == (not periodic) == np.array_equal(matrix, matrix.T)
    assert np.count_nonzero(matrix == -2.0) == 2 * periodic


def test_the_five_point_stencil_is_grid_poisson(device):
    cells = np.random.default_rng(17).choice([wl.AIR, wl.FLUID, wl.FLUID, wl.SOLID], (9, 14))
    five = {(0, 0): 4.0, (0, 1): -1.0, (0, -1): -1.0, (1, 0): -1.0, (-1, 0): -1.0}
    A, G = (
        wl.Stencil(cells, five, shift=0.5, device=device),
        wl.GridPoisson(cells, shift=0.5, device=device),
    )
    np.testing.assert_array_equal(grid_matrix(A).toarray(), grid_matrix(G).toarray())
    assert A.symmetric


def test_an_array_of_numbers_has_the_center_in_the_middle(device):
    A = wl.Stencil(
        np.ones((3, 4), dtype=int),
        np.array([[0, 0, 0], [-2, 9, -1], [0, -3, 0]]),
        outside=wl.AIR,
        device=device,
    )
    x = wp.array([[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=wp.float64, device=device)
    np.testing.assert_array_equal(A.apply(x).numpy(), [[0, -3, 0, 0], [-1, 9, -2, 0], [0, 0, 0, 0]])


def test_boundary_values_are_a_term_of_b(device):
    """Boundary values as a term of b.

    With x = g in AIR the rows are those of a larger grid with a given border.
    """
    rng = np.random.default_rng(5)
    g, full = rng.standard_normal((7, 8)), np.ones((7, 8), dtype=int)
    large = wl.Stencil(full, NINE, outside=wl.AIR, device=device, dtype=wp.float64)
    A = wl.Stencil(
        np.ones((5, 6), dtype=int), NINE, outside=wl.AIR, device=device, dtype=wp.float64
    )
    inner = wp.array(np.ascontiguousarray(g[1:-1, 1:-1]), dtype=wp.float64, device=device)
    expected = large.apply(wp.array(g, dtype=wp.float64, device=device)).numpy()[1:-1, 1:-1]
    np.testing.assert_allclose(
        A.apply(inner).numpy() + A.boundary_term(g).numpy(), expected, atol=1e-13
    )
    with pytest.raises(
        ValueError, match=r"values has shape \(5, 7\): expected \(5, 6\) or \(7, 8\)"
    ):
        A.boundary_term(np.zeros((5, 7)))


def test_a_stored_stencil_has_the_diagonal_that_it_is_given(device):
    """Stencil of stored fields: the unit of a diagonal of numbers is 1."""
    rng, cells = np.random.default_rng(6), np.ones((5, 6), dtype=int)
    stored = np.zeros((1 + 2, 5 + 2, 6 + 2))
    stored[1, 1:-1, 1:-1] = d = rng.uniform(4.0, 5.0, cells.shape)
    field = wp.array(stored.ravel(), dtype=wp.float64, device=device)
    A = StoredStencil(cells, field, (1.0, 1.0, 0.0), None, symmetric=True)
    x = rng.standard_normal(cells.shape)
    around = sum(
        np.pad(x, 1)[1 + j : 6 + j, 1 + i : 7 + i] for j, i in ((0, 1), (0, -1), (1, 0), (-1, 0))
    )
    np.testing.assert_allclose(
        A.apply(wp.array(x, dtype=wp.float64, device=device)).numpy(), d * x - around, atol=1e-13
    )


def test_null_vectors_are_found_in_space(device):
    """Null vector of a closed box whose columns sum to 0: A v = 0, v > 0.

    A moves the amount c_i x_i of each cell to its neighbors, so v_i = 1 / c_i.
    """
    rng, shape = np.random.default_rng(7), (3, 4, 5)
    c = rng.uniform(0.5, 2.0, shape)
    sides = [tuple(s * (a == b) for b in range(3)) for a in range(3) for s in (-1, 1)]
    inside = np.pad(np.ones(shape), 1)
    coefficients = {}
    for o in sides:
        there = tuple(slice(1 + s, n + 1 + s) for s, n in zip(o, shape, strict=True))
        coefficients[o] = -np.pad(c, 1, constant_values=1.0)[there] * inside[there]
    coefficients[0, 0, 0] = c * sum(
        inside[tuple(slice(1 + s, n + 1 + s) for s, n in zip(o, shape, strict=True))] for o in sides
    )
    A = wl.Stencil(
        np.ones(shape, dtype=int), coefficients, outside=wl.AIR, device=device, dtype=wp.float64
    )
    v = wp.array(1.0 / c, dtype=wp.float64, device=device)
    np.testing.assert_allclose(A.apply(v).numpy(), 0.0, atol=1e-13)
    found = A.floating_components()
    assert found is not None and found.count == 1
    b = rng.standard_normal(shape)
    assert wl.solve(wl.LCP(A, b - b.mean(), -np.inf))
    assert wl.solve(wl.LCP(A, b - b.mean() + 1, -np.inf)).status is wl.SolveStatus.INFEASIBLE


def test_closed_boxes_float_and_incompatible_ones_are_infeasible(device):
    A = wl.Stencil(np.ones((8, 9), dtype=int), NINE, device=device)
    found = A.floating_components()
    assert found is not None and found.count == 1
    assert (
        wl.Stencil(
            np.ones((8, 9), dtype=int), NINE, outside=wl.AIR, device=device
        ).floating_components()
        is None
    )
    b = np.random.default_rng(3).standard_normal((8, 9))
    assert wl.solve(wl.LCP(A, b - b.mean(), -np.inf))
    assert wl.solve(wl.LCP(A, b - b.mean() + 1, -np.inf)).status is wl.SolveStatus.INFEASIBLE


def test_cells_change_in_place(device):
    A = wl.Stencil(np.ones((6, 7), dtype=int), NINE, outside=wl.AIR, device=device)
    cells = np.full((1, 6, 7), wl.FLUID, dtype=np.int8)
    cells[0, 2, 3], cells[0, 4, :2] = wl.SOLID, wl.AIR
    padded = np.pad(cells, 1)
    A.update(wp.array(padded, device=device))
    again = wl.Stencil(cells[0], NINE, outside=wl.AIR, device=device)
    np.testing.assert_array_equal(grid_matrix(A).toarray(), grid_matrix(again).toarray())


def test_pickles_and_copies_are_the_same(device):
    A = drawn([53, 9]).operator(device, wp.float32)
    for twin in (pickle.loads(pickle.dumps(A)), copy.deepcopy(A)):
        np.testing.assert_array_equal(grid_matrix(twin).toarray(), grid_matrix(A).toarray())


@pytest.mark.parametrize(
    ("coefficients", "options", "message"),
    [
        ({(0, 0): 1.0, (0, 2): 1.0}, {}, r"offset \(0, 2\): expected \(dy, dx\), each -1, 0 or 1"),
        ({(0, 0): 1.0, (0, 0, 1): 1.0}, {}, r"offset \(0, 0, 1\): expected \(dy, dx\)"),
        ({(0, 1): -1.0}, {}, r"the center, offset \(0, 0\), is missing"),
        (
            {(0, 0): np.ones((2, 3))},
            {},
            r"coefficients\[\(0, 0\)\] has shape \(2, 3\): expected a number or \(4, 5\)",
        ),
        ({(0, 0): np.nan}, {}, "not finite"),
        (
            {(0, 0): 1.0, (0, 1): -2.0},
            {},
            r"the diagonal of cell \(0, 4\) is -1, with its closed sides: must be > 0",
        ),
        (
            np.zeros((3, 4)),
            {},
            r"coefficients has shape \(3, 4\): expected \(3, 3\), or a mapping by offset",
        ),
        (
            {(0, 0): rising, (0, 1): np.ones((4, 5))},
            {},
            "arrays and Warp functions cannot be combined",
        ),
        (
            {(0, 0): rising_in_space},
            {},
            "rising_in_space takes 3 arguments: expected the 2 indices of a cell",
        ),
        (NINE, {"outside": 7}, "outside = 7: allowed are wl.AIR = 0 and wl.SOLID = 2"),
        (NINE, {"shift": -1.0}, "shift holds a negative value"),
    ],
)
def test_wrong_arguments_are_named(coefficients, options, message):
    with pytest.raises(ValueError, match=message):
        wl.Stencil(np.ones((4, 5), dtype=int), coefficients, device="cpu", **options)
