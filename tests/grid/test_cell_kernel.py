# mypy: ignore-errors
"""Kernels of cells and row segments, and box passes, against NumPy."""

from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_lcp.grid.cell_kernel import F32, cell_below, cell_kernel, spline
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.kernels import Rows, StencilKernel

GRID = StaggeredGrid((5, 4, 3), 1.0, 3)
WINDOW = GRID.window((2, 1, 2), (4, 3, 3))  # stored cells 2 <= k < 4, 1 <= j < 4, 2 <= i < 5


@cell_kernel("tests.cell_kernel")
def mark_kernel(k, j, i, factor: float, out: F32):
    """Write the position of a cell."""
    if i != 3:  # a comment
        out[k, j, i] = factor * float(100 * k + 10 * j + i)


@cell_kernel("tests.cell_kernel")
def sum_kernel(row, chunk, k, j, first, end, field: F32, out: F32):
    """Write the sum of a row, and its number."""
    total = float(0.0)
    for i in range(first, end):
        total += field[k, j, i]
    out[k, j, 0] = total + 1000.0 * float(row) + 1.0e6 * float(chunk)


@cell_kernel("tests.cell_kernel")
def below_kernel(k, j, i, axis: int, out: F32):
    c, b, a = cell_below(axis, k, j, i)
    out[k, j, i] = float(100 * c + 10 * b + a)


def places(factor: float = 1.0) -> np.ndarray:
    k, j, i = np.indices(GRID.shape)
    return factor * (100 * k + 10 * j + i)


def inside(of: np.ndarray) -> np.ndarray:
    return of[2:4, 1:4, 2:5]


def test_a_kernel_of_a_cell_visits_those_of_a_window_and_no_other() -> None:
    out = GRID.field()
    WINDOW.launch(mark_kernel, [0.5, out])
    expected = np.zeros(GRID.shape)
    inside(expected)[...] = inside(places(0.5))
    expected[..., 3] = 0.0
    np.testing.assert_array_equal(out.numpy(), expected)


def test_a_kernel_of_a_piece_has_a_whole_row() -> None:
    field, out = wp.array(places(), dtype=wp.float32, device="cpu"), GRID.field()
    WINDOW.launch_rows(sum_kernel, [field, out])
    np.testing.assert_array_equal(
        out.numpy()[2:4, 1:4, 0], inside(places()).sum(axis=2) + 1000 * np.arange(3)
    )


@pytest.mark.parametrize("axis", range(3))
def test_the_cell_below_stays_in_the_array(axis: int) -> None:
    out = GRID.field()
    GRID.everywhere.launch(below_kernel, [axis, out])
    step = np.zeros(3, dtype=int)
    step[2 - axis] = 1
    below = np.maximum(np.indices(GRID.shape) - step[:, None, None, None], 0)
    np.testing.assert_array_equal(out.numpy(), np.tensordot([100, 10, 1], below, axes=1))


@pytest.fixture(scope="module")
def box_pass(tmp_path_factory) -> StencilKernel:
    header = tmp_path_factory.mktemp("headers") / "box.h"
    header.write_text(
        "double total = 0; const int n = 7;\n"  # a name in the pass itself
        "for (int i = first; i < last; ++i) { y[i] = (T)(SCALE*(x[i] + (z ? z[i - s1 - s2] : "
        "(T)n))); total += y[i]; }\n"
        "sums[P.row] = total;\n"
    )
    real = wp.float32
    fields, sums = {"x": real, "y": real, "z": real}, {"sums": wp.float64}
    return StencilKernel(
        "tests.boxes.scaled",
        header,
        real,
        box=fields,
        by_row=sums,
        optional=("z",),
        constants={"SCALE": 0.5},
    )


@pytest.mark.cpu_form("threads take whole rows on the CPU")
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("given", [False, True])
def test_a_pass_over_a_box(box_pass: StencilKernel, whole: bool, given: bool) -> None:
    x, y = wp.array(places(), dtype=wp.float32, device="cpu"), GRID.field()
    sums = wp.zeros(6, dtype=wp.float64, device="cpu")
    WINDOW.run(box_pass, whole=whole, x=x, y=y, z=x if given else None, sums=sums)
    expected = np.zeros(GRID.shape)
    inside(expected)[...] = 0.5 * inside(places() + (places() - 110 if given else 7))
    np.testing.assert_array_equal(y.numpy(), expected)
    np.testing.assert_array_equal(sums.numpy(), inside(expected).sum(axis=2).ravel())


@pytest.mark.cpu_form("threads take whole rows on the CPU")
def test_threads_share_a_row_of_a_box_unless_it_is_whole(box_pass: StencilKernel) -> None:
    rows, fields = (
        Rows.box(WINDOW.low, WINDOW.high, GRID.device),
        {"x": GRID.field(), "y": GRID.field(), "z": None},
    )
    assert (
        Rows.box(WINDOW.low, WINDOW.high, GRID.device, cells=10**6).single.chunks
        == rows.single.chunks
        == 1
    )
    chunks = Rows.box(WINDOW.low, WINDOW.high, GRID.device, cells=2)
    fields["x"].fill_(1.0)
    box_pass.bind(chunks, **fields, sums=wp.zeros(6, dtype=wp.float64, device="cpu")).launch()
    assert (inside(fields["y"].numpy()) == 4.0).all()
    assert fields["y"].numpy().sum() == 4.0 * 18


def test_errors_of_an_invalid_box_are_clear(box_pass: StencilKernel) -> None:
    x, sums = GRID.field(), wp.zeros(6, dtype=wp.float64, device="cpu")
    with pytest.raises(
        ValueError, match=r"tests.boxes.scaled: fields have the shapes \(5, 6, 6\), \(5, 6, 7\)"
    ):
        WINDOW.run(
            box_pass, x=x, y=wp.zeros((5, 6, 6), dtype=wp.float32, device="cpu"), z=None, sums=sums
        )
    with pytest.raises(TypeError, match="y is NoneType, not an array of float32"):
        WINDOW.run(box_pass, x=x, y=None, z=None, sums=sums)
    with pytest.raises(TypeError, match=r"missing \['sums'\], unknown \['SCALE'\]"):
        WINDOW.run(box_pass, x=x, y=x, z=x, SCALE=1)
    with pytest.raises(ValueError, match="sums has 5 elements, not 6"):
        WINDOW.run(box_pass, x=x, y=x, z=x, sums=sums[:5])


def test_a_pass_over_listed_cells_sees_them_as_in_their_rows(tmp_path: Path) -> None:
    """Pass over listed cells: same view as in their rows.

    Pointers are those of a box, into the first layer of a field with several; cells that are not
    listed keep their value.
    """
    header = tmp_path / "mark.h"
    header.write_text(
        "for (int i = first; i < last; ++i) y[i + s1*given.x.shape[0]] = x[i] + (T)(10000*k + "
        "1000*j);\n"
    )
    fields, layers = (
        {"x": wp.float32, "y": wp.float32},
        wp.zeros((2, *GRID.shape), dtype=wp.float32, device="cpu"),
    )
    listed = StencilKernel(
        "tests.lists.mark",
        header,
        wp.float32,
        box=fields,
        whole={"cells": wp.int32},
        listed="cells",
    )
    cells = [(0, 0, 0), (1, 2, 3), (2, 3, 1)]
    flat = wp.array(
        [int(np.ravel_multi_index(cell, GRID.shape)) for cell in cells],
        dtype=wp.int32,
        device="cpu",
    )
    listed.bind(
        Rows.entries(len(cells), GRID.device),
        cells=flat,
        x=wp.array(places(), dtype=wp.float32, device="cpu"),
        y=layers,
    ).launch()
    expected = np.zeros((2, *GRID.shape))
    for k, j, i in cells:
        expected[1, k, j, i] = places()[k, j, i] + 10000 * k + 1000 * j
    np.testing.assert_array_equal(layers.numpy(), expected)


@pytest.mark.cpu_form("how many entries a thread takes")
@pytest.mark.parametrize("grain", [None, 4])
def test_a_pass_over_entries(grain: int | None, tmp_path: Path) -> None:
    """Pass over entries: a list is the row of a box, and each thread takes some of it."""
    header = tmp_path / "double.h"
    header.write_text(
        "for (int n = first; n < last; ++n) { y[n] = 2*x[n]; z[n] = last - first; }\n"
    )
    passed = StencilKernel(
        "tests.lists.double", header, wp.float32, box=dict.fromkeys("xyz", wp.float32)
    )
    x, y, z = (wp.array(np.arange(10.0), dtype=wp.float32, device="cpu") for _ in range(3))
    passed.bind(Rows.entries(10, GRID.device, grain), x=x, y=y, z=z).launch()
    np.testing.assert_array_equal(y.numpy(), 2.0 * np.arange(10))
    np.testing.assert_array_equal(z.numpy(), 10 if grain is None else [4] * 8 + [2] * 2)
    with pytest.raises(ValueError, match="fields have the shapes"):
        passed.bind(Rows.entries(10, GRID.device), x=x, y=y, z=z[:9])


@wp.kernel(enable_backward=False, module="tests.cell_kernel")
def spline_kernel(d: wp.array(dtype=float), out: wp.array(dtype=float)):
    """Evaluate the B-spline."""
    out[wp.tid()] = spline(d[wp.tid()])


def test_the_spline_is_the_convolution_of_three_boxes():
    n = 200
    box = np.full(n, 1.0 / n)
    kernel = n * np.convolve(
        np.convolve(box, box), box
    )  # from -1.5 to 1.5, centers of 3 n - 2 parts
    at = (np.arange(3 * n - 2) - 1.5 * (n - 1)) / n
    at, expected = np.r_[-2.5, at, 1.6], np.r_[0.0, kernel, 0.0]
    distances = wp.array(at, dtype=float, device="cpu")
    out = wp.zeros(at.size, dtype=float, device="cpu")
    wp.launch(spline_kernel, at.size, [distances, out], device="cpu")
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-4)
