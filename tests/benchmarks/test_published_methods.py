"""Equal solutions of the methods of the suite `published`, in 3-D and 2-D.

The page has the stored figures.
"""

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.benchmarks import published
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.benchmarks.problems import natural, plane, splash


@pytest.mark.parametrize("make", [splash, plane])
@pytest.mark.parametrize("entry", published.ENTRIES[:7], ids=lambda entry: entry.label)
def test_published_methods_solve_the_splash(entry, make):
    """Residual min(p, A p + b), computed without code of the solvers."""
    scene = make(16)
    problem = wl.LCP(entry.operator(scene.cells, device="cpu"), scene.b, scene.lower("everywhere"))
    result = wl.solve(problem, entry.solver, stopping=wl.StoppingCriteria(rtol=1e-6))
    flat = scene.cells.ndim == 2
    cells, b, x = (a[None] if flat else a for a in (scene.cells, scene.b, result.x.numpy()))
    first, last = (np.linalg.norm(natural(cells, b, 0.0, p)) for p in (np.zeros(b.shape), x))
    assert result
    assert last <= 1.001e-6 * first
    assert 0 < np.count_nonzero((x > 0)[cells == wl.FLUID]) < np.count_nonzero(cells == wl.FLUID)


def test_cycles_without_coarse_levels_on_the_active_set_need_no_other_steps():
    """Number of cycles without coarse levels on the active set.

    The boundary of a contact moves by a few layers of cells per step, so that their number grows;
    projected cycles move it at once.
    """
    scene = plane(128)
    counts = {}
    for method in (published.TruncatedMultigrid(monotone_cycles=0), wl.ProjectedMultigrid()):
        result = wl.solve(
            scene.lcp("everywhere", device="cpu"), method, stopping=wl.StoppingCriteria(rtol=1e-6)
        )
        counts[type(method).__name__] = result.iterations
        assert result
        assert result.linear_iterations == result.iterations
    assert counts["TruncatedMultigrid"] > 1.5 * counts["ProjectedMultigrid"]


def test_the_plane_is_that_of_the_splash():
    whole, flat = splash(16), plane(16)
    for name in ("cells", "b", "wall"):
        assert np.array_equal(getattr(flat, name), getattr(whole, name)[:, 8])


def test_slow_methods_are_not_run_at_larger_sizes(tmp_path, monkeypatch):
    monkeypatch.setattr(published, "ENTRIES", published.ENTRIES[-2:])
    monkeypatch.setattr(published, "PATIENCE", 0.0)
    results = published.measure(Options("cpu", (8, 9), 1, lambda line: None), tmp_path)
    sizes = [record.facts["size"] for record in results.records[1:]]
    assert [sizes.count(size) for size in ("8^3", "9^3", "32^2", "36^2")] == [5, 1, 5, 1]
    assert not results.failures
