"""Passes that compute what others would store give what these do; on CUDA, so with the plugin `emulated_cuda`."""

import sys

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.multigrid import CycleSettings, Hierarchy
from warp_lcp.multigrid.hierarchy import Level

pytestmark = pytest.mark.skipif("emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there")


def applied(A: wl.GridPoisson, r: np.ndarray, settings: CycleSettings) -> np.ndarray:
    """Return a linear cycle's correction for a right-hand side."""
    hierarchy = Hierarchy(A.stencil, wp.float64, bounded=False, settings=settings)
    hierarchy.hold(A.stencil.d, A.layout.load(np.asarray(A.cells.numpy()[1:-1, 1:-1, 1:-1] == wl.FLUID).reshape(A.shape), wp.uint8))
    hierarchy.rebuild()
    hierarchy.finest.b.assign(A.layout.load(r, wp.float64))
    hierarchy.cycle.run()
    return A.layout.unload(hierarchy.finest.x).numpy()


@pytest.mark.parametrize("seed", range(12))
def test_cycles_are_the_same(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids of any shape, with holes, uniform and varying weights, axes that are not coarsened, small levels together and apart."""
    rng = np.random.default_rng(8800 + seed)
    shape = tuple(int(n) for n in rng.integers(1, 30, rng.integers(2, 4)))
    cells = rng.choice([wl.FLUID, wl.FLUID, wl.FLUID, wl.AIR, wl.SOLID], shape)
    cells.flat[0] = wl.FLUID
    faces = {}
    if seed % 3 == 1:
        faces = {f"face_{axis}": float(rng.uniform(0.01, 2.0)) for axis in "xyz"[: len(shape)]}
    if seed % 3 == 2:
        for axis in range(len(shape)):
            counts = [n + (a == len(shape) - 1 - axis) for a, n in enumerate(shape)]
            faces[f"face_{'xyz'[axis]}"] = rng.uniform(0.1, 1.0, counts)
    A = wl.GridPoisson(cells, shift=0.01, device="cpu", dtype=wp.float64, **faces)
    settings = CycleSettings(one_launch_cuda=int(rng.choice([0, 4096])), coarsest_cuda=8)
    r = rng.standard_normal(shape) * (cells == wl.FLUID)
    found = applied(A, r, settings)
    monkeypatch.setattr(Level, "computes_again", False)
    expected = applied(A, r, settings)
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


def test_both_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer launches than with corrections and first sweeps that are stored."""
    A = wl.GridPoisson(np.ones((8, 8, 8), dtype=int), shift=1.0, device="cpu")
    counts = []
    for again in (True, False):
        monkeypatch.setattr(Level, "computes_again", again)
        counts.append(len(Hierarchy(A.stencil, wp.float32, bounded=False, settings=CycleSettings(one_launch_cuda=0)).cycle))
    assert counts[1] - counts[0] == 2  # of one level: one pass on its way down, and one on its way up
