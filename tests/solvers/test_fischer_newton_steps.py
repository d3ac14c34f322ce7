"""Fischer-Newton, iterate by iterate against a plain loop.

Systems, kinks, searches, and the end at a minimum of the merit that is no solution.
"""

import math

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering, slow
from method_steps import iterates, steps_of
from oracle import assemble
from plain_fischer import LEAST_Q, PlainMap, armijo
from warp_lcp.gallery.contact_scenes import contact
from warp_lcp.solvers.fischer_newton import FischerDenseWorkspace, FischerNewton
from warp_lcp.solvers.gradient_descent import GradientDescent
from warp_lcp.subproblems.nonsmooth_map import NonsmoothMap

BOUNDS = [(0.0, np.inf), (-1.0, 0.5), (-np.inf, 0.25), (-np.inf, np.inf)]
# A merit with a minimum that is no solution, between the bounds, and its place: A has the
# eigenvalue -1/4, d = 1.
MINIMUM = (
    1.625 * np.eye(3) - 0.625,
    np.array([-0.5, -0.25, 0.0]),
    np.array([0.3336377713533389, 0.20990309578279476, 0.09239497058182793]),
)


def unlike_rows(seed, n=9):
    """Return rows of every kind, unsymmetric, with x at bounds.

    Three of the rows have y = 0. Entries are whole numbers over 8, so that kinks are exact.
    """
    rng = np.random.default_rng(seed)
    A = rng.integers(-7, 8, (n, n)) / 8
    np.fill_diagonal(A, 1.0)
    lower, upper = np.array([BOUNDS[k % 4] for k in range(n)]).T
    x = np.where(
        rng.random(n) < 0.6, np.where(np.isfinite(lower), lower, 0.25), rng.integers(-6, 7, n) / 8
    )
    y = np.where(np.arange(n) < 3, 0.0, rng.integers(-12, 13, n) / 8)
    x[:3] = [0.0, 0.5, 0.25]  # at l, u, u
    x = np.clip(x, lower, upper)
    return A, y - A @ x, lower, upper, x


def shifted_direction(plain, x, drops):
    """Return e of (A + D) e = -f / q, D = d p / q, q at least 1e-6.

    Without the rows that do not move.
    """
    f, p, q, kinks = plain.rows(x)
    q, moves = np.maximum(q, LEAST_Q), ~kinks if drops else np.full(len(x), True)
    e = np.zeros(len(x))
    e[moves] = np.linalg.solve(
        (plain.A + np.diag(plain.d * p / q))[np.ix_(moves, moves)], -(f / q)[moves]
    )
    return e


def jacobian_direction(plain, x, drops):
    """Return e of J e = -f, without the rows that do not move."""
    f, _, _, kinks = plain.rows(x)
    moves, e = ~kinks if drops else np.full(len(x), True), np.zeros(len(x))
    e[moves] = np.linalg.solve(plain.jacobian(x)[np.ix_(moves, moves)], -f[moves])
    return e


def regularized_direction(plain, x, drops):
    """Return -(J'J + 1e-6 min(1, |f|) I)^-1 J'f."""
    f, J = plain.rows(x)[0], plain.jacobian(x)
    return -np.linalg.solve(J.T @ J + 1e-6 * min(1.0, np.linalg.norm(f)) * np.eye(len(x)), J.T @ f)


def plain_newton(plain, x, steps, direction, *, drops=False, memory=1):
    """Return x after each step of [Book] algorithm 12, and the step lengths.

    Searched along the projected path if the memory is 1.
    """
    found, merits = [], []
    for _ in range(steps):
        e, f = direction(plain, x, drops), plain.rows(x)[0]
        merits = [*merits, plain.merit(x)][-memory:]

        def along(t, x=x, e=e):
            return np.clip(x + t * e, plain.lower, plain.upper) if memory == 1 else x + t * e

        t = armijo(plain.merit, along, max(merits), float(f @ plain.jacobian(x) @ e))
        x = along(t)
        found.append((x, t))
    return found


def operators(A, device):
    return wl.SparseOperator(scipy.sparse.csr_array(A), device=device), wl.LinearOperator(
        lambda x: A @ x, (len(A),), diagonal=np.diag(A)
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("kink", "share", "safeguard"),
    covering(["perturbation", "zero"], [1.0, 0.6], [False, True], count=4),
)
def test_matrix_free_steps_are_those_of_the_algorithm(kink, share, safeguard, device):
    """Matrix-free steps against the algorithm.

    Systems are solved to rounding, so that iterates differ by that alone; the search shortens some
    steps.
    """
    lengths = []
    for seed in (4205, 4207, 4209):
        A, b, lower, upper, x0 = unlike_rows(seed)
        plain = PlainMap("fischer" if share == 1 else "penalized", A, b, lower, upper, share=share)
        assert plain.rows(x0)[3].sum() >= 3
        expected = plain_newton(
            plain, x0, 5, shifted_direction, drops=kink == "zero", memory=8 if safeguard else 1
        )
        lengths += [t for _, t in expected]
        method = FischerNewton(
            kink=kink, fischer_weight=share, safeguard=safeguard, precision="double", eta=1e-14
        )
        for operator in operators(A, device):
            problem = wl.LCP(operator, b, lower, upper)
            # Unit of the map.
            np.testing.assert_allclose(method.init(problem).residual.diagonal.numpy(), plain.d)
            for x, (y, _) in zip(iterates(problem, method, 5, x0), expected, strict=True):
                np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-10)
    assert min(lengths) < 1


@pytest.mark.parametrize("kink", ["perturbation", "zero"])
@pytest.mark.parametrize("share", [1.0, 0.6])
def test_unscaled_steps_are_those_of_the_algorithm(kink, share, device):
    """Unscaled steps against the algorithm.

    d = 1 whatever A's diagonal is, on the host and matrix-free; those of the scaled map differ.
    """
    method = FischerNewton(
        kink=kink,
        fischer_weight=share,
        safeguard=False,
        scaled=False,
        precision="double",
        eta=1e-14,
    )
    for seed in (4205, 4207, 4213):
        A, b, lower, upper, x0 = unlike_rows(seed)
        b, A = b - np.arange(9) / 2 * x0, A + np.diag(np.arange(9) / 2)  # y unchanged
        plain = PlainMap("fischer" if share == 1 else "penalized", A, b, lower, upper, share=share)
        scaled = plain_newton(plain, x0, 4, shifted_direction, drops=kink == "zero")
        plain.d = np.ones(9)
        assert plain.rows(x0)[3].sum() >= 3
        expected = plain_newton(plain, x0, 4, shifted_direction, drops=kink == "zero")
        assert np.abs(scaled[0][0] - expected[0][0]).max() > 1e-5
        for operator in operators(A, device):
            for x, (y, _) in zip(
                iterates(wl.LCP(operator, b, lower, upper), method, 4, x0), expected, strict=True
            ):
                np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)
        problem = wl.LCP(wl.DenseOperator(A, device=device), b, lower, upper)
        expected = plain_newton(plain, x0, 4, jacobian_direction, drops=kink == "zero")
        for x, (y, _) in zip(iterates(problem, method, 4, x0), expected, strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)


def test_unscaled_gradients_are_those_of_the_map():
    """Gradients of the unscaled map.

    The projected gradient is J'f: the direction of gradient descent, and 0 at a minimum.
    """
    A, b, lower, upper, x0 = unlike_rows(4207)
    A = A + np.diag(np.arange(9) / 2)
    plain = PlainMap("fischer", A, b, lower, upper)
    plain.d = np.ones(9)
    operator = wl.SparseOperator(scipy.sparse.csr_array(A), device="cpu")
    problem, x0 = wl.LCP(operator, b, lower, upper), x0 + 0.125
    work = FischerNewton(safeguard=False, scaled=False, fischer_weight=1.0).init(problem)
    work.x.assign(x0)
    work.residual.evaluate(work.x)
    work.start(warm=True, tolerance=0.0)
    work.map.descend(work.x)
    np.testing.assert_allclose(
        work.map.direction.numpy(), plain.jacobian(x0).T @ plain.rows(x0)[0], rtol=1e-12, atol=1e-12
    )
    method = FischerNewton(safeguard=False, scaled=False, fischer_weight=1.0)
    assert method.descent(problem) == GradientDescent(
        map="fischer", fischer_weight=1.0, scaled=False
    )


def test_unscaled_maps_have_no_safeguards():
    with pytest.raises(ValueError, match=r"scaled = False: needs safeguard = False"):
        FischerNewton(scaled=False)


@pytest.mark.parametrize("kink", ["perturbation", "zero"])
def test_plain_steps_on_the_host_are_those_of_the_algorithm(kink):
    """Plain steps on the host against the algorithm.

    In units in which A is equilibrated, here 1: the diagonal is 1 and no entry is larger.
    """
    lengths = []
    for seed in (4216, 4218, 4220, 4222, 4229, 4230):
        A, b, lower, upper, x0, plain = unit_rows(seed, share=0.95)
        expected = plain_newton(plain, x0, 4, jacobian_direction, drops=kink == "zero")
        lengths += [t for _, t in expected]
        problem = wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper)
        for x, (y, _) in zip(
            iterates(problem, FischerNewton(kink=kink, safeguard=False), 4, x0),
            expected,
            strict=True,
        ):
            np.testing.assert_allclose(x, y, rtol=1e-8, atol=1e-9)
    assert min(lengths) < 1


def test_safeguarded_steps_on_the_host_are_those_of_the_algorithm():
    """Safeguarded steps on the host against the algorithm.

    The regularized stage: its iterates may leave the bounds, its search uses the last eight merits.
    """
    outside, lengths = 0, []
    for seed in (4216, 4218, 4220, 4222, 4229, 4230):
        A, b, lower, upper, x0, plain = unit_rows(seed, share=0.95)
        expected = plain_newton(plain, x0, 4, regularized_direction, memory=8)
        lengths += [t for _, t in expected]
        problem = wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper)
        for (work, step), (y, _) in zip(
            steps_of(problem, FischerNewton(), 4, x0), expected, strict=True
        ):
            assert step.failure is None
            np.testing.assert_allclose(work._iterate, y, rtol=1e-7, atol=1e-8)
            outside += int(((y < lower) | (y > upper)).any())
    assert outside > 3
    assert min(lengths) < 1


def smoothed_row(a, y, c, low, high, mu):
    """Return f of psi_mu(a, b), and its derivatives by x / d and by y.

    The map is psi_mu(a, b) = a + b - sqrt(a^2 + b^2 + 2 mu).
    """

    def psi(a, b):
        rho = math.sqrt(a * a + b * b + 2 * mu)
        return a + b - rho, 1 - a / rho, 1 - b / rho

    f, p, q = y, 0.0, 1.0
    if high:
        f, q, p = psi(-y, c)
        f = -f
    if low:
        f, by_a, by_h = psi(a, f)
        p, q = by_a + by_h * p, by_h * q
    return f, p, q


@pytest.mark.parametrize("stage", [0, 1])
def test_steps_of_the_homotopies_are_those_of_the_smoothed_map(stage):
    """Steps of the homotopies against the smoothed map.

    Newton for A x + b = y and f_mu(x, y) = 0 at once, halved until (|A x + b - y|, |f_mu|) falls;
    mu falls by 0.3, then by 0.5 from 10.
    """
    halved = 0
    for seed in (4211, 4216, 4221, 4223, 4224, 4233):
        A, b, lower, upper, x, _ = unit_rows(seed, share=0.95)
        low, high = np.isfinite(lower), np.isfinite(upper)
        work = FischerNewton().init(wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper))
        work.x.assign(x)
        work.residual.evaluate(work.x)
        work.start(warm=True, tolerance=0.0)
        for _ in range(stage + 1):
            work._next_stage()
        x = np.clip(10.0, lower, upper) if stage else x
        y, mu = np.where(low & ~high, np.maximum(A @ x + b, 1.0), A @ x + b), 1.0
        np.testing.assert_allclose(work._y, y)
        # So far from A x + b that the gap decides, too, about the length of steps.
        y = work._y = y - 4.0 * (seed % 2)

        def map_at(x, y, mu, low=low, high=high, lower=lower, upper=upper):
            rows = [
                smoothed_row(x[i] - lower[i], y[i], upper[i] - x[i], low[i], high[i], mu)
                for i in range(len(x))
            ]
            return tuple(np.array(column) for column in zip(*rows, strict=True))

        for _ in range(6):
            work._homotopy()
            gap, (f, p, q) = A @ x + b - y, map_at(x, y, mu)
            dx = np.linalg.solve(np.diag(p) + q[:, None] * A, -f - q * gap)
            dy, t, size = A @ dx + gap, 1.0, math.hypot(np.linalg.norm(gap), np.linalg.norm(f))
            while t > 1e-6:
                after = math.hypot(
                    *(
                        np.linalg.norm(v)
                        for v in (
                            A @ (x + t * dx) + b - y - t * dy,
                            map_at(x + t * dx, y + t * dy, mu)[0],
                        )
                    )
                )
                if after <= (1 - 1e-4 * t) * size:
                    break
                t, halved = t / 2, halved + 1
            x, y, mu = x + t * dx, y + t * dy, (0.5 if stage else 0.3) * mu
            np.testing.assert_allclose(work._iterate, x, rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(work._y, y, rtol=1e-8, atol=1e-9)
    assert halved > 0


def test_gradient_steps_are_those_of_the_algorithm():
    """Gradient steps against [Book] algorithm 13.

    x = clip(x - t d^-2 J'f), t halved from Barzilai and Borwein's length until the merit falls.
    """
    halved = 0
    for seed, form in (
        (4205, "fischer"),
        (4207, "penalized"),
        (4209, "natural"),
        (4213, "fischer"),
    ):
        A, b, lower, upper, x = unlike_rows(seed)
        plain, method = (
            PlainMap(form, A, b, lower, upper, share=0.95),
            GradientDescent(map=form, memory=3),
        )
        merits, length, last = [], 1.0, None
        for got in iterates(
            wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper), method, 8, x
        ):
            g = plain.jacobian(x).T @ plain.rows(x)[0] / plain.d
            if last is not None:
                change = 1 - g @ last / (last @ last)
                length = length / change if change > 1e-6 else 10 * length
            last, merits = g, [*merits, plain.merit(x) * (1 - 1e-12)][-3:]
            while plain.merit(np.clip(x - length * g / plain.d, lower, upper)) > max(merits):
                length, halved = length / 2, halved + 1
            x = np.clip(x - length * g / plain.d, lower, upper)
            np.testing.assert_allclose(got, x, rtol=1e-9, atol=1e-10)
    assert halved > 0


def unit_rows(seed, share, n=7):
    """Return a problem already in the host's units, and its map; two rows at kinks."""
    rng = np.random.default_rng(seed)
    A = rng.uniform(-0.99, 0.99, (n, n))
    np.fill_diagonal(A, 1.0)
    lower, upper = np.array([BOUNDS[k % 4] for k in range(n)]).T
    x = np.clip(np.round(0.3 * rng.standard_normal(n), 1), lower, upper)
    b = rng.standard_normal(n)
    b /= np.abs(b[1:4]).max()
    x[[0, 4]] = 0.0
    b = np.clip(b, -1, 1)
    b[[0, 4]] = -(A @ x)[[0, 4]]
    problem = wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper)
    work = FischerNewton().init(problem)
    assert isinstance(work, FischerDenseWorkspace)
    work.residual.evaluate(work.x)
    work.start(warm=False, tolerance=0.0)
    np.testing.assert_array_equal(work.units, np.ones(n))
    np.testing.assert_array_equal(work.map.data.A, A)
    np.testing.assert_array_equal(work.map.data.b, b)
    return A, b, lower, upper, x, PlainMap("penalized", A, b, lower, upper, share=share)


@pytest.mark.parametrize("kink", ["perturbation", "zero"])
@pytest.mark.parametrize(
    ("share", "safeguard", "scaled"),
    [
        (1.0, False, True),
        (0.6, True, True),
        (1.0, False, False),
        slow((0.6, False, True)),
        slow((1.0, True, True)),
        slow((0.6, False, False)),
    ],
)
def test_steps_on_a_grid_are_those_of_the_algorithm(kink, share, safeguard, scaled):
    """Steps on a grid against the algorithm.

    They are the passes over rows, from x = 0 on walls, half of them with y = 0.
    """
    rng = np.random.default_rng(4221)
    cells = rng.choice(3, (4, 5, 4), p=[0.1, 0.8, 0.1])
    cells[0, 0, 0] = wl.AIR
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells)
    A, n = dense[np.ix_(fluid, fluid)], int(fluid.sum())
    x0 = np.where(rng.random(n) < 0.6, 0.0, rng.integers(1, 5, n))
    b = np.where(rng.random(n) < 0.4, 0.0, rng.integers(-6, 7, n)) - A @ x0
    plain = PlainMap(
        "fischer" if share == 1 else "penalized", A, b, np.zeros(n), np.full(n, np.inf), share=share
    )
    plain.d = plain.d if scaled else np.ones(n)
    assert plain.rows(x0)[3].sum() > 5
    expected = plain_newton(
        plain, x0, 5, shifted_direction, drops=kink == "zero", memory=8 if safeguard else 1
    )
    fields = [np.zeros(cells.size) for _ in range(2)]
    for field, values in zip(fields, (b, x0), strict=True):
        field[fluid] = values
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), fields[0].reshape(cells.shape))
    method = FischerNewton(
        kink=kink,
        fischer_weight=share,
        safeguard=safeguard,
        scaled=scaled,
        precision="double",
        eta=1e-14,
        monotone_cycles=0,
    )
    place = problem.layout.places()[fluid]
    for x, (y, _) in zip(
        iterates(problem, method, 5, fields[1].reshape(cells.shape)), expected, strict=True
    ):
        np.testing.assert_allclose(x[place], y, rtol=1e-6, atol=1e-6)


def test_slope_is_the_derivative_of_the_merit_along_any_direction(device):
    """Slope as the derivative of the merit along any direction.

    Against central differences, and against J'f, which needs products with A'.
    """
    rng = np.random.default_rng(4231)
    A, b, lower, upper, _ = unlike_rows(4231)
    x, e = rng.standard_normal((2, 9))
    plain = PlainMap("penalized", A, b, lower, upper, share=0.6)
    for operator in operators(A, device)[:1]:
        problem = wl.LCP(operator, b, lower, upper)
        work = FischerNewton(fischer_weight=0.6).init(problem)
        assert isinstance(work.map, NonsmoothMap)
        work.x.assign(x)
        work.residual.evaluate(work.x)
        work.start(warm=True, tolerance=0.0)
        for dtype in (wp.float64, wp.float32):
            got = work.map.slope(work.x, wp.array(e, dtype=dtype, device=device))
            assert got == pytest.approx(
                plain.rows(x)[0] @ plain.jacobian(x) @ e, rel=1e-6 if dtype is wp.float32 else 1e-12
            )
        assert got == pytest.approx(
            (plain.merit(x + 1e-6 * e) - plain.merit(x - 1e-6 * e)) / 2e-6, rel=1e-5
        )


def test_inexact_directions_are_searched_by_their_own_slope():
    """Search of inexact directions by their own slope.

    Equations with A = [[s, 1], [-1, s]]: an iteration of GMRES finds e = -s / (1 + s^2) y. Along it
    the merit falls by s^2 of itself, less than an exact direction promises. A search with the slope
    -f'f refuses every step.
    """
    s = 5e-3
    A = np.array([[s, 1.0], [-1.0, s]])
    problem = wl.LCP(
        wl.LinearOperator(lambda x: A @ x, (2,), diagonal=s, transpose=lambda x: A.T @ x),
        np.array([1.0, 2.0]),
        -np.inf,
    )
    method = FischerNewton(safeguard=False, max_linear_iterations=1, precision="double")
    for x, k in zip(iterates(problem, method, 4, np.zeros(2)), range(1, 5), strict=True):
        y = A @ x + [1.0, 2.0]
        assert y @ y == pytest.approx(5.0 / (1 + s**2) ** k, rel=1e-9)


def test_directions_that_lead_up_are_not_searched():
    """Ascent directions: no search.

    The slope of a reversed direction is above 0, which ends the step after one trial; 27 halvings
    would find nothing better.
    """
    A, b, lower, upper, x0 = unlike_rows(4241)
    problem = wl.LCP(wl.SparseOperator(scipy.sparse.csr_array(A), device="cpu"), b, lower, upper)
    method = FischerNewton(safeguard=False, precision="double")
    work = method.init(problem)
    work.x.assign(x0)
    work.residual.evaluate(work.x)
    work.start(warm=True, tolerance=0.0)
    solve, trial, trials = work.system.solve, work._trial, []

    def turned(tolerance, most):
        done = solve(tolerance, most)
        work.system.e.assign(-work.system.e.numpy())
        return done

    work.system.solve = turned
    work._trial = lambda x, scale: trials.append(scale) or trial(x, scale)
    step = method.step(problem, work, work.x)
    assert step.failure is wl.SolveStatus.NON_DESCENT
    assert len(trials) == 1
    np.testing.assert_array_equal(work.x.numpy(), x0)


@pytest.mark.parametrize("kind", ["dense", "sparse", "products"])
def test_a_minimum_of_the_merit_that_is_no_solution_is_called_one(kind):
    A, b, at = MINIMUM
    plain = PlainMap("fischer", A, b, np.zeros(3), np.full(3, np.inf))
    assert np.linalg.norm(plain.jacobian(at).T @ plain.rows(at)[0]) < 1e-8
    assert plain.merit(at) > 0.3
    for share in (1.0, 0.999999):
        result = wl.solve(
            wl.LCP(of_kind(kind, A), b), FischerNewton(safeguard=False, fischer_weight=share), x0=at
        )
        assert result.status is wl.SolveStatus.LOCAL_MINIMUM
        np.testing.assert_allclose(result.x.numpy(), at, atol=1e-4)


@pytest.mark.parametrize("kind", ["dense", "sparse", "products"])
def test_a_bound_may_make_the_minimum(kind):
    """Minimum at a bound.

    y = -x - 1 with x >= 0: the merit would fall beyond x = 0 alone; plain iterates stay within the
    bounds.
    """
    problem = wl.LCP(of_kind(kind, np.array([[-1.0]])), np.array([-1.0]))
    assert (
        wl.solve(problem, FischerNewton(safeguard=False, fischer_weight=1.0)).status
        is wl.SolveStatus.LOCAL_MINIMUM
    )


def test_products_alone_do_not_identify_a_minimum():
    A, b, at = MINIMUM
    problem = wl.LCP(
        wl.LinearOperator(lambda x: A @ x, (3,), diagonal=np.diag(A), symmetric=False), b
    )
    assert (
        wl.solve(problem, FischerNewton(safeguard=False), x0=at).status
        is wl.SolveStatus.NON_DESCENT
    )


def test_a_failed_search_elsewhere_is_no_minimum():
    """Failed search that is no minimum.

    Contacts where plain steps end: the Jacobian is singular, the gradient as large as f.
    """
    statuses = []
    for seed in (13, 15, 17, 23):
        p = contact(20, seed=seed)
        statuses.append(
            wl.solve(
                wl.LCP(wl.DenseOperator(p.A, device="cpu"), p.b),
                FischerNewton(safeguard=False, fischer_weight=0.95),
            ).status
        )
    assert wl.SolveStatus.NON_DESCENT in statuses
    assert wl.SolveStatus.LOCAL_MINIMUM not in statuses


def of_kind(kind, A):
    """Return an operator with entries or with products alone."""
    if kind == "dense":
        return wl.DenseOperator(A, device="cpu")
    if kind == "sparse":
        return wl.SparseOperator(scipy.sparse.csr_array(A), device="cpu")
    return wl.LinearOperator(
        lambda x: A @ x, (len(A),), diagonal=np.diag(A), symmetric=bool((A == A.T).all())
    )


def test_the_plain_search_is_armijos():
    """Plain search by Armijo's rule: the reference itself."""
    assert armijo(lambda x: 0.5 * x * x, lambda t: 1 - t, 0.5, -1.0) == 1.0
    assert armijo(lambda x: math.inf, lambda t: t, 0.5, -1.0) == 0.0
