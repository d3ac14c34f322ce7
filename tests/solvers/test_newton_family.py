"""Interior point, Fischer-Newton, gradient descent, minimum map's safeguard.

They have guarantees beyond the table of all methods.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from matrices import posed_dense
from oracle import assemble, boxed, lemke, natural_residual
from warp_lcp.gallery.contact_scenes import contact
from warp_lcp.gallery.matrices import semidefinite
from warp_lcp.gallery.obstacle import ball_obstacle
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.solvers.fischer_newton import FischerNewton
from warp_lcp.solvers.gradient_descent import GradientDescent
from warp_lcp.solvers.interior_point import InteriorPoint
from warp_lcp.subproblems.energy_monitor import NonmonotoneSearch
from warp_lcp.subproblems.nonsmooth_map import Kink, MapForm, NonsmoothMap

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=300)
KINKS = [k.value for k in Kink]
PENALIZED = FischerNewton(fischer_weight=0.95)
PERIOD_THREE = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])


def random_boxed(rng, n=6):
    """Return an unsymmetric positive definite problem with every kind of row."""
    B, C = rng.standard_normal((2, n, n))
    lower, upper = -rng.random(n), rng.random(n)
    lower[0], upper[1], (lower[2], upper[2]) = -np.inf, np.inf, (0.3, 0.3)
    lower[3], upper[3] = -np.inf, np.inf
    return B @ B.T + 0.2 * np.eye(n) + C - C.T, 2 * rng.standard_normal(n), lower, upper


def is_near(progress):
    """Return whether the residual has fallen to a hundredth.

    The active set is then known: the crossover.
    """
    return progress.norms[-1] <= 1e-2 * progress.norms[0]


METHODS = [
    InteriorPoint(),
    InteriorPoint(mehrotra=False),
    wl.Fallback(InteriorPoint(), (wl.MinimumMapNewton(), is_near)),
    *(
        FischerNewton(kink=k, safeguard=s, fischer_weight=c)
        for k in KINKS
        for s, c in ((True, 0.95), (False, 1.0))
    ),
    FischerNewton(warm_start=3),
]


@pytest.mark.parametrize("method", METHODS, ids=lambda m: repr(m)[:90])
def test_boxed_mixed_and_held_rows(method):
    """Boxed, mixed and held rows, with exhaustive search as the oracle.

    Exchanged bounds or a wrong sign of y in one row would move the solution.
    """
    rng = np.random.default_rng(2203)
    for _ in range(3):
        A, b, lower, upper = random_boxed(rng)
        result = wl.solve(posed_dense(A, b, lower, upper), method, stopping=TIGHT)
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), boxed(A, b, lower, upper), atol=1e-8)


@pytest.mark.parametrize(
    "method", [InteriorPoint(), FischerNewton(), GradientDescent()], ids=lambda m: type(m).__name__
)
def test_equations_alone_are_a_linear_solve(method):
    rng = np.random.default_rng(2207)
    B = rng.standard_normal((12, 12))
    A, b = B @ B.T / 12 + np.eye(12), rng.standard_normal(12)
    result = wl.solve(
        posed_dense(A, b, -np.inf),
        method,
        stopping=wl.StoppingCriteria(rtol=1e-9, max_iterations=2000),
    )
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), np.linalg.solve(A, -b), atol=1e-7)


@pytest.mark.parametrize("kink", KINKS)
def test_one_unknown(kink):
    """Problem of one unknown.

    Directions of norm 1 and units of 1: guards that compare with another number than 0 would show.
    """
    for a, b, expected in ((1.0, -3.0, 3.0), (1.0, 2.0, 0.0), (4.0, -2.0, 0.5)):
        result = wl.solve(
            posed_dense(np.array([[a]]), np.array([b])), FischerNewton(kink=kink), stopping=TIGHT
        )
        assert result and result.x.numpy() == pytest.approx([expected], abs=1e-9)


def test_finite_differences_step_on_a_grid_with_walls_as_on_the_matrix_of_its_unknowns():
    rng = np.random.default_rng(2219)
    cells = rng.choice(3, (6, 7, 5), p=[0.2, 0.6, 0.2])
    fluid, b = cells.ravel() == wl.FLUID, rng.standard_normal(cells.shape)
    matrix = scipy.sparse.csr_array(assemble(cells)[np.ix_(fluid, fluid)])
    method = FischerNewton(kink="approximation")
    grid = wl.solve(wl.LCP(wl.GridPoisson(cells, device="cpu"), b), method, stopping=TIGHT)
    unknowns = wl.solve(
        wl.LCP(wl.SparseOperator(matrix, device="cpu"), b.ravel()[fluid]), method, stopping=TIGHT
    )
    assert grid and unknowns
    assert (grid.iterations, grid.linear_iterations) == (
        unknowns.iterations,
        unknowns.linear_iterations,
    )
    np.testing.assert_allclose(grid.x.numpy().ravel()[fluid], unknowns.x.numpy(), atol=1e-8)


@pytest.mark.parametrize(
    "method",
    [
        InteriorPoint(),
        InteriorPoint(precision="double"),
        FischerNewton(),
        FischerNewton(fischer_weight=0.95),
    ],
)
@pytest.mark.parametrize("upper", [np.inf, 0.4])
def test_grid_against_a_dense_matrix(method, upper, device):
    rng = np.random.default_rng(2213)
    cells = rng.choice(3, (6, 7, 5), p=[0.1, 0.8, 0.1])
    cells[0, 0, 0] = wl.AIR
    fluid, matrix, b = cells.ravel() == wl.FLUID, assemble(cells), rng.standard_normal(cells.shape)
    result = wl.solve(
        wl.LCP(wl.GridPoisson(cells, device=device), b, 0.0, upper), method, stopping=TIGHT
    )
    assert result, result.status
    n = int(fluid.sum())
    block, x = matrix[np.ix_(fluid, fluid)], result.x.numpy().ravel()[fluid]
    free = (x > 1e-6) & (x < upper - 1e-6)
    expected = np.where(x > 1e-6, np.where(free, 0.0, upper), 0.0)
    expected[free] = np.linalg.solve(
        block[np.ix_(free, free)], -(b.ravel()[fluid] + block @ expected)[free]
    )
    np.testing.assert_allclose(x, expected, atol=1e-8)
    bounds = np.zeros(n), np.full(n, upper)
    assert natural_residual(block, b.ravel()[fluid], *bounds, expected) < 1e-9
    if np.isinf(upper):
        np.testing.assert_allclose(x, lemke(block, b.ravel()[fluid]), atol=1e-8)


@pytest.mark.parametrize(
    "method", [InteriorPoint(), FischerNewton()], ids=lambda m: type(m).__name__
)
def test_unsymmetric_sparse_matrix(method):
    rng = np.random.default_rng(2221)
    S = scipy.sparse.random_array((40, 40), density=0.1, rng=rng) + scipy.sparse.diags_array(
        np.full(40, 4.0)
    )
    b = rng.standard_normal(40)
    result = wl.solve(
        wl.LCP(wl.SparseOperator(S, device="cpu"), b),
        method,
        stopping=wl.StoppingCriteria(rtol=1e-9),
    )
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), lemke(S.toarray(), b), atol=1e-7)


@pytest.mark.parametrize("map_", list(MapForm))
def test_gradient_of_the_merit(map_):
    """Gradient of the merit.

    Against central differences at a point off the kinks: any wrong sign in p or q shows.
    """
    rng = np.random.default_rng(2237)
    A, b, lower, upper = random_boxed(rng)
    problem = posed_dense(A, b, lower, upper)
    residual, x = NaturalResidual(problem), rng.standard_normal(6)
    f = NonsmoothMap(problem, residual, map_, 0.7)

    def merit(point):
        field = wp.array(point, dtype=wp.float64, device="cpu")
        residual.evaluate(field)
        return f.merit(field), field

    field = merit(x)[1]
    square, _ = f.descend(field)
    d = np.abs(np.diag(A))
    gradient = f.direction.numpy() * d**2
    steps = 1e-6 * np.eye(6)
    expected = np.array([(merit(x + h)[0] - merit(x - h)[0]) / 2e-6 for h in steps])
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-6)
    assert square == pytest.approx(float(np.sum((gradient / d) ** 2)))


@pytest.mark.parametrize("map_", list(MapForm))
def test_maps_vanish_at_solutions_only(map_):
    rng = np.random.default_rng(2239)
    A, b, lower, upper = random_boxed(rng)
    problem = posed_dense(A, b, lower, upper)
    residual, x = NaturalResidual(problem), boxed(A, b, lower, upper)
    f = NonsmoothMap(problem, residual, map_, 0.95)
    values = []
    for point in (x, x + 0.01 * np.eye(6)[4], x - 0.01 * np.eye(6)[4]):
        field = wp.array(point, dtype=wp.float64, device="cpu")
        residual.evaluate(field)
        values.append(f.merit(field))
    assert values[0] < 1e-18
    assert min(values[1:]) > 1e-8


@pytest.mark.parametrize("map_", ["natural", "fischer", "penalized"])
def test_gradient_descent_on_a_grid(map_):
    rng = np.random.default_rng(2243)
    cells = np.ones((4, 5), dtype=int)
    cells[0] = wl.AIR
    fluid, b = cells.ravel() == wl.FLUID, rng.standard_normal((4, 5))
    result = wl.solve(
        wl.LCP(wl.GridPoisson(cells, device="cpu"), b),
        GradientDescent(map=map_),
        stopping=wl.StoppingCriteria(rtol=1e-6, max_iterations=5000),
    )
    assert result, result.status
    np.testing.assert_allclose(
        result.x.numpy().ravel()[fluid],
        lemke(assemble(cells)[np.ix_(fluid, fluid)], b.ravel()[fluid]),
        atol=1e-4,
    )


def test_statuses_of_gradient_descent():
    """Statuses of gradient descent.

    Each of the book's tests is reached on purpose; the last problem has y < 0 for all x >= 0.
    """
    rng = np.random.default_rng(2251)
    B = rng.standard_normal((30, 30))
    A, b = B @ B.T + 1e-3 * np.eye(30), rng.standard_normal(30)
    many = wl.StoppingCriteria(rtol=1e-12, max_iterations=500, patience=500)
    assert (
        wl.solve(posed_dense(A, b), GradientDescent(relative=0.5, memory=1), stopping=many).status
        is wl.SolveStatus.STAGNATED
    )
    assert (
        wl.solve(posed_dense(A, b), GradientDescent(stagnation=0.5), stopping=many).status
        is wl.SolveStatus.STAGNATED
    )
    assert (
        wl.solve(posed_dense(A, b), GradientDescent(gradient=1e3), stopping=many).status
        is wl.SolveStatus.LOCAL_MINIMUM
    )
    assert wl.solve(posed_dense(A, b), GradientDescent(), stopping=many).status in (
        wl.SolveStatus.MAX_ITERATIONS,
        wl.SolveStatus.STAGNATED,
    )
    none = wl.solve(
        posed_dense(np.array([[-1.0]]), np.array([-1.0])),
        GradientDescent(map="natural"),
        stopping=many,
    )
    assert none.status in (
        wl.SolveStatus.NON_DESCENT,
        wl.SolveStatus.LOCAL_MINIMUM,
        wl.SolveStatus.STAGNATED,
    )


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("contacts", [20, 30])
def test_safeguarded_fischer_solves_frictional_contacts(contacts):
    """Safeguarded Fischer-Newton on frictional contacts.

    All of 15 here (200 of 200 were measured). No other oracle is needed: the residual is
    recomputed.
    """
    steps = []
    for seed in range(15):
        problem = contact(contacts, seed=seed)
        result = wl.solve(posed_dense(problem.A, problem.b), FischerNewton())
        assert result, (seed, result.status)
        n = len(problem.b)
        own = natural_residual(
            problem.A, problem.b, np.zeros(n), np.full(n, np.inf), result.x.numpy()
        )
        assert own == pytest.approx(result.residual, rel=1e-6, abs=1e-12)
        steps.append(result.iterations)
    assert np.mean(steps) <= 20


def test_plain_fischer_fails_on_some_contacts_and_says_so():
    results = [
        wl.solve(posed_dense(p.A, p.b), FischerNewton(safeguard=False, fischer_weight=0.95))
        for p in (contact(20, seed=s) for s in range(12))
    ]
    failed = [r for r in results if not r]
    assert 0 < len(failed) < 12
    assert {r.status for r in failed} <= {
        wl.SolveStatus.NON_DESCENT,
        wl.SolveStatus.LOCAL_MINIMUM,
        wl.SolveStatus.MAX_ITERATIONS,
    }


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("zeros", [0.0, 0.4, 0.8])
def test_semidefinite_matrices(zeros):
    for seed in range(4):
        problem = semidefinite(60, zeros=zeros, seed=seed)
        for method in (FischerNewton(), InteriorPoint()):
            result = wl.solve(posed_dense(problem.A, problem.b), method)
            assert result, (type(method).__name__, seed, result.status)
        newton = wl.solve(posed_dense(problem.A, problem.b), wl.MinimumMapNewton())
        assert newton or newton.status in (wl.SolveStatus.NON_DESCENT, wl.SolveStatus.STAGNATED)


def test_minimum_map_newton_leaves_the_cycle_of_period_three():
    """Minimum-map Newton on the cycle of period three.

    From 80 random starts, half of them with random sets at the bound; plain Newton-min cycles from
    most of them.
    """
    problem, rng = posed_dense(PERIOD_THREE, -np.ones(3)), np.random.default_rng(3)
    solver = wl.MinimumMapNewton()
    work = solver.init(problem)
    for k in range(80):
        x0 = (
            np.where(rng.random(3) < 0.5, 0.0, rng.uniform(0.1, 5.0, 3))
            if k % 2
            else rng.uniform(-5, 5, 3)
        )
        result = wl.solve(problem, solver, x0=x0, workspace=work, stopping=TIGHT)
        assert result, (k, result.status)
        np.testing.assert_allclose(PERIOD_THREE @ result.x.numpy(), np.ones(3), atol=1e-8)


def test_levenberg_marquardt_steps_lower_the_residual_from_anywhere():
    """Levenberg-Marquardt steps, which lower the residual from anywhere.

    They follow where no share of Newton's step descends: a descent direction, on P-matrices all the
    way to a solution.
    """
    rng = np.random.default_rng(229)
    for n in (3, 8, 20):
        B, S = rng.standard_normal((2, n, n))
        A, b, high = (
            B @ B.T / n + 0.1 * np.eye(n) + S - S.T,
            rng.standard_normal(n),
            rng.uniform(0.5, 2.0, n),
        )
        work = wl.MinimumMapNewton().init(wl.LCP(wl.DenseOperator(A, device="cpu"), b, 0.0, high))
        for _ in range(10):
            before = high * rng.random(n)
            work.x.assign(before)
            assert work.system.damped.take_shortest_step(work.x, work.residual)
            own = [natural_residual(A, b, np.zeros(n), high, x) for x in (before, work.x.numpy())]
            assert own[1] < own[0]


@pytest.mark.parametrize(
    ("method", "growth"),
    [(wl.MinimumMapNewton(), 2), (FischerNewton(), 2), (InteriorPoint(), 4)],
    ids=lambda m: type(m).__name__,
)
def test_ball_obstacle_iterations_do_not_grow(method, growth):
    counts = [wl.solve(ball_obstacle(n, device="cpu").lcp(), method) for n in (65, 129, 257)]
    assert all(counts)
    assert max(r.iterations for r in counts) - counts[0].iterations <= growth


def test_crossover_hands_over_to_the_active_set():
    rng = np.random.default_rng(2267)
    B = rng.standard_normal((30, 30))
    A, b = B @ B.T / 30 + np.eye(30), rng.standard_normal(30)
    result = wl.solve(
        posed_dense(A, b),
        wl.Fallback(InteriorPoint(), (wl.MinimumMapNewton(), is_near)),
        stopping=TIGHT,
    )
    names = [record.step for record in result.history]
    assert "predictor-corrector" in names
    assert names[-1] == "newton"
    np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-10)


def test_units_of_x_do_not_matter():
    """Units of x without influence.

    Columns scaled by c and bounds by 1 / c: the same steps, since residuals and maps have d (x -
    l).
    """
    rng = np.random.default_rng(2269)
    B = rng.standard_normal((20, 20))
    A, b = B @ B.T / 20 + np.eye(20), rng.standard_normal(20)
    for method in (FischerNewton(safeguard=False), InteriorPoint()):
        small = wl.solve(posed_dense(A, b), method, stopping=TIGHT)
        large = wl.solve(posed_dense(A * 2.0**20, b), method, stopping=TIGHT)
        assert small.iterations == large.iterations
        np.testing.assert_allclose(large.x.numpy() * 2.0**20, small.x.numpy(), atol=1e-9)


def test_nonmonotone_search_remembers():
    search = NonmonotoneSearch(memory=2)
    search.store_merit(9.0)
    search.store_merit(1.0)
    # Above the last merit, below the largest of two.
    assert search.search(lambda t: 5.0, -1e-3) == (1.0, 5.0)
    search.store_merit(5.0)
    assert search.search(lambda t: 6.0, -1e-3)[0] == 0.0
    assert search.search(lambda t: 4.0 if t < 0.3 else float("nan"), -1e-3)[0] == 0.25


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: InteriorPoint(backoff=1.0), "backoff"),
        (lambda: InteriorPoint(horizon=0), "horizon"),
        (lambda: FischerNewton(fischer_weight=0.0), "fischer_weight"),
        (lambda: FischerNewton(kink="none"), "none"),
        (lambda: GradientDescent(map="none"), "none"),
        (lambda: GradientDescent(memory=0), "memory"),
    ],
)
def test_settings_out_of_range(make, name):
    with pytest.raises(ValueError, match=name):
        make()


def test_interior_points_end_at_their_floor():
    """Interior points at their floor.

    Beyond it their systems overflow, and the last iterate is NaN: that is the floor, not a fault of
    the data.
    """
    b = np.random.default_rng(3).standard_normal((12, 12))
    A = wl.GridPoisson(np.ones((12, 12), dtype=int), shift=1.0, device="cpu")
    ends = []
    for precision in ("double", "mixed", "single"):
        result = wl.solve(
            wl.LCP(A, b), InteriorPoint(precision=precision), stopping=wl.StoppingCriteria(rtol=0.0)
        )
        assert result.status is wl.SolveStatus.FLOOR
        assert result.relative_residual <= (1e-6 if precision == "single" else 1e-14)
        ends.append(np.isnan(result.history[-1].residual))
    assert any(ends)  # otherwise this tests nothing
