"""Operators from lists of cells against those from arrays; refused lists."""

import tracemalloc

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.operators import cell_lists


@pytest.mark.default_cases(12)
@pytest.mark.parametrize("shape", [(5, 4, 6), (6, 7), (1, 1, 1)])
@pytest.mark.parametrize("form", [list, np.int16, np.uint64, wp.array])
@pytest.mark.parametrize("shuffled", [False, True])
def test_lists_make_the_operator_that_the_array_makes(shape, form, shuffled, device, monkeypatch):
    monkeypatch.setattr(cell_lists, "TOGETHER", 7)
    rng = np.random.default_rng(23)
    cells = rng.integers(0, 3, shape)
    cells.flat[0] = wl.FLUID
    lists = [
        rng.permutation(np.argwhere(cells == kind)) if shuffled else np.argwhere(cells == kind)
        for kind in (wl.FLUID, wl.SOLID)
    ]
    forms = {
        list: lambda v: v.tolist(),
        wp.array: lambda v: wp.array(v.astype(np.int32), device=device),
    }
    fluid, solid = (forms.get(form, lambda v: v.astype(form))(v) for v in lists)
    options = {"face_x": rng.random((*shape[:-1], shape[-1] + 1)), "shift": 0.5, "device": device}
    A, B = (
        wl.GridPoisson.from_cells(shape, fluid, solid, **options),
        wl.GridPoisson(cells, **options),
    )
    assert A.shape == B.shape
    np.testing.assert_array_equal(A.cells.numpy(), B.cells.numpy())
    np.testing.assert_array_equal(A.stencil.d.numpy(), B.stencil.d.numpy())
    x = wp.array(rng.standard_normal(shape), dtype=wp.float64, device=device)
    np.testing.assert_array_equal(A.apply(x).numpy(), B.apply(x).numpy())


@pytest.mark.parametrize(
    ("shape", "fluid", "solid", "message"),
    [
        (
            (2, 3, 4),
            [(0, 0, 0), (1, 3, 0)],
            (),
            r"fluid\[1\] = \(1, 3, 0\): there is no such cell in a grid of shape \(2, 3, 4\)",
        ),
        ((2, 3, 4), [(0, -1, 0)], (), r"fluid\[0\] = \(0, -1, 0\): there is no such cell"),
        (
            (2, 3, 4),
            [(0, 0, 1), (0, 0, 0), (0, 0, 1)],
            (),
            r"fluid\[2\] = \(0, 0, 1\): the cell is in the list twice",
        ),
        (
            (2, 3, 4),
            [(0, 0, 0)] * 9,
            (),
            r"fluid\[1\] = \(0, 0, 0\): the cell is in the list twice",
        ),
        (
            (2, 3, 4),
            [(0, 0, 1)],
            [(0, 0, 0), (0, 0, 1)],
            r"solid\[1\] = \(0, 0, 1\): the cell is in both lists",
        ),
        (
            (2, 3, 4),
            [(0, 0)],
            (),
            r"fluid has shape \(1, 2\) and type int64: expected integers, shape \(n, 3\), a row "
            r"\(k, j, i\)",
        ),
        (
            (3, 4),
            [(0.0, 0.0)],
            (),
            r"fluid has shape \(1, 2\) and type float64: expected integers, shape \(n, 2\), a row "
            r"\(j, i\)",
        ),
        ((3, 4), [(0, 0)], [7], r"solid has shape \(1,\)"),
        ((3,), [(0,)], (), r"shape = \(3,\): expected \(nz, ny, nx\) or \(ny, nx\)"),
        ((3, 0), (), (), r"shape = \(3, 0\)"),
        ((3, 4.0), (), (), r"shape = \(3, 4.0\)"),
    ],
)
def test_bad_lists_are_named(shape, fluid, solid, message, monkeypatch):
    monkeypatch.setattr(cell_lists, "TOGETHER", 4)
    with pytest.raises(ValueError, match=message):
        wl.GridPoisson.from_cells(shape, fluid, solid, device="cpu")


def test_lists_take_no_more_memory_than_a_byte_a_cell_and_their_parts(monkeypatch):
    monkeypatch.setattr(cell_lists, "TOGETHER", 1000)
    shape, fluid = (
        (100, 100, 100),
        np.stack(np.unravel_index(np.arange(200_000), (100, 100, 100)), axis=1).astype(np.int32),
    )
    tracemalloc.start()
    cell_lists.cells_of(shape, fluid, ())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000 + 200_000
