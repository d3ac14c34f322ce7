"""Interior-point method, iterate by iterate against a plain loop.

Start, directions, centering and step lengths are compared, by both rules.
"""

import math

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from default_run import covering
from method_steps import begun
from oracle import assemble
from warp_lcp.solvers.interior_point import InteriorPoint, InteriorPointWorkspace

ROWS = [(0.0, np.inf), (-1.0, 0.5), (-np.inf, 0.25), (-np.inf, np.inf), (0.75, 0.75)]
EXACT = {"precision": "double", "eta": 1e-14, "predictor_eta": 1e-14, "monotone_cycles": 0}


class ReferencePath:
    """Newton's method for y = s - t, w s = v t = tau with w = x - l, v = u - x.

    Row by row; rows with l = u do not move.

    Args:
        A, b, lower, upper: the problem.
        mehrotra: whether to use predictor and corrector, or the book's rule.
        horizon: N of the book's rule.
        backoff: share of the way to the boundary, at most.
        start: initial w d and s, as a multiple of the size of b.
    """

    def __init__(
        self, A, b, lower, upper, *, mehrotra=True, horizon=100, backoff=0.995, start=15.0
    ):
        self.A, self.b, self.d, n = A, b, np.diag(A), len(b)
        self.mehrotra, self.horizon, self.backoff, self.k = mehrotra, horizon, backoff, 0
        self.moves = lower < upper
        self.low, self.high = np.isfinite(lower) & self.moves, np.isfinite(upper) & self.moves
        self.pairs = int(self.low.sum() + self.high.sum())
        self.x = np.clip(np.zeros(n), lower, upper)
        y = A @ self.x + b
        norm = np.linalg.norm(
            np.maximum(np.minimum(y, self.d * (self.x - lower)), self.d * (self.x - upper))
        )
        least = start * max(min(np.linalg.norm(b), 1e6 * norm), norm) / math.sqrt(n)
        self.w, self.v, self.s, self.t = (np.zeros(n) for _ in range(4))
        for i in range(n):
            # The nearer bound's distance is used, at most half of the span.
            if self.low[i] and self.high[i]:
                half = (upper[i] - lower[i]) / 2
                if self.x[i] - lower[i] <= upper[i] - self.x[i]:
                    self.w[i] = min(max(self.x[i] - lower[i], least / self.d[i]), half)
                    self.v[i] = 2 * half - self.w[i]
                else:
                    self.v[i] = min(max(upper[i] - self.x[i], least / self.d[i]), half)
                    self.w[i] = 2 * half - self.v[i]
                self.x[i] = lower[i] + self.w[i]
            elif self.low[i]:
                self.w[i] = max(self.x[i] - lower[i], least / self.d[i])
                self.x[i] = lower[i] + self.w[i]
            elif self.high[i]:
                self.v[i] = max(upper[i] - self.x[i], least / self.d[i])
                self.x[i] = upper[i] - self.v[i]
        y = A @ self.x + b
        self.s, self.t = (
            np.where(self.low, np.maximum(y, least), 0.0),
            np.where(self.high, np.maximum(-y, least), 0.0),
        )

    @property
    def mu(self):
        """Return the mean of the products."""
        return (
            self.w[self.low] @ self.s[self.low] + self.v[self.high] @ self.t[self.high]
        ) / self.pairs

    def direction(self, tau, correction_w, correction_v):
        """Return Newton's dx, ds and dt.

        They solve w s = tau - correction_w and v t = tau - correction_v.
        """
        n = len(self.b)
        right, D, ds, dt = -(self.A @ self.x + self.b), np.zeros(n), np.zeros(n), np.zeros(n)
        for i in range(n):
            if self.low[i]:
                D[i] += self.s[i] / self.w[i]
                right[i] += (tau - correction_w[i]) / self.w[i]
            if self.high[i]:
                D[i] += self.t[i] / self.v[i]
                right[i] -= (tau - correction_v[i]) / self.v[i]
        dx = np.zeros(n)
        dx[self.moves] = np.linalg.solve(
            (self.A + np.diag(D))[np.ix_(self.moves, self.moves)], right[self.moves]
        )
        for i in range(n):
            if self.low[i]:
                ds[i] = (
                    tau - correction_w[i] - self.w[i] * self.s[i] - self.s[i] * dx[i]
                ) / self.w[i]
            if self.high[i]:
                dt[i] = (
                    tau - correction_v[i] - self.v[i] * self.t[i] + self.t[i] * dx[i]
                ) / self.v[i]
        return dx, ds, dt

    def longest(self, dx, ds, dt):
        """Return the largest step for which w, v, s and t stay positive."""
        pairs = [
            (self.w, dx, self.low),
            (self.s, ds, self.low),
            (self.v, -dx, self.high),
            (self.t, dt, self.high),
        ]
        return min(
            [
                -a / da
                for at, by, there in pairs
                for a, da in zip(at[there], by[there], strict=True)
                if da < 0
            ],
            default=math.inf,
        )

    def step(self):
        """Take a step of [Book] algorithm 9 with its rules, or Mehrotra's."""
        self.k += 1
        none = np.zeros(len(self.b))
        if self.mehrotra:
            dx, ds, dt = self.direction(0.0, none, none)
            length = min(1.0, self.longest(dx, ds, dt))
            after = (self.w + length * dx)[self.low] @ (self.s + length * ds)[self.low]
            after += (self.v - length * dx)[self.high] @ (self.t + length * dt)[self.high]
            tau, share = self.mu * (after / self.pairs / self.mu) ** 3, self.backoff
            dx, ds, dt = self.direction(tau, dx * ds, -dx * dt)
        else:
            tau, share = self.mu / self.k, min(self.backoff, self.k / (self.horizon + 1))
            dx, ds, dt = self.direction(tau, none, none)
        length = min(1.0, share * self.longest(dx, ds, dt))
        self.x, self.w, self.v = (
            self.x + length * dx,
            self.w + length * dx * self.low,
            self.v - length * dx * self.high,
        )
        self.s, self.t = self.s + length * ds, self.t + length * dt


def boxed_rows(seed, n=11):
    """Return an unsymmetric positive definite problem with every kind of row."""
    rng = np.random.default_rng(seed)
    B, C = rng.standard_normal((2, n, n))
    lower, upper = np.array([ROWS[k % 5] for k in range(n)]).T
    upper[6] = 40.0  # a side that a start does not halve
    lower[1], upper[1] = -0.25, 1.0  # and one that it does, from the lower end
    return B @ B.T + n * np.eye(n) + 0.3 * (C - C.T), 4 * rng.standard_normal(n), lower, upper


def compare(method, work, problem, plain, place, steps, tolerance):
    """Compare x, w, v, s, t and mu after each step."""
    for k in range(steps):
        if not work.residual.current:
            work.residual.evaluate(work.x)
        work.residual.current = False
        method.step(problem, work, work.x)
        plain.step()
        np.testing.assert_allclose(
            work.x.numpy()[place], plain.x, rtol=tolerance, atol=tolerance, err_msg=f"step {k + 1}"
        )
        assert work.mu == pytest.approx(plain.mu, rel=1e-6)
        sides = (
            ("w", plain.w, plain.low),
            ("s", plain.s, plain.low),
            ("v", plain.v, plain.high),
            ("t", plain.t, plain.high),
        )
        for name, own, there in sides:
            if work._upper or name in "ws":
                found = getattr(work._pairs, name).numpy()[place][there]
                np.testing.assert_allclose(
                    found, own[there], rtol=1e-5, atol=tolerance, err_msg=name
                )


@pytest.mark.parametrize(
    ("settings", "kind"),
    covering(
        [
            {},
            {"start": 0.02},
            {"backoff": 0.8},
            {"mehrotra": False},
            {"mehrotra": False, "horizon": 3},
        ],
        ["dense", "sparse"],
    ),
    ids=repr,
)
def test_steps_are_those_of_the_algorithm(kind, settings, device):
    """Steps against the algorithm, by both rules.

    With a start near the bounds, whose first steps are short, and the book's horizon, after which
    `backoff` is the share.
    """
    for seed in (4501, 4502):
        A, b, lower, upper = boxed_rows(seed)
        operator = (
            wl.DenseOperator(A, device=device)
            if kind == "dense"
            else wl.SparseOperator(scipy.sparse.csr_array(A), device=device)
        )
        problem, method = wl.LCP(operator, b, lower, upper), InteriorPoint(**EXACT | settings)
        work = begun(problem, InteriorPointWorkspace(problem, method))
        compare(
            method,
            work,
            problem,
            ReferencePath(A, b, lower, upper, **settings),
            np.arange(len(b)),
            7,
            1e-8,
        )


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("mehrotra", [True, False])
@pytest.mark.parametrize("bounds", [(0.0, np.inf), (-1.0, 0.5), (-np.inf, 0.25)])
@pytest.mark.parametrize(
    "shape, solid", [((4, 5, 4), 0.1), ((2, 150), 0.01)]
)  # long: rows of several pieces
def test_steps_on_a_grid_are_those_of_the_algorithm(shape, solid, bounds, mehrotra):
    """Steps on a grid against the algorithm.

    The passes over rows condense the next system where a step ends.
    """
    rng = np.random.default_rng(4511)
    cells = rng.choice(3, shape, p=[0.1, 0.9 - solid, solid])
    cells.flat[0] = wl.AIR
    fluid, dense = cells.ravel() == wl.FLUID, assemble(cells)
    A, n = dense[np.ix_(fluid, fluid)], int(fluid.sum())
    b, field = 2 * rng.standard_normal(n), np.zeros(cells.size)
    field[fluid] = b
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), field.reshape(cells.shape), *bounds)
    method = InteriorPoint(mehrotra=mehrotra, **EXACT)
    work = begun(problem, method.init(problem))
    plain = ReferencePath(A, b, *(np.full(n, side) for side in bounds), mehrotra=mehrotra)
    compare(method, work, problem, plain, problem.layout.places()[fluid], 7, 1e-7)


def test_the_predictor_decides_the_centering():
    """Centering by the predictor: sigma = (mu after the predictor / mu)^3.

    It is 0 if the predictor takes the full step, and 1 if it may not move.
    """
    A, b, lower, upper = boxed_rows(4521)
    problem, method = wl.LCP(wl.DenseOperator(A, device="cpu"), b, lower, upper), InteriorPoint()
    work = begun(problem, InteriorPointWorkspace(problem, method))
    work.begin(work.x)
    mu, pairs = work.mu, work.count
    assert work._center(0.0, 0.0) == 0.0
    assert work._center(1e300, 0.0) == pytest.approx(mu)
    assert work._center(2.0, 0.0) == pytest.approx(mu / 8)
    assert work._center(2.0, 0.5 * mu * pairs) == pytest.approx(mu * 0.625**3)
    assert work._center(1.0, -mu * pairs) == 0.0
    assert work._center(1.0, 9 * mu * pairs) == pytest.approx(mu)
