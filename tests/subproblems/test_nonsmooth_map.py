"""Nonsmooth maps of Newton-type methods, row by row against their definition.

At kinks too, in all places where they are computed.
"""

from decimal import Decimal, localcontext

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import assemble
from plain_fischer import LEAST_Q, PlainMap
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.solvers.fischer_newton import FischerNewton
from warp_lcp.subproblems.dense_problem import DenseProblem
from warp_lcp.subproblems.nonsmooth_map import (
    WEIGHTED,
    HostMap,
    Kink,
    MapForm,
    MapWeights,
    NonsmoothMap,
)

FORMS = ["natural", "fischer", "penalized"]
BOUNDS = [(0.0, np.inf), (-2.0, 3.0), (-np.inf, 1.0), (-np.inf, np.inf), (1.0, 1.0)]


def at_kinks(seed, n=60):
    """Return a dominant matrix of integers with kinks without rounding.

    Every kind of row; x is at a bound with y = 0 in a third of the rows.
    """
    rng = np.random.default_rng(seed)
    A = rng.integers(-2, 3, (n, n)).astype(float)
    np.fill_diagonal(A, 2.0 ** rng.integers(7, 9, n))
    lower, upper = np.array([BOUNDS[k] for k in rng.integers(0, len(BOUNDS), n)]).T
    x = rng.integers(-4, 5, n).astype(float)
    x = np.where((rng.random(n) < 0.5) & np.isfinite(lower), lower, x)
    x = np.where((rng.random(n) < 0.5) & np.isfinite(upper), upper, x)
    y = np.where(rng.random(n) < 0.5, 0.0, rng.integers(-400, 401, n).astype(float))
    return A, y - A @ x, lower, upper, x


def device_map(A, b, lower, upper, x, form, share, kink, device):
    """Return the map on the device, evaluated with the residual at x, and x there."""
    problem = wl.LCP(wl.DenseOperator(A, device=device), b, lower, upper)
    residual, field = NaturalResidual(problem), wp.array(x, dtype=wp.float64, device=device)
    made = NonsmoothMap(problem, residual, MapForm(form), share, kink)
    residual.evaluate(field)
    return made, field, problem


@pytest.mark.every_case
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kink", [Kink.PERTURBATION, Kink.ZERO, Kink.APPROXIMATION])
def test_systems_on_the_device_are_those_of_the_definition(form, kink, device):
    """Systems on the device against the definition.

    (A + D) e = -f / q with D = d p / q, and which unknowns move: those at a kink do not by `zero`
    and by `approximation`.
    """
    A, b, lower, upper, x = at_kinks(4001)
    system_map, field, problem = device_map(A, b, lower, upper, x, form, 0.7, kink, device)
    f, p, q, kinks = PlainMap(form, A, b, lower, upper, share=0.7).rows(x)
    assert form == "natural" or 5 < kinks.sum() < 30
    fields = [problem.layout.zeros(t) for t in (wp.float64, wp.float64, wp.uint8, wp.float64)]
    shift, r, free, values = fields
    merit = system_map.condense(field, shift, r, free, 0.25, 3)
    system_map.values(field, values)
    moves = ~kinks if kink is not Kink.PERTURBATION else np.ones(len(x), dtype=bool)
    q = np.maximum(q, LEAST_Q)
    np.testing.assert_allclose(values.numpy(), f, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(
        shift.numpy(), np.where(moves, np.diag(A) * p / q, 0.0), rtol=1e-8, atol=1e-9
    )
    np.testing.assert_allclose(
        r.numpy(), np.where(moves, -0.25 * f / q, 0.0), rtol=1e-8, atol=1e-12
    )
    np.testing.assert_array_equal(free.numpy(), moves)
    assert merit == pytest.approx(0.5 * f @ f, rel=1e-13)
    assert system_map.merit(field) == pytest.approx(0.5 * f @ f, rel=1e-13)


@pytest.mark.parametrize("form", FORMS)
def test_gradients_are_those_of_the_definition(form, device):
    """Gradients against the definition.

    They are J'f over d^2, with the element (0, 1) at kinks, where f = 0 but not in other rows of
    the column.
    """
    A, b, lower, upper, x = at_kinks(4003)
    made, field, _ = device_map(A, b, lower, upper, x, form, 0.7, Kink.PERTURBATION, device)
    plain = PlainMap(form, A, b, lower, upper, share=0.7)
    expected = plain.jacobian(x).T @ plain.rows(x)[0]
    square, _ = made.descend(field)
    np.testing.assert_allclose(
        made.direction.numpy(), expected / plain.d**2, rtol=1e-10, atol=1e-12
    )
    assert square == pytest.approx(np.sum((expected / plain.d) ** 2), rel=1e-12)


@pytest.mark.parametrize("form", ["fischer", "penalized"])
@pytest.mark.parametrize("kink", [Kink.PERTURBATION, Kink.ZERO])
def test_the_map_on_the_host_is_that_of_the_definition(form, kink):
    A, b, lower, upper, x = at_kinks(4007)
    share = 1.0 if form == "fischer" else 0.7
    data = DenseProblem(np.arange(len(b)), A, b, lower, upper, 0.0)
    system_map = HostMap(data, share, kink, np.random.default_rng(1))
    plain = PlainMap(form, A, b, lower, upper, share=share)
    f, p, q, kinks = system_map.linearized(x)
    for got, expected in zip((f, p, q), plain.rows(x), strict=False):
        np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(kinks, plain.rows(x)[3])
    np.testing.assert_allclose(system_map.jacobian(p, q), plain.jacobian(x), rtol=1e-8, atol=1e-7)


def towards_kinks(seed, n=400):
    """Return rows at angles all around a kink, at distances of 0 to 1.

    The arguments (a, y) or (c, -y) have distances of 1e-18 to 1 from a kink; the kink itself is
    included. Returns the diagonal of A, b, bounds and x, in units 2^k, so that a = d (x - l) is
    exact for l = 0.
    """
    rng = np.random.default_rng(seed)
    d, angle = (
        2.0 ** rng.integers(-3, 4, n),
        rng.choice(np.arange(16) * np.pi / 8, n) + rng.choice([0.0, 1e-9, 0.1], n),
    )
    distance = rng.choice([0.0, *10.0 ** np.arange(-18, 1)], n)
    a, y = distance * np.cos(angle), distance * np.sin(angle)
    kind = rng.integers(0, 4, n)
    lower = np.where(kind < 2, 0.0, -np.inf)
    upper = np.select([kind == 1, kind == 2], [0.5, 0.0], np.inf)
    x = np.where(kind == 2, -a, a) / d
    return d, np.where(kind == 2, -y, y) - d * x, lower, upper, x


@pytest.mark.parametrize("share", [1.0, 0.7])
@pytest.mark.parametrize("seed", [4021, 4027])
def test_host_and_device_agree_step_by_step_at_the_kink(share, seed, device):
    """Host and device, step by step at the kink.

    f, p f and q f of rows at and near their kinks, from one y: to the rounding of p and q, which on
    the host is that of 1 - a / rho.
    """
    d, b, lower, upper, x = towards_kinks(seed)
    form = "fischer" if share == 1 else "penalized"
    system_map, field, problem = device_map(
        np.diag(d), b, lower, upper, x, form, share, Kink.PERTURBATION, device
    )
    y, values, by_x, by_y = (
        system_map.residual.y.numpy(),
        *(problem.layout.zeros(wp.float64) for _ in range(3)),
    )
    system_map.values(field, values)
    system_map._half_sum(WEIGHTED, field, MapWeights(by_x, by_y))
    data = DenseProblem(np.arange(len(b)), np.diag(d), b, lower, upper, 0.0)
    f, p, q, kinks = HostMap(data, share, Kink.PERTURBATION, np.random.default_rng(1)).linearized(
        x, y
    )
    assert 10 < kinks.sum() < len(x) / 2
    np.testing.assert_allclose(values.numpy(), f, rtol=1e-15, atol=0.0)
    for got, slope in ((by_x.numpy() / d, p), (by_y.numpy(), q)):
        assert (np.abs(got - slope * f) <= 1e-15 * (1 + slope) * np.abs(f)).all()


@pytest.mark.parametrize("smoothing", [0.0, 1e-12, 0.3])
def test_the_smoothed_map_is_that_of_the_definition(smoothing):
    """Smoothed map against the definition, with 60 digits.

    The map is psi = x + y - sqrt(x^2 + y^2 + 2 mu) without cancellation, with its rounded
    derivatives.
    """
    rng = np.random.default_rng(4049)
    x, y = (rng.choice([-1.0, 1.0], 300) * 10.0 ** rng.uniform(-4, 4, 300) for _ in range(2))
    data = DenseProblem(
        np.arange(300), np.eye(300), np.ones(300), np.zeros(300), np.full(300, np.inf), 0.0
    )
    found = HostMap(data, 1.0, Kink.ZERO, np.random.default_rng(1)).linearized(x, y, smoothing)
    assert not found[3].any()
    with localcontext(prec=60):
        for f, p, q, a, h in zip(
            *found[:3], *([Decimal(v) for v in side] for side in (x, y)), strict=True
        ):
            rho = (a * a + h * h + 2 * Decimal(smoothing)).sqrt()
            # Near a h = mu the map itself is 0: to the rounding of its terms.
            assert f == pytest.approx(
                float(a + h - rho), rel=1e-14, abs=1e-15 * float(min(abs(a), abs(h)))
            )
            for slope, side in ((p, a), (q, h)):
                exact = float(1 - side / rho)
                assert slope == pytest.approx(exact, rel=0.0, abs=1e-15)  # five roundings
                assert slope == 0 or exact > 1e-17, (
                    "a row that does not count makes factors singular"
                )


def test_random_elements_on_the_host_are_from_the_disc():
    """Random elements on the host: from the disc, up to its edge.

    (1 - p)^2 + (1 - q)^2 <= 1; they are not all equal.
    """
    n = 2000
    data = DenseProblem(np.arange(n), np.eye(n), np.zeros(n), np.zeros(n), np.full(n, np.inf), 0.0)
    _, p, q, kinks = HostMap(data, 1.0, Kink.RANDOM, np.random.default_rng(1)).linearized(
        np.zeros(n)
    )
    assert kinks.all()
    assert ((1 - p) ** 2 + (1 - q) ** 2 <= 1).all()
    for one in (p, q):
        assert 1 - np.sqrt(0.5) <= one.min() < 0.31 and 0.98 < one.max() <= 1


def test_random_elements_on_the_device_are_from_the_disc(device):
    """Random elements on the device: from the disc.

    D = d p / q: with p and q in [1 - sqrt(1/2), 1] its extremes are 0.293 and 3.414; they differ in
    the next step.
    """
    n, share = 4000, 1 - np.sqrt(0.5)
    problem = wl.LCP(
        wl.LinearOperator(lambda x: x, (n,), symmetric=True, diagonal=1.0, device=device),
        np.zeros(n),
    )
    residual, x = NaturalResidual(problem), problem.layout.zeros(wp.float64)
    made = NonsmoothMap(problem, residual, MapForm.FISCHER, 1.0, Kink.RANDOM)
    residual.evaluate(x)
    shift, r = (problem.layout.zeros(wp.float64) for _ in range(2))
    free, drawn = problem.layout.zeros(wp.uint8), []
    for turn in (1, 2):
        made.condense(x, shift, r, free, 1.0, turn)
        drawn.append(shift.numpy().copy())
        assert free.numpy().all()
        assert share <= drawn[-1].min() < 1.1 * share
        assert 1 / (1.1 * share) < drawn[-1].max() <= 1 / share
        # p and q have equal distributions
        assert np.mean(drawn[-1] < 1) == pytest.approx(0.5, abs=0.05)
        assert np.abs(r.numpy()).max() == 0  # f = 0 at a kink
    assert np.abs(np.corrcoef(*drawn)[0, 1]) < 0.1


def grid_at_kinks(seed, bounds):
    """Return cells, b and x on a grid with AIR and SOLID.

    Integers, so that y = 0 is exact in half of the cells that are at a bound.
    """
    rng = np.random.default_rng(seed)
    cells = rng.choice(3, (5, 7, 6), p=[0.1, 0.8, 0.1])
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells)
    A, n = dense[np.ix_(fluid, fluid)], int(fluid.sum())
    lower, upper = (np.full(n, side) for side in bounds)
    x = np.where(
        rng.random(n) < 0.5, lower if np.isfinite(bounds[0]) else upper, rng.integers(-3, 4, n)
    )
    y = np.where(rng.random(n) < 0.5, 0.0, rng.integers(-6, 7, n))
    return cells, fluid, A, y - A @ x, lower, upper, x


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("bounds", [(0.0, np.inf), (-2.0, 2.0), (-np.inf, 1.0)])
@pytest.mark.parametrize("kink", ["perturbation", "zero"])
@pytest.mark.parametrize("share", [1.0, 0.6])
def test_systems_over_the_rows_of_a_grid_are_those_of_the_definition(bounds, kink, share):
    """Systems over the rows of a grid against the definition.

    The one pass that moves x, evaluates y there and condenses: D is added to A's diagonal, in units
    of `scale`.
    """
    cells, fluid, A, b, lower, upper, x = grid_at_kinks(4013, bounds)
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), _on(fluid, b, cells.shape), *bounds)
    work = FischerNewton(kink=kink, fischer_weight=share, precision="double").init(problem)
    layout, place = problem.layout, problem.layout.places()[fluid]
    field, move = (
        layout.load(_on(fluid, v, cells.shape), wp.float64) for v in (x - 0.5, np.full(len(x), 2.0))
    )
    finest, scale = work.system.hierarchy.finest, 0.125
    work.residual.start(work.x, keep=False)  # reads the size of b
    work.map.begin()
    merit = work.map.step(field, move, 0.25, finest, scale, 1)
    plain = PlainMap("fischer" if share == 1 else "penalized", A, b, lower, upper, share=share)
    f, p, q, kinks = plain.rows(x)
    q, moves = np.maximum(q, LEAST_Q), ~kinks if kink == "zero" else np.full(len(x), True)
    assert 10 < kinks.sum() < len(x) - 10
    D, r = (v.numpy().ravel()[place] for v in (finest.stencil.d, finest.b))
    np.testing.assert_array_equal(field.numpy()[place], x)
    np.testing.assert_allclose(D, np.where(moves, plain.d * (1 + p / q), 0.0), rtol=1e-8)
    np.testing.assert_allclose(r, np.where(moves, -scale * f / q, 0.0), rtol=1e-8, atol=1e-13)
    assert merit == pytest.approx(0.5 * f @ f, rel=1e-12)
    assert work.map.norm == pytest.approx(np.sqrt(np.sum(r[moves] ** 2 / D[moves])), rel=1e-10)
    y = A @ x + b
    own = np.maximum(np.minimum(y, plain.d * (x - lower)), plain.d * (x - upper))
    assert work.residual.norm == pytest.approx(np.linalg.norm(own), rel=1e-12)


def _on(fluid, values, shape):
    """Return a field with values on FLUID cells."""
    field = np.zeros(fluid.size)
    field[fluid] = values
    return field.reshape(shape)
