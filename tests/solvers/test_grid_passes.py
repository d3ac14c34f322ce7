"""Grid passes of Newton-type methods on the CPU against dense matrices."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import covering, slow
from oracle import assemble, natural_residual
from warp_lcp.krylov import ConjugateGradient
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.subproblems.grid_step_kernels import (
    BETA,
    CARRY,
    NORM,
    SIZE,
    SLOTS,
    STEP,
    plan_whole_step_kernel,
)
from warp_lcp.subproblems.grid_system import GridSystem
from warp_lcp.subproblems.nonsmooth_map import Kink, MapForm, NonsmoothMap

SHAPE = (6, 7, 21)
FACES = [{}, {"face_y": 3.0}, "arrays"]


def scene(form, lower=0.0, upper=np.inf):
    """Return a grid with AIR and SOLID, its dense matrix, and a problem on it."""
    rng = np.random.default_rng(411)
    cells = rng.choice([wl.AIR, wl.FLUID, wl.SOLID], size=SHAPE, p=[0.15, 0.75, 0.1])
    faces = form
    if form == "arrays":
        faces = {
            f"face_{a}": 0.2 + rng.random([n + (i == j) for j, n in enumerate(SHAPE)])
            for i, a in ((2, "x"), (1, "y"), (0, "z"))
        }
    A = assemble(cells, [faces.get(f"face_{a}", 1.0) for a in "xyz"])
    b = rng.standard_normal(SHAPE)
    problem = wl.LCP(
        wl.GridPoisson(cells, device="cpu", dtype=wp.float64, **faces), b, lower, upper
    )
    return SimpleNamespace(
        cells=cells, fluid=cells.ravel() == wl.FLUID, A=A, b=b.ravel(), problem=problem, rng=rng
    )


def stored(s, values, dtype=wp.float64):
    return s.problem.layout.load(np.asarray(values).reshape(SHAPE), dtype)


def inner(field):
    return (
        field.numpy().reshape([n + 2 for n in SHAPE])[1:-1, 1:-1, 1:-1].ravel().astype(np.float64)
    )


@pytest.mark.cpu_form("waves are the CPU's")
@pytest.mark.parametrize("form", FACES, ids=str)
@pytest.mark.parametrize("shifted", [False, True])
def test_conjugate_gradients_solve_the_masked_and_shifted_system(form, shifted):
    """Conjugate gradients on the masked and shifted system.

    A row of A p that is used before the plane above is complete, a step of the wrong sign, or a
    lost shift would leave a residual.
    """
    s = scene(form)
    free = s.fluid & (s.rng.random(s.fluid.size) < 0.8)
    shift = 10 ** s.rng.uniform(-2, 6, s.fluid.size) if shifted else np.zeros(s.fluid.size)
    b = s.rng.standard_normal(s.fluid.size) * free
    system = GridSystem(s.problem.A, wp.float64, bounded=False, shifted=shifted)
    assert system.fused
    system.restrict(stored(s, free, wp.uint8), stored(s, shift) if shifted else None)
    for _ in range(2):  # again: no data of the last solve may remain
        system.r.assign(stored(s, b))
        iterations, norm = system.solve(1e-11, 100)
        e = inner(system.e)
        np.testing.assert_array_equal(e[~free], 0.0)
        M = (s.A + np.diag(shift))[np.ix_(free, free)]
        left = M @ e[free] - b[free]
        assert np.linalg.norm(left / np.sqrt(np.diag(M)) if shifted else left) <= 1e-10
        assert norm <= 1e-11
    weight = system._weight if shifted else None
    plain = ConjugateGradient(system.hierarchy.finest.stencil.product, system, weight=weight)
    system.r.assign(stored(s, b))
    assert abs(plain.solve(1e-11, 100)[0] - iterations) <= 1


def test_conjugate_gradients_stop_without_a_right_hand_side():
    s = scene({})
    system = GridSystem(s.problem.A, wp.float32, bounded=False)
    system.restrict(stored(s, s.fluid, wp.uint8))
    system.r.zero_()
    assert system.solve(0.0, 50) == (1, 0.0)
    assert not system.e.numpy().any()


@pytest.mark.parametrize(
    ("form", "upper", "share", "real"),
    covering(list(FACES), [np.inf, 0.4], [1.0, 0.9], [wp.float32, wp.float64], count=8),
)
def test_a_fischer_step_is_its_move_its_residual_and_its_system(form, upper, share, real):
    """Fischer step: its move, its residual and its system.

    Against the map's separate kernels, which other tests compare with finite differences, and the
    dense residual.
    """
    s = scene(
        form,
        lower=np.where(np.arange(np.prod(SHAPE)) % 3, 0.0, -np.inf).reshape(SHAPE),
        upper=upper,
    )
    residual = NaturalResidual(s.problem)
    kind = MapForm.FISCHER if share == 1 else MapForm.PENALIZED
    map_ = NonsmoothMap(s.problem, residual, kind, share, Kink.PERTURBATION)
    system = GridSystem(s.problem.A, real, bounded=False, shifted=True)
    start, e = (s.rng.standard_normal(s.fluid.size) * s.fluid for _ in range(2))
    e, step, scale = e.astype(np.float32).astype(np.float64), 0.3, 0.7
    x, moved = stored(s, start), start + step * e
    system.e.assign(stored(s, e, real))
    merit = map_.step(x, system.e, step, system.hierarchy.finest, scale, 1)
    np.testing.assert_allclose(inner(x), moved, rtol=1e-12, atol=1e-12)
    lower, tol = (
        np.where(np.arange(s.fluid.size) % 3, 0.0, -np.inf),
        1e-5 if real is wp.float32 else 1e-12,
    )
    l, u, f = lower[s.fluid], np.full(s.fluid.sum(), upper), np.ix_(s.fluid, s.fluid)
    assert residual.norm == pytest.approx(
        natural_residual(s.A[f], s.b[s.fluid], l, u, moved[s.fluid]), rel=1e-12
    )
    r, d, norm = inner(system.r), inner(system.hierarchy.finest.stencil.d), map_.norm
    shift, free = s.problem.layout.zeros(wp.float64), s.problem.layout.zeros(wp.uint8)
    residual.evaluate(x)
    assert map_.condense(x, shift, system.r, free, scale, 1) == pytest.approx(merit, rel=10 * tol)
    np.testing.assert_allclose(r, inner(system.r), rtol=10 * tol, atol=tol * np.abs(r).max())
    np.testing.assert_allclose(d, (np.diag(s.A) + inner(shift)) * s.fluid, rtol=100 * tol, atol=tol)
    assert norm == pytest.approx(
        np.sqrt(np.sum(r[s.fluid] ** 2 / np.where(d > 0, d, 1)[s.fluid])), rel=10 * tol
    )


@pytest.mark.cpu_form("waves are the CPU's")
@pytest.mark.parametrize("form", FACES, ids=str)
@pytest.mark.parametrize("upper", [np.inf, 2.0])
def test_a_step_along_the_path_is_mehrotras(form, upper):
    """Step along the central path by Mehrotra's rule.

    Predictor, ratios, corrector and move from their formulas; a product with an infinite w must
    count as 0.
    """
    s = scene(
        form,
        lower=np.where(np.arange(np.prod(SHAPE)) % 3, 0.0, -np.inf).reshape(SHAPE),
        upper=upper,
    )
    n, fluid, rng, two = s.fluid.size, s.fluid, s.rng, np.isfinite(upper)
    lower = np.where(np.arange(n) % 3, 0.0, -np.inf)
    low, x = fluid & np.isfinite(lower), (0.2 + rng.random(n)) * fluid
    w, sl = np.where(low, x - lower, np.inf), np.where(low, rng.random(n), 0.0)
    v, t = (
        (np.where(fluid, upper - x, np.inf), np.where(fluid, rng.random(n), 0.0))
        if two
        else (np.full(n, np.inf), np.zeros(n))
    )
    size, tau, length, scale = 1.7, 0.05, 0.4, 0.6
    e, a = (rng.standard_normal(n) * fluid * 0.1 for _ in range(2))
    path = InteriorPoint(precision="double").init(s.problem)
    system, residual, predicted = path.system, path.residual, path._predicted
    path._w, path._s = stored(s, w), stored(s, sl)
    path._v, path._t = (stored(s, v), stored(s, t)) if two else (path._w, path._s)
    path.free, path.count, residual.norm = stored(s, fluid, wp.uint8), 1, 1 / scale
    X = stored(s, x)

    def condensed():
        y, D = s.A @ inner(X) + s.b, sl / w + t / v
        np.testing.assert_allclose(
            inner(system.r)[fluid], -scale * y[fluid], rtol=1e-12, atol=1e-12
        )
        np.testing.assert_allclose(
            inner(system.hierarchy.finest.stencil.d), (np.diag(s.A) + D) * fluid, rtol=1e-12
        )
        weights = (np.diag(s.A) + D)[fluid]
        assert path._norm(1) == pytest.approx(
            np.sqrt(np.sum((scale * y[fluid]) ** 2 / np.where(weights > 0, weights, 1))), rel=1e-6
        )
        f = np.ix_(fluid, fluid)
        expected = natural_residual(
            s.A[f], s.b[fluid], lower[fluid], np.full(fluid.sum(), upper), inner(X)[fluid]
        )
        assert residual.norm == pytest.approx(expected, rel=1e-12)

    path._advance(X, 0.0, 0.0)
    condensed()
    path.size = size
    left = rng.standard_normal(n) * fluid  # of the predictor's residual
    system.r.assign(stored(s, left))
    system.e.assign(stored(s, a))
    da = size * a
    dsa, dta = -sl - sl / w * da, -t + t / v * da
    longest, products = path._ratios(0.0, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rates = [-da / w, np.where(sl > 0, -dsa / sl, 0), da / v, np.where(t > 0, -dta / t, 0)]
    assert longest == pytest.approx(max(r[fluid].max() for r in rates), rel=1e-12)
    assert products == pytest.approx(np.sum((da * dsa - da * dta)[fluid]), rel=1e-10)
    path._correct(tau, y=None, D=system.hierarchy.finest.stencil.d)
    right = (left + ((tau - da * dsa) / w - (tau + da * dta) / v) / size) * fluid
    np.testing.assert_allclose(inner(system.r), right, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(inner(predicted), a, rtol=1e-12)
    system.e.assign(stored(s, e))
    dx = size * e + da
    ds = (tau - da * dsa) / w - sl - sl / w * dx
    dt = (tau + da * dta) / v - t + t / v * dx
    assert path._ratios(1.0, tau)[1] == pytest.approx(np.sum((dx * ds - dx * dt)[fluid]), rel=1e-10)
    residual.norm = 1 / scale
    path._advance(X, tau, length)
    x, w, sl, v, t = (
        x + length * dx,
        w + length * dx,
        sl + length * ds,
        v - length * dx,
        t + length * dt,
    )
    np.testing.assert_allclose(inner(X)[fluid], x[fluid], rtol=1e-12, atol=1e-12)
    pairs = path._pairs
    for field, expected in zip(
        (pairs.w, pairs.v, pairs.s, pairs.t), (w, v, sl, t) if two else (w, w, sl, sl), strict=True
    ):
        np.testing.assert_allclose(inner(field)[fluid], expected[fluid], rtol=1e-10, atol=1e-12)
    bounded = np.where(sl > 0, np.where(np.isfinite(w), w, 0) * sl, 0) + np.where(
        t > 0, np.where(np.isfinite(v), v, 0) * t, 0
    )
    assert path.mu * path.count == pytest.approx(bounded[fluid].sum(), rel=1e-10)
    condensed()


@pytest.mark.parametrize("precision", ["mixed", "single"])
@pytest.mark.parametrize("periodic", [(False,) * 3, (True, True, True)])
def test_what_the_minimum_map_holds_goes_to_its_bound(precision, periodic):
    """Active unknowns of the minimum map move to their bounds.

    The right-hand side must be that of the moved unknowns, also in neighboring rows and across a
    periodic side.
    """
    rng = np.random.default_rng(97)
    cells = rng.choice([wl.AIR, wl.FLUID], size=SHAPE, p=[0.2, 0.8])
    A, b, fluid = (
        assemble(cells, periodic=periodic),
        rng.standard_normal(SHAPE).ravel(),
        cells.ravel() == wl.FLUID,
    )
    lower, upper = -rng.random(SHAPE), rng.random(SHAPE)
    problem = wl.LCP(
        wl.GridPoisson(cells, device="cpu", periodic=periodic), b.reshape(SHAPE), lower, upper
    )
    work = wl.MinimumMapNewton(precision=precision).init(problem)
    start = rng.uniform(-0.5, 0.5, SHAPE).astype(np.float32).astype(np.float64) * (
        cells == wl.FLUID
    )
    residual = work.residual
    residual.start(work.x, keep=False)
    work.x.assign(problem.layout.load(start, wp.float64))
    norm = residual.evaluate(work.x, classify=True)
    x, y, d = start.ravel(), A @ start.ravel() + b, np.where(np.diag(A) > 0, np.diag(A), 1.0)
    l, u = lower.ravel(), upper.ravel()
    r = d * (x - np.clip(x - y / d, l, u))
    assert norm == pytest.approx(np.linalg.norm(r[fluid]), rel=1e-10)
    low, high = fluid & (x - y / d < l), fluid & (x - y / d > u)
    assert residual.away
    assert residual.active == np.count_nonzero(low | high)
    residual.project_held(work.x)
    rounded = (
        (lambda a: a.astype(np.float32).astype(np.float64))
        if precision == "single"
        else (lambda a: a)
    )
    x = np.where(low, rounded(l), np.where(high, rounded(u), x))
    np.testing.assert_allclose(inner(work.x), x, rtol=0, atol=0)
    free = fluid & ~low & ~high
    expected = np.where(free, -(A @ x + b), 0.0) / residual.norm_of_b()
    np.testing.assert_allclose(
        inner(work.iterate.hierarchy.finest.b), expected, rtol=1e-5, atol=1e-6
    )
    assert not residual.away


def after_four_steps(progress):
    return progress.taken >= 4


CROSSOVER = wl.Fallback(InteriorPoint(), (wl.MinimumMapNewton(), after_four_steps))


@pytest.mark.parametrize(
    "method", [InteriorPoint(), CROSSOVER], ids=["interior-point", "crossover"]
)
def test_unknowns_without_neighbors_are_solved_too(method):
    """Unknowns without neighbors, solved too.

    The interior-point method moves them off their bounds; the fallback must not leave them there.
    """
    cells = np.full((9, 9, 9), wl.FLUID)
    cells[0], cells[4:, :, 4] = wl.AIR, wl.SOLID
    cells[5:8, 3:6, 3:6] = wl.SOLID
    cells[6, 4, 4] = wl.FLUID
    b = np.random.default_rng(5).standard_normal(cells.shape)
    for sign, expected in ((1.0, 0.0), (-1.0, 0.7)):
        b[6, 4, 4] = 0.5 * sign
        problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), b, 0.0, 0.7)
        result = wl.solve(
            problem, method, stopping=wl.StoppingCriteria(rtol=1e-9, max_iterations=200)
        )
        assert result
        assert result.x.numpy()[6, 4, 4] == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize(
    "method",
    [wl.MinimumMapNewton(backtracks=0), wl.MinimumMapNewton(), wl.MinimumMapNewton(memory=1)],
    ids=str,
)
def test_a_bad_guess_is_left_by_shorter_steps_or_projected_cycles(method):
    """Bad initial guess: shorter steps or projected cycles.

    From a random warm start Newton's first steps raise the residual; the solution is that of a cold
    start.
    """
    s = scene({}, lower=-0.2, upper=0.3)
    tight = wl.StoppingCriteria(rtol=1e-9)
    cold = wl.solve(s.problem, method, stopping=tight)
    warm = wl.solve(s.problem, method, stopping=tight, x0=s.rng.uniform(-0.2, 0.3, SHAPE))
    assert cold
    assert warm
    np.testing.assert_allclose(warm.x.numpy(), cold.x.numpy(), atol=1e-7)


@pytest.mark.parametrize(
    ("precision", "seeds"), [("mixed", 4), ("single", 4), slow(("mixed", 12)), slow(("single", 12))]
)
@pytest.mark.parametrize("periodic", [False, True])
def test_the_best_iterate_is_returned_however_the_solve_is_cut_short(precision, seeds, periodic):
    """Best iterate, however the solve is cut short.

    Moves onto bounds, rejected steps and projected cycles all change x in place; the stored iterate
    must have the least residual.
    """
    rng = np.random.default_rng(31)
    cells = rng.choice([wl.AIR, wl.FLUID, wl.SOLID], size=SHAPE, p=[0.05, 0.75, 0.2])
    problem = wl.LCP(
        wl.GridPoisson(cells, device="cpu", periodic=(periodic,) * 3),
        rng.standard_normal(SHAPE),
        -0.1,
        0.2,
    )
    check, risen = NaturalResidual(problem), 0
    for seed in range(seeds):
        start = np.random.default_rng(seed).standard_normal(SHAPE)
        # The last ones are at the floor of the precision, where residuals fluctuate.
        for most in (1, 2, 4, 15):
            method = wl.MinimumMapNewton(
                precision=precision, memory=1 + seed % 4, backtracks=seed % 3
            )
            result = wl.solve(
                problem,
                method,
                stopping=wl.StoppingCriteria(rtol=1e-18, max_iterations=most),
                x0=start,
            )
            norms = [r.residual for r in result.history]
            risen += norms[-1] > min(norms)
            assert result.residual == pytest.approx(min(norms), rel=1e-6)
            x = problem.layout.load(result.x.numpy().astype(np.float64), wp.float64)
            assert check.evaluate(x) == pytest.approx(result.residual, rel=1e-6)
    assert risen > 0


def test_the_step_of_a_projected_cycle_is_its_correction_alone():
    """Step of a projected cycle: its correction alone.

    Such a correction stays within the bounds; with a share of the last direction it would not.
    """
    scalars = wp.array(np.linspace(2.0, 5.0, SLOTS), dtype=wp.float64, device="cpu")
    before = scalars.numpy().copy()
    wp.launch(plan_whole_step_kernel, 1, [scalars, False], device="cpu")
    after = scalars.numpy()
    assert (after[int(BETA)], after[int(CARRY)]) == (0.0, 0.0)
    # The correction's unit, which changes for the next one.
    assert after[int(STEP)] == before[int(SIZE)]
    assert after[int(SIZE)] == np.sqrt(before[int(NORM)])
