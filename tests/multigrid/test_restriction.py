"""Restricted residuals of compact stencils against plain loops over cells.

The rows of an aggregate lie apart in memory: the weights of each must be those of its own row.
"""

import itertools

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from drawn_stencils import FUNCTIONS
from warp_lcp.multigrid import CycleSettings, Hierarchy
from warp_lcp.multigrid.cycle import Leg

SHAPES = [(6, 7, 10), (5, 8, 37), (9, 14)]
KINDS = ("arrays", "symmetric arrays", "functions")


def drawn(shape, kind, rng):
    """Return cells, coefficients for `wl.Stencil`, and arrays with the same numbers.

    Coefficients differ from cell to cell. Neighbors differ along at most two axes.
    """
    dimension = len(shape)
    cells = np.where(rng.random(shape) < 0.1, wl.AIR, wl.FLUID)
    offsets = [
        offset
        for offset in itertools.product((-1, 0, 1), repeat=dimension)
        if 0 < sum(map(abs, offset)) <= 2
    ]
    center = (0,) * dimension
    if kind == "functions":
        at_center, plain_center, beside, plain_beside = FUNCTIONS[dimension]
        places = np.indices(shape)
        given = dict.fromkeys(offsets, beside) | {center: at_center}
        arrays = dict.fromkeys(offsets, plain_beside(*places)) | {center: plain_center(*places)}
        return cells, given, {o: np.broadcast_to(a, shape) for o, a in arrays.items()}
    arrays = {offset: -rng.uniform(0.1, 1.0, shape) for offset in offsets}
    if kind.startswith("symmetric"):  # a_o(i) = a_-o(i + o)
        for offset in (o for o in offsets if o > center):
            back = tuple(-step for step in offset)
            arrays[back] = np.roll(arrays[offset], offset, axis=range(dimension))
    arrays[center] = 1.0 - sum(arrays.values())
    return cells, arrays, arrays


def residual_by_loop(cells, arrays, x, b):
    """Return b - A x on FLUID cells, 0 elsewhere: a loop over cells and offsets."""
    r = np.zeros(cells.shape)
    for cell in np.ndindex(cells.shape):
        if cells[cell] != wl.FLUID:
            continue
        r[cell] = b[cell]
        for offset, a in arrays.items():
            other = tuple(np.add(cell, offset))
            within = all(0 <= n < most for n, most in zip(other, cells.shape, strict=True))
            if within and cells[other] == wl.FLUID:
                r[cell] -= a[cell] * x[other]
    return r


def sums_by_loop(r, counts):
    """Return the sums over aggregates of 2 cells along each axis longer than one cell."""
    sums = np.zeros(counts)
    for cell in np.ndindex(r.shape):
        sums[tuple(n // 2 for n in cell)] += r[cell]
    return sums


def inner(level, field):
    """Return a level's field without ghost cells, shape (nz, ny, nx)."""
    padded = field.numpy().reshape(level.stencil.padding.shape)
    return padded[1:-1, 1:-1, 1:-1]


@pytest.mark.default_cases(9)
@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_restricted_residuals_are_those_of_a_loop(shape, kind, fused, device):
    """Restriction launched alone, and as the last stage of the descending leg of a cycle."""
    rng = np.random.default_rng(311)
    cells, given, arrays = drawn(shape, kind, rng)
    A = wl.Stencil(cells, given, outside=wl.AIR, device=device, dtype=wp.float64)
    assert A.symmetric == kind.startswith("symmetric")
    apart = CycleSettings(one_launch_cpu=0, one_launch_cuda=0)
    hierarchy = Hierarchy(A.stencil, wp.float64, bounded=False, settings=apart)
    inside = (cells == wl.FLUID).astype(np.uint8)
    hierarchy.mask_diagonal(A.stencil.d, A.layout.load(inside, wp.uint8))
    hierarchy.rebuild()
    fine, coarse = hierarchy.levels[:2]
    fine.x.assign(A.layout.load(rng.standard_normal(shape) * inside, wp.float64))
    fine.b.assign(A.layout.load(rng.standard_normal(shape) * inside, wp.float64))
    if fused:
        stages = fine.descend(coarse, projected=False, from_zero=False)
        assert ([type(stage) for stage in stages] == [Leg]) == fine.fuses  # as on all CPUs
    else:
        stages = (fine.restrict_kernel(coarse),)
    for stage in stages:
        stage.launch()
    x, b = (inner(fine, field).reshape(shape) for field in (fine.x, fine.b))
    expected = sums_by_loop(residual_by_loop(cells, arrays, x, b), [-(-n // 2) for n in shape])
    found = inner(coarse, coarse.b).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert np.abs(expected).max() > 1.0


@pytest.mark.parametrize("symmetric", [False, True])
def test_coarser_levels_restrict_with_the_weights_of_each_row(symmetric, device):
    """Restriction of a level whose weights are stored: a loop over these."""
    rng = np.random.default_rng(313)
    shape = (12, 10, 14)
    cells, given, _ = drawn(shape, "symmetric arrays" if symmetric else "arrays", rng)
    A = wl.Stencil(cells, given, outside=wl.AIR, device=device, dtype=wp.float64)
    hierarchy = Hierarchy(A.stencil, wp.float64, bounded=False)
    inside = (cells == wl.FLUID).astype(np.uint8)
    hierarchy.mask_diagonal(A.stencil.d, A.layout.load(inside, wp.uint8))
    hierarchy.rebuild()
    fine, coarse = hierarchy.levels[1:3]
    pattern, counts = fine.stencil.pattern, fine.stencil.padding.counts
    assert pattern.symmetric == symmetric
    d = inner(fine, fine.stencil.d) * fine.stencil.unit
    arrays = {(0, 0, 0): d}
    for (x, y, z), weights in zip(pattern.offsets, fine.stencil.weights, strict=True):
        w = weights.numpy().reshape(fine.stencil.padding.shape)
        arrays[z, y, x] = -w[1:-1, 1:-1, 1:-1]
        if symmetric:  # the weight of the pair stands at the later cell
            arrays[-z, -y, -x] = -np.roll(w, (z, y, x), axis=(0, 1, 2))[1:-1, 1:-1, 1:-1]
    for field in (fine.x, fine.b):
        values = rng.standard_normal(counts) * (d != 0)
        field.assign(np.pad(values, 1).ravel())
    fine.restrict_kernel(coarse).launch()
    x, b = inner(fine, fine.x), inner(fine, fine.b)
    level_cells = np.where(d != 0, wl.FLUID, wl.AIR)
    expected = sums_by_loop(
        residual_by_loop(level_cells, arrays, x, b), coarse.stencil.padding.counts
    )
    found = inner(coarse, coarse.b)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
