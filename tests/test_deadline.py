"""Time limits of solves: each method, wherever the clock runs out.

The clock is a counter: each reading of it is a second.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from default_run import by_turns
from oracle import natural_residual
from warp_lcp import deadline
from warp_lcp.problem.operator_protocol import families

S = wl.SolveStatus
CRITERIA = wl.StoppingCriteria(rtol=1e-8, max_iterations=25, patience=25)
LIMITS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144)
MORE = 2  # readings after the time limit: by the solve of a block, and by the outer loop
LONG = (
    "fischer-newton",
    "gradient-descent",
    "incremental-pivoting",
    "lemke",
    "minimum-map-newton",
    "staggering",
    "subspace-minimization",
)


def chain(n):
    """Return second differences on n points, symmetric positive definite."""
    return scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n)).tocsr()


def case(family, name):
    """Return a problem, its matrix and its b.

    It has 60 points of a membrane, a pool of 7 x 12 cells, or 3 points for enumeration.
    """
    few, rng = name == "direct-enumeration", np.random.default_rng(7)
    if family == "grid":
        cells = np.full((2, 3) if few else (8, 12), wl.FLUID)
        cells[-1] = wl.AIR
        ny, nx = cells.shape[0] - 1, cells.shape[1]
        across, upward = chain(nx).toarray(), chain(ny).toarray()
        across[0, 0] = across[-1, -1] = upward[0, 0] = 1.0  # walls at the sides and below
        A, b = (
            np.kron(np.eye(ny), across) + np.kron(upward, np.eye(nx)),
            rng.standard_normal(cells.shape),
        )
        b = -np.abs(b) if few else b
        return wl.LCP(wl.GridPoisson(cells, device="cpu"), b), A, b[:-1].ravel()
    matrix = chain(3 if few else 60)
    b = rng.standard_normal(matrix.shape[0])
    b = -np.abs(b) if few else b
    made = (
        wl.SparseOperator(matrix, device="cpu")
        if family == "sparse"
        else wl.DenseOperator(matrix.toarray(), device="cpu")
    )
    return wl.LCP(made, b), matrix.toarray(), b


@pytest.fixture
def solve(monkeypatch):
    """Solve with a counting clock; return the result and the number of readings."""

    def by_counting(problem, method, seconds, **options):
        ticks = itertools.count()
        with monkeypatch.context() as patched:
            patched.setattr(deadline, "now", lambda: float(next(ticks)))
            result = wl.solve(
                problem, method, stopping=replace(CRITERIA, max_seconds=seconds), **options
            )
        return result, next(ticks) - 1  # the first reading is the begin of the time limit

    return by_counting


@pytest.mark.parametrize(
    ("name", "family"),
    by_turns(
        [(name, family) for name, cls in wl.METHODS.items() for family in sorted(families(cls))]
    ),
)
def test_each_method_ends_in_time_with_its_best_iterate(name, family, solve):
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    (problem, A, b), method = case(family, name), wl.METHODS[name]()
    unlimited, work, ended = wl.solve(problem, method, stopping=CRITERIA), method.init(problem), []
    for seconds in LIMITS:
        result, looks = solve(problem, method, seconds, workspace=work)
        again = wl.solve(problem, method, workspace=work, stopping=CRITERIA)
        # An interrupted solve leaves no trace.
        np.testing.assert_array_equal(again.x.numpy(), unlimited.x.numpy())
        if result.status is not S.TIME_LIMIT:
            assert (result.status, result.iterations) == (unlimited.status, unlimited.iterations)
            break
        ended.append(result)
        assert not result
        assert looks <= seconds + MORE
        assert result.iterations == result.history[-1].iteration < unlimited.iterations
        assert [r.residual for r in result.history[:-1]] == [
            r.residual for r in unlimited.history[: result.iterations]
        ]
        assert result.residual == pytest.approx(min(r.residual for r in result.history), rel=1e-12)
        x = result.x.numpy().ravel()[: len(b)]
        assert result.residual == pytest.approx(
            natural_residual(A, b, np.zeros(len(b)), np.full(len(b), np.inf), x), rel=1e-9
        )
    assert ended
    assert ended[0].iterations == 0


@pytest.mark.parametrize("name", LONG)
def test_long_steps_look_at_the_clock_inside(name, solve):
    problem, *_ = case("dense", name)
    result, looks = solve(problem, wl.METHODS[name](), 1e6)
    assert looks > 1.5 * result.iterations


def test_inner_iterations_look_at_the_clock(solve):
    """Inner iterations within the time limit.

    Those of conjugate gradients and GMRES, on grids and on matrices that are not narrow, whose
    systems would be factored.
    """
    skew, b = (
        scipy.sparse.diags_array([-1.2, 2.5, -0.8], offsets=[-1, 0, 1], shape=(60, 60)).tocsr(),
        case("dense", "")[2],
    )
    order = np.random.default_rng(8).permutation(60)
    numbered = [
        wl.SparseOperator(matrix[order][:, order], device="cpu") for matrix in (chain(60), skew)
    ]
    for problem in (case("grid", "")[0], *(wl.LCP(A, b) for A in numbered)):
        result, looks = solve(problem, wl.InteriorPoint(), 1e6)
        assert result.linear_iterations > result.iterations
        # Its inner loop ends by itself when its time is over.
        native = isinstance(problem.A, wl.GridPoisson)
        assert looks > (result.iterations if native else result.linear_iterations - 1)
        assert solve(problem, wl.InteriorPoint(), looks - 2)[0].status is S.TIME_LIMIT


def test_pivots_before_the_end_are_counted(solve):
    problem, *_ = case("dense", "lemke")
    for method in (wl.Lemke(pivots_per_step=50), wl.IncrementalPivoting(pivots_per_step=50)):
        results = [solve(problem, method, seconds)[0] for seconds in range(1, 31)]
        pivots = [result.linear_iterations for result in results if result.iterations == 1]
        assert {result.status for result in results} == {S.TIME_LIMIT}
        assert pivots == list(range(len(pivots)))
        assert len(pivots) >= 15  # the rest of the time is used before the pivots


def test_set_up_counts(monkeypatch):
    """Set-up within the time limit.

    A method whose `init` uses all the time makes no step, and x is clip(0, l, u).
    """
    problem, _, _ = case("dense", "psor")
    seconds = [0.0]

    class SlowInitMethod(wl.ProjectedSOR):
        def init(self, problem):
            seconds[0] += 10
            return super().init(problem)

    monkeypatch.setattr(deadline, "now", lambda: seconds[0])
    result = wl.solve(problem, SlowInitMethod(), stopping=wl.StoppingCriteria(max_seconds=10))
    assert (result.status, result.iterations) == (S.TIME_LIMIT, 0)
    assert not result.x.numpy().any()
    assert (
        wl.solve(
            problem,
            SlowInitMethod(),
            stopping=wl.StoppingCriteria(max_seconds=11, max_iterations=1),
        ).status
        is S.MAX_ITERATIONS
    )


def test_a_solve_that_is_done_is_converged_however_late(solve):
    problem, *_ = case("dense", "minimum-map-newton")
    x = wl.solve(problem, stopping=replace(CRITERIA, rtol=1e-10)).x
    assert solve(problem, wl.Lemke(), 1e-3, x0=x)[0].status is S.CONVERGED


def test_a_solve_within_a_solve_ends_with_it(monkeypatch):
    seconds = [0.0]
    monkeypatch.setattr(deadline, "now", lambda: seconds[0])
    with deadline.Deadline(5), deadline.Deadline(100):
        assert deadline.seconds_left() == 5
        with deadline.Deadline(2):
            seconds[0] = 3
            assert deadline.time_is_up()
        assert not deadline.time_is_up()
        seconds[0] = 5
        with pytest.raises(deadline.DeadlineReached):
            deadline.check_time()
    assert deadline.seconds_left() == math.inf


def test_time_is_up_for_all_ranks_as_soon_as_it_is_for_one(monkeypatch):
    monkeypatch.setattr(deadline, "now", lambda: 1.0)

    class OtherRanks:
        def __init__(self, others):
            self.others, self.asked = others, 0

        def max(self, value):
            self.asked += 1
            return max(value, self.others)

    assert deadline.Deadline(3.0, OtherRanks(-math.inf)).left() == 3.0
    assert deadline.Deadline(3.0, OtherRanks(-2.0)).left() == 2.0
    assert deadline.Deadline(3.0, OtherRanks(-0.0)).left() == 0.0
    unlimited = OtherRanks(-0.0)
    assert deadline.Deadline(math.inf, unlimited).left() == math.inf
    assert unlimited.asked == 0  # ranks exchange nothing where there is no limit


def test_lemke_on_an_american_put_ends_in_time(solve):
    """400 prices of the stock, the first step of a Crank-Nicolson scheme from the payoff."""
    n, rate, volatility, dt = 400, 0.05, 0.3, 0.02
    price = np.linspace(0.0, 4.0, n + 2)[1:-1]
    payoff, k = np.maximum(1 - price, 0.0), np.arange(1, n + 1)
    up, down = 0.5 * (volatility**2 * k**2 + rate * k), 0.5 * (volatility**2 * k**2 - rate * k)
    L = scipy.sparse.diags_array([down[1:], -(up + down + rate), up[:-1]], offsets=[-1, 0, 1])
    A = scipy.sparse.csr_array(scipy.sparse.eye_array(n) - 0.5 * dt * L)
    b = -(payoff + 0.5 * dt * (L @ payoff))
    b[0] -= dt * down[0]  # the option is worth 1 where the stock is worthless
    problem, method = wl.LCP(A.toarray(), b, lower=payoff), wl.Lemke()
    work = method.init(problem)
    whole, looks = solve(problem, method, 1e6, workspace=work)
    assert whole
    result, _ = solve(problem, method, 0.3 * looks, workspace=work)
    assert result.status is S.TIME_LIMIT
    assert result.linear_iterations > 0
    assert result.residual <= natural_residual(
        A.toarray(), b, payoff, np.full(n, np.inf), payoff
    ) * (1 + 1e-12)
    assert wl.solve(wl.LCP(A, b, lower=payoff), stopping=wl.StoppingCriteria(max_seconds=600))
