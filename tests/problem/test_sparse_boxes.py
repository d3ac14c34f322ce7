"""Boxes partly filled with liquid.

They have the bits of a problem that visits the whole box, in memory of the size of the liquid.
"""

import subprocess
import sys

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import covering
from warp_lcp.benchmarks.harness.machine import resident_bytes
from warp_lcp.benchmarks.tank import ClosedTank, record
from warp_lcp.kernels import Rows
from warp_lcp.operators import grid_operator

SHAPES = (24, 150, 90), (8, 300, 150)  # planes of liquid; rows of liquid in each plane
STOPPING = wl.StoppingCriteria(rtol=1e-6)


def liquid(up, level):
    """Return cells that are FLUID up to a level along an axis.

    They have a wavy surface and a SOLID block.
    """
    shape = SHAPES[up]
    k, j, i = np.indices(shape, sparse=True)
    height = (k / shape[0], j / shape[1])[up] + 0.05 * np.sin(0.2 * i)
    cells = np.where(np.broadcast_to(height, shape) < level, wl.FLUID, wl.AIR).astype(np.int8)
    cells[:2, :20, 30:50] = wl.SOLID
    return cells


def data(cells, seed):
    rng = np.random.default_rng(seed)
    return rng.standard_normal(cells.shape), np.where(rng.random(cells.shape) < 0.1, 0.0, -np.inf)


def stored(values):
    return wp.array(np.pad(values, 1), dtype=wp.float64, device="cpu")


def solves(up, method, *, in_place):
    """Return results of solves in liquid that rises, falls and rises again.

    The solves start cold, and from the last x.
    """
    levels = [liquid(up, level) for level in (0.2, 0.5, 0.1, 0.3)]
    A = wl.GridPoisson(levels[0], device="cpu")
    b, lower = data(levels[0], 61)
    fields = [stored(v) if in_place else v for v in (b, lower)]
    problem = wl.LCP(A, *fields)
    work, results, x0 = method.init(problem), [], None
    for cells in levels:
        A.update(wp.array(cells, device="cpu"))
        if in_place:
            for field, values in zip(fields, data(cells, 67), strict=True):
                field.assign(np.pad(values, 1))
        for guess in (x0, None):
            result = wl.solve(problem, method, stopping=STOPPING, x0=guess, workspace=work)
            assert result
            results.append((result.x.numpy().copy(), [r.residual for r in result.history]))
        # Of cells without liquid, too.
        x0 = np.random.default_rng(71).standard_normal(results[-1][0].shape) * 0.01
    return A, results


@pytest.mark.default_cases(2)
@pytest.mark.cpu_form("boxes that are partly in use are the CPU's")
@pytest.mark.parametrize(
    ("method", "up", "in_place"),
    covering(
        [
            wl.ProjectedMultigrid(),
            wl.ProjectedMultigrid(precision="double"),
            wl.MinimumMapNewton(),
            wl.MPRGP(),
        ],
        [0, 1],
        [False, True],
    ),
)
def test_bits_are_those_of_a_problem_that_looks_through_its_box(method, up, in_place, monkeypatch):
    monkeypatch.setattr(grid_operator, "LARGE", 1 << 40)
    whole, expected = solves(up, method, in_place=in_place)
    monkeypatch.setattr(grid_operator, "LARGE", 0)
    part, found = solves(up, method, in_place=in_place)
    assert part.layout.sparse
    assert not whole.layout.sparse
    for (x, history), (other, recorded) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(x, other)
        assert history == recorded


@pytest.mark.cpu_form("boxes that are partly in use are the CPU's")
@pytest.mark.parametrize("up", [0, 1])
def test_passes_take_the_chunks_that_have_been_in_use(up, monkeypatch):
    monkeypatch.setattr(grid_operator, "LARGE", 0)
    A = wl.GridPoisson(liquid(up, 0.2), device="cpu")
    chunks = A.layout.chunks.numpy()[:, 0]
    lengths = np.diff(chunks)[:, 0]
    flat = np.zeros(A.layout.size, dtype=bool)
    for c in np.flatnonzero(lengths):
        flat[8192 * c : 8192 * c + lengths[c]] = True
    fluid = A.cells.numpy() == wl.FLUID
    assert flat[fluid.ravel()].all()
    ends = A.stencil.spans.numpy()[..., 1]
    np.testing.assert_array_equal(ends > 0, fluid[1:-1, 1:-1].any(axis=2))
    assert flat.sum() < (0.35, 0.8)[up] * flat.size
    assert (
        Rows.of_fields(A.layout).places == Rows.flat(A.layout.size, A.device).places == len(chunks)
    )
    A.update(wp.array(liquid(up, 0.05), device="cpu"))
    np.testing.assert_array_equal(A.layout.chunks.numpy()[:, 0], chunks)


def test_full_boxes_have_huge_pages_and_are_copied_at_once(monkeypatch):
    monkeypatch.setattr(grid_operator, "LARGE", 0)
    layout = wl.GridPoisson(np.ones(SHAPES[0], dtype=np.int8), device="cpu").layout
    assert not layout.sparse
    assert not layout.padding.small_pages


TAKEN = """
import numpy as np
import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import forget_peak, resident_bytes
from warp_lcp.operators import grid_operator

def solved(planes):
    cells = np.zeros((planes, 400, 200), dtype=np.int8)
    cells[:, :40] = wl.FLUID
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), (cells == wl.FLUID).astype(float), 0.0)
    return problem, wl.solve(problem, wl.ProjectedMultigrid(), \
stopping=wl.StoppingCriteria(rtol=1e-6, max_iterations=3))

assert solved(16)[0].A.layout.padding.small_pages  # kernels are loaded
for grid_operator.LARGE in (1 << 20, 1 << 40):
    forget_peak()
    before = resident_bytes()
    kept = solved(32)
    print(resident_bytes() - before)
    del kept
"""


@pytest.mark.slow
@pytest.mark.skipif(
    resident_bytes() == 0, reason="the system does not tell how much memory is resident"
)
def test_fields_take_the_memory_of_the_liquid():
    """Memory of fields: that of the liquid.

    In a separate process, since here memory freed by other tests would be reused.
    """
    done = subprocess.run(
        [sys.executable, "-c", TAKEN], check=True, capture_output=True, text=True, timeout=300
    )
    sparse, whole = map(int, done.stdout.split()[-2:])
    assert sparse < 0.35 * whole


def test_a_tank_is_solved_in_twelve_iterations():
    found = record(ClosedTank(64), 1)
    assert found.facts["status"] == "CONVERGED"
    assert found.figures["iterations"].value <= 12
    assert found.figures["residual"].value == pytest.approx(found.figures["told"].value, rel=1e-6)
