"""`wl.Stencil` against matrices that NumPy assembles cell by cell."""

import copy
import itertools
import pickle

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.operators.grid_matrix import grid_matrix


@wp.func
def rising(j: int, i: int):
    return 40.0 + float(i) * 0.5 + float(j)


@wp.func
def falling(j: int, i: int):
    return -1.0 - float(j) * 0.25


@wp.func
def rising_in_space(k: int, j: int, i: int):
    return 80.0 + float(i) * 0.5 + float(k)


@wp.func
def falling_in_space(k: int, j: int, i: int):
    return -1.0 - float(j) * 0.25 - float(k)


FUNCTIONS = {
    2: (rising, lambda j, i: 40 + 0.5 * i + j, falling, lambda j, i: -1 - 0.25 * j),
    3: (rising_in_space, lambda k, j, i: 80 + 0.5 * i + k, falling_in_space, lambda k, j, i: -1 - 0.25 * j - k),
}
NINE = np.array([[-1.0, -4.0, -1.0], [-4.0, 20.0, -4.0], [-1.0, -4.0, -1.0]]) / 6


def assembled(cells, coefficients, shift, periodic, outside):
    """The matrix on the FLUID cells, row by row from the definition."""
    n, number = cells.ndim, {tuple(c): q for q, c in enumerate(np.argwhere(cells == wl.FLUID))}
    A = np.zeros((len(number), len(number)))
    for cell, q in number.items():
        for offset, a in coefficients.items():
            value = a(*cell) if callable(a) else np.broadcast_to(a, cells.shape)[cell]
            there, kind = list(np.add(cell, offset)), None
            for axis in range(n):
                if not 0 <= there[axis] < cells.shape[axis]:
                    there[axis], kind = (there[axis] % cells.shape[axis], kind) if periodic[n - 1 - axis] else (0, outside)
            kind = cells[tuple(there)] if kind is None else kind
            if kind == wl.FLUID:
                A[q, number[tuple(there)]] += value
            elif kind == wl.SOLID:
                A[q, q] += value
        A[q, q] += 0 if shift is None else shift[cell]
    return A


def drawn(seed):
    """Cells, coefficients as users give them and as NumPy evaluates them, shift, periodic axes, what lies outside."""
    rng = np.random.default_rng(seed)
    n, kind = int(rng.integers(2, 4)), rng.choice(["numbers", "arrays", "symmetric", "functions"])
    shape = tuple(int(v) for v in rng.integers(3, 7, n))
    cells = rng.choice([wl.AIR, wl.FLUID, wl.FLUID, wl.FLUID, wl.SOLID], shape)
    cells.flat[0] = wl.FLUID
    given = {(0,) * n: 60.0}
    for offset in itertools.product((-1, 0, 1), repeat=n):
        if offset != (0,) * n and rng.random() < 0.7:
            given[offset] = -rng.random(shape if kind == "arrays" else ())
    if kind == "symmetric":
        given = {o: given.get(max(o, tuple(-s for s in o)), 0.0) for o in given}
    plain = dict(given)
    if kind == "functions":
        for offset in list(given)[:3]:
            pick = 0 if offset == (0,) * n else 2
            given[offset], plain[offset] = FUNCTIONS[n][pick : pick + 2]
    shift = rng.random(shape) if rng.random() < 0.5 else None
    return cells, given, plain, shift, tuple(rng.random(3) < 0.3), int(rng.choice([wl.AIR, wl.SOLID]))


@pytest.mark.parametrize("seed", range(41, 65))
def test_products_and_matrices_are_those_of_the_definition(seed, device):
    cells, given, plain, shift, periodic, outside = drawn(seed)
    A = wl.Stencil(cells, given, shift=shift, periodic=periodic, outside=outside, device=device, dtype=wp.float64)
    expected, inside = assembled(cells, plain, shift, periodic, outside), cells == wl.FLUID
    x = np.random.default_rng(seed).standard_normal(cells.shape)
    field = wp.array(x, dtype=wp.float64, device=device)
    within = {"atol": 1e-5 if any(callable(a) for a in plain.values()) else 1e-12, "rtol": 0}  # functions compute in float32
    np.testing.assert_allclose(A.apply(field).numpy()[inside], expected @ x[inside], **within)
    np.testing.assert_allclose(A.apply_transpose(field).numpy()[inside], expected.T @ x[inside], **within)
    np.testing.assert_allclose(A.diagonal().numpy()[inside], expected.diagonal(), **within)
    np.testing.assert_allclose(grid_matrix(A).toarray(), expected, **within)
    assert not A.symmetric or np.allclose(expected, expected.T, atol=1e-14)
    around = [v(*np.argwhere(inside).T) if callable(v) else np.broadcast_to(v, cells.shape)[inside] for o, v in plain.items() if any(o)]
    assert A.monotone == all((np.ravel(v) <= 0).all() for v in around)


def test_the_five_point_stencil_is_grid_poisson(device):
    cells = np.random.default_rng(17).choice([wl.AIR, wl.FLUID, wl.FLUID, wl.SOLID], (9, 14))
    five = {(0, 0): 4.0, (0, 1): -1.0, (0, -1): -1.0, (1, 0): -1.0, (-1, 0): -1.0}
    A, G = wl.Stencil(cells, five, shift=0.5, device=device), wl.GridPoisson(cells, shift=0.5, device=device)
    np.testing.assert_array_equal(grid_matrix(A).toarray(), grid_matrix(G).toarray())
    assert A.symmetric


def test_an_array_of_numbers_has_the_center_in_the_middle(device):
    A = wl.Stencil(np.ones((3, 4), dtype=int), np.array([[0, 0, 0], [-2, 9, -1], [0, -3, 0]]), outside=wl.AIR, device=device)
    x = wp.array([[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=wp.float64, device=device)
    np.testing.assert_array_equal(A.apply(x).numpy(), [[0, -3, 0, 0], [-1, 9, -2, 0], [0, 0, 0, 0]])


def test_boundary_values_are_a_term_of_b(device):
    """With x = g in AIR the rows are those of a larger grid whose border is given."""
    rng = np.random.default_rng(5)
    g, full = rng.standard_normal((7, 8)), np.ones((7, 8), dtype=int)
    large = wl.Stencil(full, NINE, outside=wl.AIR, device=device, dtype=wp.float64)
    A = wl.Stencil(np.ones((5, 6), dtype=int), NINE, outside=wl.AIR, device=device, dtype=wp.float64)
    inner = wp.array(np.ascontiguousarray(g[1:-1, 1:-1]), dtype=wp.float64, device=device)
    expected = large.apply(wp.array(g, dtype=wp.float64, device=device)).numpy()[1:-1, 1:-1]
    np.testing.assert_allclose(A.apply(inner).numpy() + A.boundary_term(g).numpy(), expected, atol=1e-13)
    with pytest.raises(ValueError, match=r"values has shape \(5, 7\): expected \(5, 6\) or \(7, 8\)"):
        A.boundary_term(np.zeros((5, 7)))


def test_closed_boxes_float_and_incompatible_ones_are_infeasible(device):
    A = wl.Stencil(np.ones((8, 9), dtype=int), NINE, device=device)
    found = A.floating_components()
    assert found is not None and found.count == 1
    assert wl.Stencil(np.ones((8, 9), dtype=int), NINE, outside=wl.AIR, device=device).floating_components() is None
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
    cells, given, _, shift, _, outside = drawn(53)
    A = wl.Stencil(cells, given, shift=shift, outside=outside, device=device)
    for twin in (pickle.loads(pickle.dumps(A)), copy.deepcopy(A)):
        np.testing.assert_array_equal(grid_matrix(twin).toarray(), grid_matrix(A).toarray())


@pytest.mark.parametrize(
    ("coefficients", "options", "message"),
    [
        ({(0, 0): 1.0, (0, 2): 1.0}, {}, r"offset \(0, 2\): expected \(dy, dx\), each -1, 0 or 1"),
        ({(0, 0): 1.0, (0, 0, 1): 1.0}, {}, r"offset \(0, 0, 1\): expected \(dy, dx\)"),
        ({(0, 1): -1.0}, {}, r"the center, offset \(0, 0\), is missing"),
        ({(0, 0): np.ones((2, 3))}, {}, r"coefficients\[\(0, 0\)\] has shape \(2, 3\): expected a number or \(4, 5\)"),
        ({(0, 0): np.nan}, {}, "not finite"),
        ({(0, 0): 1.0, (0, 1): -2.0}, {}, r"the diagonal of cell \(0, 4\) is -1, with its closed sides: must be > 0"),
        (np.zeros((3, 4)), {}, r"coefficients has shape \(3, 4\): expected \(3, 3\), or a mapping by offset"),
        ({(0, 0): rising, (0, 1): np.ones((4, 5))}, {}, "arrays and Warp functions do not mix"),
        ({(0, 0): rising_in_space}, {}, "rising_in_space takes 3 arguments: expected the 2 indices of a cell"),
        (NINE, {"outside": 7}, "outside = 7: allowed are wl.AIR = 0 and wl.SOLID = 2"),
        (NINE, {"shift": -1.0}, "shift holds a negative value"),
    ],
)
def test_wrong_arguments_are_named(coefficients, options, message):
    with pytest.raises(ValueError, match=message):
        wl.Stencil(np.ones((4, 5), dtype=int), coefficients, device="cpu", **options)
