"""Best iterate of ProjectedMultigrid, which moves x in place.

It is restored by reverting a step, or from a copy once x has moved on.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import covering
from warp_lcp.subproblems import grid_step_kernels as kernels


def started(precision="mixed", faces=None, closed=False):
    """Return a workspace at the start of a solve, with its problem and solver."""
    cells = np.ones((9, 10, 11), dtype=int)
    if not closed:
        cells[-1] = wl.AIR
    b = np.random.default_rng(17).standard_normal(cells.shape)
    solver = wl.ProjectedMultigrid(precision=precision)
    lower = np.where(np.random.default_rng(3).random(cells.shape) < 0.5, 0.0, -np.inf)
    problem = wl.LCP(
        wl.GridPoisson(cells, device="cpu", **(faces or {})), b - (b.mean() if closed else 0), lower
    )
    work = solver.init(problem)
    floating = problem.A.floating_components(work.scratch)
    work.residual.start(work.x, keep=False)
    work.residual.evaluate(work.x)
    work.keep()
    work.start(warm=False, tolerance=0.0, floating=floating)
    return problem, solver, work


@pytest.mark.parametrize(
    ("before", "beyond", "closed", "precision"),
    covering([0, 1, 2, 3], [1, 2, 4], [False, True], ["mixed", "double", "single"], count=24),
)
def test_the_best_iterate_comes_back(before, beyond, closed, precision):
    problem, solver, work = started(precision, closed=closed)
    for _ in range(before):
        solver.step(problem, work, work.x)
        work.keep()
    best, norm = work.x.numpy().copy(), work.residual.norm
    for _ in range(beyond):
        solver.step(problem, work, work.x)
    moved = np.abs(work.x.numpy() - best).max()
    assert moved > 0
    work.restore()
    # A reverted step is exact up to the rounding of the direction, in float32, where a bound cut
    # the step.
    np.testing.assert_allclose(work.x.numpy(), best, atol=1e-6 * moved)
    assert work.residual.evaluate(work.x) == pytest.approx(norm, rel=1e-5)
    solver.step(problem, work, work.x)
    assert np.isfinite(work.residual.norm)


def test_a_step_that_is_not_finite_is_not_taken():
    problem, solver, work = started()
    for _ in range(3):
        solver.step(problem, work, work.x)
        work.keep()
    best = work.x.numpy().copy()
    work.hierarchy.finest.b.fill_(np.nan)
    solver.step(problem, work, work.x)
    assert np.isnan(work.residual.norm)
    np.testing.assert_array_equal(work.x.numpy(), best)
    work.restore()
    np.testing.assert_array_equal(work.x.numpy(), best)
    assert np.isfinite(work.residual.evaluate(work.x))


def test_a_solve_that_never_rises_keeps_one_iterate():
    problem, _, work = started()
    solver = wl.ProjectedMultigrid()
    result = wl.solve(problem, solver, workspace=work, stopping=wl.StoppingCriteria(rtol=1e-8))
    norms = [record.residual for record in result.history]
    assert result
    assert norms == sorted(norms, reverse=True)
    assert work._best is None


@pytest.mark.parametrize("solver", [wl.FischerNewton(), wl.InteriorPoint()])
def test_cycles_that_serve_another_method_keep_no_iterate(solver):
    """Cycles that serve another method: no stored iterate.

    The calling method stores the best one; a second copy would be another field of memory.
    """
    problem, _, _ = started()
    work = solver.init(problem)
    result = wl.solve(problem, solver, workspace=work, stopping=wl.StoppingCriteria(rtol=1e-6))
    assert result, result.status
    assert [record.step for record in result.history].count("monotone cycle") >= 2
    assert work.cold_start._best is None


def test_the_carried_curvature_is_that_of_the_direction():
    problem, solver, work = started()
    for _ in range(4):
        solver.step(problem, work, work.x)
    p = work._p.numpy()
    free = work.hierarchy.finest.stencil.d.numpy() != 0
    inside = wp.array(np.where(free, p, 0), dtype=wp.float64, device="cpu")
    product = problem.A.apply(inside).numpy()
    expected = float(np.dot(np.where(free, p, 0), product))
    assert work.residual.scalars.numpy()[int(kernels.PAP)] == pytest.approx(expected, rel=0.05)
