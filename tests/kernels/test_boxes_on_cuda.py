"""Kernels over boxes as CUDA runs them: planes of a thread, segments, sums, machine code.

The results are compared with NumPy, with the plug-in `emulated_cuda` only. The machine code needs
the extra `ptxas`.
"""

import math
import os
import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks.machine_code import assemble, tools_missing
from benchmarks.machine_counts import issued
from benchmarks.machine_memory import EmulatedMemory, constants_of
from warp_lcp.kernels import Rows, StencilKernel
from warp_lcp.kernels.layout import copy_of, native_of, put, threads

EMULATED = pytest.mark.skipif(
    "emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there"
)
SEEDS = [1, 2, int(os.environ.get("SEED", "2611302"))]  # SEED=... draws other boxes
BLOCK, WARP = 256, 32
HEADER = """
int found = 0; double largest = -1e300;
for (int i = first; i < last; ++i) {
    const double v = x[i - 1] + 10*x[i + 1] + 100*x[i - s2] + 1000*x[i + s1] + (z ? z[i] : 7.0);
    y[i] = v + 0.001*(k + 100*j);
    found += (int)x[i];
    largest = v > largest ? v : largest;
}
visited[P.row] = 1;
count = found; most = largest;
"""


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> StencilKernel:
    """Return a kernel that reads neighbors, sums whole numbers and finds the largest value."""
    header = tmp_path_factory.mktemp("headers") / "marked.h"
    header.write_text(HEADER)
    return StencilKernel(
        "tests.boxes_on_cuda.marked",
        header,
        wp.float64,
        box=dict.fromkeys(("x", "y", "z"), wp.float64),
        whole={"visited": wp.uint8},
        optional=("z",),
        sums=("count",),
        largest=("most",),
    )


def field(values: np.ndarray) -> wp.array:
    return wp.array(values, dtype=wp.float64, device="cpu")


@pytest.mark.every_case
@EMULATED
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("way", ["cells", "planes", "parts", "whole", "segments"])
def test_cells_of_a_box_are_visited_once(marked: StencilKernel, way: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(5, 12, 3))
    low = tuple(int(v) for v in rng.integers(1, 3, 3))
    high = tuple(int(rng.integers(b + 1, n)) for b, n in zip(low, shape, strict=True))
    inside = np.zeros(shape, dtype=bool)
    inside[tuple(slice(*ends) for ends in zip(low, high, strict=True))] = True
    device = wp.get_device("cpu")
    rows = Rows.box(low, high, device, cells={"parts": 3, "whole": 99}.get(way), slab=1)
    if way == "planes":
        rows = Rows.box(low, high, device, slab=int(rng.integers(2, 6)))
    if way == "segments":
        inside &= rng.random(shape) < 0.4
        pieces = [
            ((k, j), (i, i + 1)) for k, j, i in np.argwhere(inside) if not inside[k, j, i - 1]
        ]
        for n, ((k, j), (i, end)) in enumerate(pieces):
            while inside[k, j, end]:
                end += 1
            pieces[n] = (k, j), (i, end)
        if not pieces:
            return
        listed = wp.array(np.array(pieces, np.int32), dtype=wp.vec2i, device=device)
        rows = Rows.in_part(listed, int(inside.sum()), tuple(int(n) for n in shape))
    x = rng.integers(-9, 10, shape).astype(float)
    z = rng.integers(-9, 10, shape).astype(float) if rng.random() < 0.5 else None
    y, out = field(np.full(shape, -1.0)), field(np.full(2 * rows.places, -7.0))
    visited = wp.zeros(rows.single.planes * rows.single.rows, dtype=wp.uint8, device=device)
    given = None if z is None else field(z)
    marked.bind(rows, x=field(x), y=y, z=given, visited=visited, out=out).launch()
    around = [np.roll(x, *step) for step in ((1, 2), (-1, 2), (1, 1), (-1, 0))]
    v = around[0] + 10 * around[1] + 100 * around[2] + 1000 * around[3] + (7 if z is None else z)
    k, j, _ = np.indices(shape)
    expected = np.where(inside, v + 0.001 * (k + 100 * j), -1.0)
    np.testing.assert_allclose(y.numpy(), expected, rtol=1e-15, atol=0, err_msg=f"SEED={seed}")
    assert ((y.numpy() == -1.0) == ~inside).all(), f"SEED={seed}"
    counts, most = out.numpy().reshape(2, -1)
    assert counts.sum() == x[inside].sum(), f"SEED={seed}"
    assert most.max() == v[inside].max(), f"SEED={seed}"
    assert visited.numpy().all(), f"SEED={seed}"


@pytest.mark.cpu_form("compiles for a GPU itself")
@pytest.mark.skipif(bool(tools_missing()), reason="the extra ptxas is not installed")
@pytest.mark.parametrize("slab", [1, 2])
def test_machine_code_writes_to_the_cells_of_a_box(
    marked: StencilKernel, slab: int, tmp_path: Path
) -> None:
    """On a GPU, the place of a thread in the box is computed from its number."""
    shape, low, high = (6, 7, 8), (1, 2, 1), (4, 6, 7)
    rows = Rows.box(low, high, wp.get_device("cpu"), cells=1)
    planes = put(copy_of(rows.single), {"slab": slab})
    x, y = (field(np.zeros(shape)) for _ in range(2))
    out = field(np.zeros(2 * rows.places))
    visited = wp.zeros(12, dtype=wp.uint8, device="cpu")
    bound = marked.bind(rows, x=x, y=y, z=None, visited=visited, out=out)
    module = bound.form.kernel.module
    wp.compile_aot_module(module.name, device=None, arch=[90], module_dir=tmp_path, use_ptx=True)
    (ptx,) = tmp_path.glob("*.ptx")
    (kernel,) = assemble(ptx.read_text(), tmp_path / "module.cubin")
    dims = threads(planes)
    count = math.prod(dims)
    bounds = struct.pack("<3I4xQQ", *dims, count, 1)
    parameters = bounds + bytes(native_of(planes)) + bound.arguments
    memory = EmulatedMemory((int(a.ptr), a.numpy().copy()) for a in (x, y, out, visited))
    constants = constants_of(parameters, BLOCK, 1)
    cells = set()
    for begin in range(0, count, WARP):
        lanes = [(t, 0) for t in range(begin, min(begin + WARP, count))]
        written = issued(kernel.code, constants, memory, lanes).written
        cells |= {(at - y.ptr) // 8 for at in written if 0 <= at - y.ptr < 8 * y.size}
    inside = np.zeros(shape, dtype=bool)
    inside[tuple(slice(*ends) for ends in zip(low, high, strict=True))] = True
    assert cells == set(np.flatnonzero(inside))
    assert re.match(r"marked_", kernel.name)
