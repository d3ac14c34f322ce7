"""Quad passes, four cells of a row per thread, against single cells.

They run as on CUDA, with the plug-in `emulated_cuda` only.
"""

import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.kernels import Rows, rows
from warp_lcp.kernels.fields import Padding
from warp_lcp.kernels.kernel_file import KernelFile
from warp_lcp.kernels.layout import copy_of, put
from warp_lcp.multigrid import CycleSettings

EMULATED = pytest.mark.skipif(
    "emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there"
)
SEEDS = [1, 2, int(os.environ.get("SEED", "3414447061"))]  # SEED=... draws other grids
# Widths of rows: full quads alone, with some cells left, and none.
WIDTHS = (1, 2, 3, 4, 5, 7, 8, 11, 13, 18, 30)


@pytest.fixture(params=[1, 1 << 18], ids=["blocks", "single loads"])
def checked(monkeypatch, request):
    """Run each quad pass by cells as well.

    Return the counts of launches and of differences.
    """
    from benchmarks import emulated_cuda

    monkeypatch.setattr(rows, "MANY_CELLS_OF_BLOCKS", request.param)
    rows._flat.cache_clear()
    monkeypatch.setattr(
        emulated_cuda.context,
        "invoke",
        emulated_cuda.checked_by_cells(emulated_cuda.context.invoke),
    )
    emulated_cuda.otherwise.clear()
    emulated_cuda.launched_by_cells.clear()
    yield emulated_cuda.launched_by_cells, emulated_cuda.otherwise
    emulated_cuda.otherwise.clear()
    rows._flat.cache_clear()


def drawn_problem(seed):
    """Return a problem on a grid of an odd width.

    With random periodic sides, holes, spans or fields of coefficients.
    """
    rng = np.random.default_rng(seed)
    shape = (*rng.integers(2, 7, 2), rng.choice(WIDTHS))
    cells = np.where(rng.random(shape) < 0.85, wl.FLUID, rng.choice([wl.SOLID, wl.AIR], shape))
    if rng.random() < 0.5:  # rows that begin and end within the grid, and some without cells
        cells[:, :, : rng.integers(0, shape[2])] = wl.SOLID
        cells[rng.integers(shape[0])] = wl.SOLID
    cells[0, 0, -1] = wl.FLUID
    periodic = tuple(bool(v) for v in rng.random(3) < 0.4)
    faces = {}
    if rng.random() < 0.5:
        for axis, name in enumerate(("face_z", "face_y", "face_x")):
            face = rng.uniform(0.2, 2, [n + (a == axis) for a, n in enumerate(shape)])
            if periodic[2 - axis]:
                first, last = ([slice(None)] * 3 for _ in range(2))
                first[axis], last[axis] = slice(0, 1), slice(-1, None)
                face[tuple(last)] = face[tuple(first)]
            faces[name] = face
    A = wl.GridPoisson(cells, periodic=periodic, shift=0.1, device="cpu", **faces)
    b, fluid = rng.standard_normal(shape), cells == wl.FLUID
    lower = rng.choice([0.0, -np.inf], shape) if rng.random() < 0.5 else rng.uniform(-1, 0, shape)
    upper = np.inf if rng.random() < 0.5 else rng.uniform(0.1, 1, shape)
    return wl.LCP(A, np.where(fluid, b, 0.0), lower, upper)


@EMULATED
@pytest.mark.parametrize("seed", SEEDS)
def test_fields_have_the_bits_of_a_thread_a_cell(seed, checked):
    launched, otherwise = checked
    problem = drawn_problem(seed)
    stopping = wl.StoppingCriteria(rtol=1e-6, max_iterations=8)
    # Small levels launch by launch, transfers too.
    cycle = CycleSettings(one_launch_cuda=0, coarsest_cuda=2)
    multigrid = (wl.ProjectedMultigrid(), wl.ProjectedMultigrid(cycle=cycle))
    for method in (
        *multigrid,
        wl.MinimumMapNewton(),
        wl.InteriorPoint(),
        wl.AcceleratedProjectedGradient(),
    ):
        wl.solve(problem, method, stopping=stopping)
    assert sorted(+otherwise) == [], f"SEED={seed}"
    names = {name.split()[0] for name in launched}
    assert names >= {
        "cycle.sweep",
        "cycle.restrict",
        "projected_multigrid.assess",
        "residual.natural",
    }, f"SEED={seed}"


HEADER = """// Kernels of a test.

// kernel quads.whole: Sums of whole numbers, the largest, and what neighbors have
//   compute    float64
//   reads      float64 x, y?
//   writes     float64 z
//   by_row     uint8 changed
//   sums       total, products
//   largest    most
double products = 0, most = -1e300; int total = 0;
for (int k = 0; k < n; ++k) {
    total += (int)x[k]; products += x[k]*(y ? y[k] : 1.0); most = x[k] > most ? x[k] : most;
    z[k] = x[k-1] + 10*x[k+1] + 100*x[k+ym] + 1000*(x + yp)[k] \
+ 10000*(x + zm)[k] + 100000*x[k+zp]; }
for (int k = 0; k < n; ++k) if (z[k] > 700000) { z[k] = -z[k]; changed[P.row] = 1; }
"""


@EMULATED
@pytest.mark.parametrize("seed", SEEDS)
def test_sums_of_whole_numbers_are_equal(seed, tmp_path, checked):
    """Such sums are exact in every order: no cell is left out, and none counts twice."""
    (tmp_path / "quads.h").write_text(HEADER)
    kernel, rng, device = (
        KernelFile(tmp_path / "quads.h")["quads.whole"],
        np.random.default_rng(seed),
        wp.get_device("cpu"),
    )
    for width in WIDTHS:
        shape = (int(rng.integers(1, 40)), int(rng.integers(1, 5)), int(width))
        padding = Padding(shape)
        spans = None
        if rng.random() < 0.7:
            ends = np.sort(rng.integers(0, width + 1, (*shape[:2], 2)), axis=2)
            spans = wp.array(ends, dtype=wp.vec2i, device=device)
        rows = Rows.of(padding, device, spans)
        x, y = (
            wp.array(rng.integers(-9, 10, padding.size).astype(float), device=device)
            for _ in range(2)
        )
        y = y if rng.random() < 0.5 else None
        cells = replace(rows, quads=None, summed=put(copy_of(rows.single), {"slab": 5}))
        assert rows.quads is not None
        assert rows.places < cells.places or width < 4
        found = []
        for there in (rows, cells):
            z, changed = wp.full_like(x, -7.0), wp.zeros(shape[:2], dtype=wp.uint8, device=device)
            out = wp.full(3 * there.places, -1e9, dtype=wp.float64, device=device)
            bound = kernel.bind(there, x=x, y=y, z=z, changed=changed.flatten(), out=out)
            assert (bound.form.quads is not None) == (there is rows)
            bound.launch()
            sums = out.numpy().reshape(3, -1)
            found.append(
                (
                    z.numpy().tobytes(),
                    changed.numpy().tobytes(),
                    *sums[:2].sum(axis=1),
                    sums[2].max(),
                )
            )
        assert found[0] == found[1], f"SEED={seed}"


PLAIN = """// Kernels of a test.

// kernel quads.doubled: Twice the values of the cells
//   compute    float64
//   reads      float64 x
//   writes     float64 z
for (int k = 0; k < n; ++k) z[k] = 2 * x[k];
"""


@EMULATED
@pytest.mark.parametrize("first", range(4))
def test_rows_at_any_place_of_a_block_are_written_whole(first, checked, device, tmp_path):
    """Fields whose rows begin `first` elements after a multiple of four."""
    (tmp_path / "doubled.h").write_text(PLAIN)
    rng, counts, (plane, row) = np.random.default_rng(661), (3, 4, 19), (96, 24)
    x = rng.integers(-9, 10, 3 * plane).astype(float)
    rows = Rows.strided(x.size, wp.get_device(device), (first, plane, row), counts, quads=True)
    assert rows.quads is not None
    z = wp.full(x.size, -7.0, dtype=wp.float64, device=device)
    KernelFile(tmp_path / "doubled.h")["quads.doubled"].bind(
        rows, x=wp.array(x, device=device), z=z
    ).launch()
    k, j, i = np.indices(counts)
    inside = (first + k * plane + j * row + i).ravel()
    expected = np.full(x.size, -7.0)
    expected[inside] = 2.0 * x[inside]
    np.testing.assert_array_equal(z.numpy(), expected)
