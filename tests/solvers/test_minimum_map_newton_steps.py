"""Newton's method on the minimum map, iterates against a plain loop.

Index sets at ties are compared, and the method runs without any fallback.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from method_steps import steps_of
from oracle import assemble
from warp_lcp.gallery.contact_scenes import contact
from warp_lcp.gallery.obstacle import ball_obstacle
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=100)
ROWS = [(0.0, np.inf), (-1.0, 0.5), (-np.inf, 0.25), (-np.inf, np.inf), (0.75, 0.75)]
SEEDS = (4402, 4404, 4415, 4416, 4417, 4418, 4420, 4429)
PERIOD_THREE = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])


def index_sets(d, x, y, lower, upper):
    """Return index sets: below if d (x - l) < y, above if d (x - u) > y.

    Row by row; ties are free.
    """
    below, above = np.zeros(len(x), dtype=bool), np.zeros(len(x), dtype=bool)
    for i in range(len(x)):
        below[i] = d[i] * (x[i] - lower[i]) < y[i]
        above[i] = d[i] * (x[i] - upper[i]) > y[i]
    return below, above


def norm(d, x, y, lower, upper):
    """Return the norm of the minimum map max(min(y, d (x - l)), d (x - u))."""
    return np.linalg.norm(
        [
            max(min(v, e * (a - low)), e * (a - high))
            for e, a, v, low, high in zip(d, x, y, lower, upper, strict=True)
        ]
    )


def plain_newton(A, b, lower, upper, x, steps, *, memory, backtracks=6):
    """Return iterates of [Book] algorithm 10 with eq. 2.139.

    Active unknowns move onto their bounds, A_FF e = -y_F, and x = clip(x + t e) by Armijo's rule.

    Returns:
        For each step: x after it, the number of active unknowns, and t. t = 0 if the search
        fails, which leaves x on its bounds.
    """
    d, norms, found = np.diag(A), [], []
    for _ in range(steps):
        y = A @ x + b
        norms = [*norms, norm(d, x, y, lower, upper)][-memory:]
        below, above = index_sets(d, x, y, lower, upper)
        x = np.where(below, lower, np.where(above, upper, x))
        free, e = np.flatnonzero(~(below | above)), np.zeros(len(x))
        e[free] = np.linalg.solve(A[np.ix_(free, free)], -(A @ x + b)[free])
        t = 1.0
        while t >= 2.0**-backtracks:
            moved = np.clip(x + t * e, lower, upper)
            if norm(d, moved, A @ moved + b, lower, upper) <= (1 - 1e-4 * t) * max(norms):
                break
            t /= 2
        else:
            t, moved = 0.0, x
        x = moved
        found.append((x, len(x) - len(free), t))
    return found


def with_ties(seed, n=10):
    """Return rows of every kind in whole numbers over 8, d = 1.

    Three rows have x - y / d exactly at a bound, with x outside, inside and at it.
    """
    rng = np.random.default_rng(seed)
    A = rng.integers(-7, 8, (n, n)) / 8
    np.fill_diagonal(A, 1.0)
    lower, upper = np.array([ROWS[k % 5] for k in range(n)]).T
    x = np.clip(rng.integers(-8, 9, n) / 8, lower, upper)
    x[:3] = [0.5, 0.25, -0.5]
    y = rng.integers(-12, 13, n) / 8
    y[:3] = [x[0] - lower[0], x[1] - upper[1], x[2] - upper[2]]
    return A, y - A @ x, lower, upper, x


@pytest.mark.parametrize("safeguard", [True, False])
@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_steps_are_those_of_the_algorithm(kind, safeguard, device):
    """Steps against the algorithm.

    Ties are free: if active, they would move onto their bounds by a step that sets y = 0 elsewhere
    alone.
    """
    lengths = []
    for seed in SEEDS:
        A, b, lower, upper, x0 = with_ties(seed)
        expected = plain_newton(A, b, lower, upper, x0, 4, memory=4 if safeguard else 1)
        operator = (
            wl.DenseOperator(A, device=device)
            if kind == "dense"
            else wl.SparseOperator(scipy.sparse.csr_array(A), device=device)
        )
        problem, method = (
            wl.LCP(operator, b, lower, upper),
            MinimumMapNewton(precision="double", eta=1e-14, safeguard=safeguard),
        )
        for (work, step), (y, held, t) in zip(
            steps_of(problem, method, 4, x0), expected, strict=False
        ):
            if t == 0:  # the search fails
                break
            np.testing.assert_allclose(work.x.numpy(), y, rtol=1e-9, atol=1e-10)
            assert (step.name, step.active, step.failure) == ("newton", held, None)
            lengths.append(t)
            if work.residual.norm < 1e-12:  # solved
                break
    assert len(lengths) > 10
    assert min(lengths) < 1


@pytest.mark.parametrize("direct", [True, False])
def test_ties_are_free(direct):
    """Free ties: x - y / d at a bound.

    The unknown takes part in the solve, however it got there.
    """
    A, b, lower, upper, x0 = with_ties(4401)
    below, above = index_sets(np.ones(10), x0, A @ x0 + b, lower, upper)
    assert not (below | above)[:3].any()
    problem = wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper)
    ((work, step),) = steps_of(problem, MinimumMapNewton(direct=direct), 1, x0)
    x = work.x.numpy()
    assert step.active == np.count_nonzero(below | above)
    if direct:  # whole steps
        held, free = np.flatnonzero(below | above), np.flatnonzero(~(below | above))
        expected = np.where(below, lower, np.where(above, upper, 0.0))
        np.testing.assert_array_equal(x[held], expected[held])
        np.testing.assert_allclose((A @ x + b)[free], 0.0, atol=1e-12)


@pytest.mark.parametrize("bounds", [(0.0, np.inf), (-1.0, 1.0), (-np.inf, 0.0)])
def test_index_sets_on_a_grid(bounds):
    """Index sets on a grid.

    Whole numbers, so that ties are exact: which cells are free, which are marked for which bound,
    and which rows are flagged.
    """
    rng = np.random.default_rng(4421)
    cells = rng.choice(3, (5, 6, 7), p=[0.15, 0.7, 0.15])
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells)
    A, n = dense[np.ix_(fluid, fluid)], int(fluid.sum())
    d, lower, upper = np.diag(A), np.full(n, bounds[0]), np.full(n, bounds[1])
    x = np.clip(rng.integers(-3, 4, n).astype(float), lower, upper)
    y = rng.integers(-8, 9, n).astype(float)
    gap = np.where(np.isfinite(upper), x - upper, x - lower)
    tied = rng.random(n) < 0.3
    y[tied] = (d * gap)[tied]
    b, field = np.zeros(cells.size), np.zeros(cells.size)
    b[fluid], field[fluid] = y - A @ x, x
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), b.reshape(cells.shape), *bounds)
    work = MinimumMapNewton(precision="double").init(problem)
    residual = work.residual
    residual.start(work.x, keep=False)
    residual.start(work.x, keep=True)  # an initial guess is classified
    work.x.assign(problem.layout.load(field.reshape(cells.shape), wp.float64))
    residual.evaluate(work.x)
    below, above = index_sets(d, x, y, lower, upper)
    assert not (below | above)[tied].any()
    assert (below | above).sum() > 10
    place, finest = problem.layout.places()[fluid], work.iterate.hierarchy.finest
    free = finest.stencil.d.numpy().ravel()[place] != 0
    np.testing.assert_array_equal(free, ~(below | above))
    assert residual.active == (below | above).sum()
    residual.project_held(work.x)
    np.testing.assert_array_equal(
        work.x.numpy()[place], np.where(below, lower, np.where(above, upper, x))
    )
    moved = np.where(below, lower, np.where(above, upper, x))
    right = finest.b.numpy().ravel()[place] * float(residual.size)
    np.testing.assert_allclose(right[free], -(A @ moved + y - A @ x)[free], atol=1e-12)


def test_newton_alone_fails_on_contacts_and_says_so():
    """Newton alone on contacts: it fails and reports so.

    In [Book] fig. C.2b it ends with non-descent after a few steps. No step is another method's.
    Which problems fail, and after how many steps, depends on rounding.
    """
    outcomes = []
    for seed in range(24):
        p = contact(20, seed=seed)
        result = wl.solve(
            wl.LCP(wl.DenseOperator(p.A, device="cpu"), p.b), MinimumMapNewton(safeguard=False)
        )
        assert {record.step for record in result.history[1:]} == {"newton"}
        assert (np.diff([record.residual for record in result.history]) <= 0).all()
        outcomes.append((result.status, result.iterations))
        assert wl.solve(wl.LCP(wl.DenseOperator(p.A, device="cpu"), p.b), wl.Lemke())
    failed = [steps for status, steps in outcomes if status is wl.SolveStatus.NON_DESCENT]
    assert len(failed) >= 6
    assert np.median(failed) <= 20


def test_newton_without_fallback_may_fail_without_a_cycle():
    """Newton alone without cycling.

    On the matrix of period three whole steps cycle; searched ones cannot, and end where no share of
    a step descends.
    """
    result = wl.solve(
        wl.LCP(wl.DenseOperator(PERIOD_THREE, device="cpu"), -np.ones(3)),
        MinimumMapNewton(safeguard=False),
    )
    assert {record.step for record in result.history[1:]} == {"newton"}
    assert result.status in (wl.SolveStatus.CONVERGED, wl.SolveStatus.NON_DESCENT)


@pytest.mark.parametrize("form", ["grid", "sparse"])
def test_newton_alone_on_an_obstacle(form):
    """Newton alone on an obstacle.

    It solves suitable problems by its own steps: no projected cycle, no coarse problem, on a grid
    and on a large matrix.
    """
    p = ball_obstacle(49, device="cpu")
    problem = p.lcp() if form == "grid" else p.sparse().lcp(device="cpu")
    result = wl.solve(problem, MinimumMapNewton(safeguard=False), stopping=TIGHT)
    assert result, result.status
    assert {record.step for record in result.history[1:]} == {"newton"}
    helped = wl.solve(problem, MinimumMapNewton(), stopping=TIGHT)
    np.testing.assert_allclose(result.x.numpy(), helped.x.numpy(), atol=1e-8)
    assert {record.step for record in helped.history[1:]} != {"newton"}


def test_direct_steps_are_safeguarded():
    with pytest.raises(ValueError, match=r"direct = True.*safeguard = False"):
        MinimumMapNewton(direct=True, safeguard=False)
