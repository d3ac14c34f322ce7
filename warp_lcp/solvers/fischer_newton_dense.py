"""Fischer-Newton on dense matrices, with factors of the Jacobian: one plain loop, or a chain of safeguarded stages."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from warp_lcp.problem.bounds import INFINITY, without_far
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.solve import Step
from warp_lcp.solvers.dense_problem import DenseProblem, DenseWorkspace
from warp_lcp.solvers.descent import NonmonotoneSearch
from warp_lcp.solvers.gradient_descent import DescentWorkspace
from warp_lcp.solvers.nonsmooth_map import KINK, Kink

if TYPE_CHECKING:
    from warp_lcp.solvers.fischer_newton import FischerNewton

FIRST_STEPS = 30  # of the regularized stage: those that succeed need 5 to 27
REGULARIZATION = 1e-6  # nu is this times min(1, ||f||), A's entries being near 1: J'J + nu I has a factorization whatever J is
HOMOTOPIES = ((None, 1.0, 0.3, 40), (10.0, 1.0, 0.5, 60))  # start of x (None: as the solve began), first mu, its factor, steps
# projected gradient, in parts of ||f||, up to which a point where a search has failed is stationary: the shortest steps, 1e-8, leave up to
# that of a local minimum's gradient; where searches fail on contacts for other reasons it is 1 to 4
STATIONARY = 1e-4
DESCENT = 1e-10  # a direction whose slope is less than this times ||dx||^2.1 is no descent


class FischerMap:
    """f, its merit and a generalized Jacobian on the host; see `NonsmoothMap` for the formulas.

    Args:
        data: the problem.
        share: lambda.
        kink: what stands at kinks.
        rng: of random elements.
    """

    def __init__(self, data: DenseProblem, share: float, kink: Kink, rng: np.random.Generator) -> None:
        self.data, self.share, self.kink, self._rng = data, share, kink, rng
        d = np.abs(np.diag(data.A))
        self.d = np.where(d == 0, 1.0, d)
        self.scale = float(np.sqrt(np.mean(data.b**2))) or 1.0
        self.low, self.high = np.isfinite(data.lower), np.isfinite(data.upper)

    def sides(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a = d (x - l) and c = d (u - x), 0 without the bound."""
        a = np.where(self.low, self.d * (x - np.where(self.low, self.data.lower, 0)), 0.0)
        return a, np.where(self.high, self.d * (np.where(self.high, self.data.upper, 0) - x), 0.0)

    def value(self, x: np.ndarray, y: np.ndarray, smoothing: float = 0.0) -> np.ndarray:
        """Return f; smoothing > 0: of the smoothed map without penalty."""
        a, c = self.sides(x)
        h = np.where(self.high, -_psi(-y, c, smoothing), y)
        f = np.where(self.low, _psi(a, h, smoothing), h)
        if smoothing or self.share == 1:
            return f
        extra = np.where(self.low, np.maximum(a, 0) * np.maximum(y, 0), 0) - np.where(self.high, np.maximum(c, 0) * np.maximum(-y, 0), 0)
        return self.share * f + (1 - self.share) * extra / self.scale

    def derivative(self, x: np.ndarray, y: np.ndarray, smoothing: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return p, q of an element diag(p d) + diag(q) A, and which rows are at a kink."""
        a, c = self.sides(x)
        kp, kq = self._element(len(x))
        h = np.where(self.high, -_psi(-y, c, smoothing), y)
        p2, q2, kink2 = _partial(c, -y, smoothing, kp, kq, KINK * self.scale)
        p2, q2 = np.where(self.high, p2, 0.0), np.where(self.high, q2, 1.0)
        p1, q1, kink1 = _partial(a, h, smoothing, kp, kq, KINK * self.scale)
        p1, q1 = np.where(self.low, p1, 0.0), np.where(self.low, q1, 1.0)
        p, q = p1 + q1 * p2, q1 * q2
        kinks = (kink1 & self.low) | (kink2 & self.high)
        if smoothing or self.share == 1:
            return p, q, kinks
        rest, lowered, raised = (1 - self.share) / self.scale, self.low * np.maximum(a, 0), self.high * np.maximum(c, 0)
        p = self.share * p + rest * ((lowered > 0) * np.maximum(y, 0) + (raised > 0) * np.maximum(-y, 0))
        q = self.share * q + rest * ((y > 0) * lowered + (y < 0) * raised)
        return p, q, kinks

    def linearized(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return f and what `derivative` does."""
        y = self.data.affine(x)
        return self.value(x, y), *self.derivative(x, y)

    def jacobian(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return diag(p d) + diag(q) A."""
        return np.diag(p * self.d) + q[:, None] * self.data.A

    def _element(self, n: int) -> tuple[Any, Any]:
        """Return (p, q) at kinks."""
        if self.kink is not Kink.RANDOM:
            return 0.0, 1.0
        return 1 - np.sqrt(0.5) * self._rng.random(n), 1 - np.sqrt(0.5) * self._rng.random(n)


def _psi(a: np.ndarray, b: np.ndarray, smoothing: float) -> np.ndarray:
    """Return a + b - sqrt(a^2 + b^2 + 2 mu), without cancellation where a + b > 0."""
    rho, total = np.sqrt(a * a + b * b + 2 * smoothing), a + b
    return np.where(total > 0, 2 * (a * b - smoothing) / np.where(total > 0, total + rho, 1.0), total - rho)


def _partial(a: np.ndarray, b: np.ndarray, smoothing: float, kp: Any, kq: Any, kink: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives of psi by a and by b, and where it has none."""
    rho = np.sqrt(a * a + b * b + 2 * smoothing)
    at = rho <= kink
    safe = np.where(at, 1.0, rho)
    return np.where(at, kp, 1 - a / safe), np.where(at, kq, 1 - b / safe), at


class FischerDenseWorkspace(DenseWorkspace):
    """Memory of the method for one dense problem.

    Steps are taken in units in which A is equilibrated, and may leave the bounds; x is the projection of where they are.

    Attributes:
        stage: 0 while steps are Newton's on the map itself, k in the k-th homotopy.
        units: of x, one for each unknown.
    """

    def __init__(self, problem: LCP, settings: FischerNewton) -> None:
        super().__init__(problem, settings.precision)
        self.settings, self._descent = settings, settings.descent(problem)
        self.cycles_left, self.descents_left, self.stage, self.steps = 0, settings.warm_start, 0, 0
        self.cold_start: Any = None
        self._search = NonmonotoneSearch(memory=settings.memory if settings.safeguard else 1)
        self._gradient: DescentWorkspace | None = None

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the problem, and begin the first stage."""
        super().start(warm=warm, tolerance=tolerance)
        s = self.settings
        data, self.units = self.data.scaled()
        lower, upper = without_far(data.lower, data.upper, INFINITY)  # squares of what is larger overflow
        data = replace(data, lower=lower, upper=upper)
        self.map = FischerMap(data, self._descent.fischer_weight, Kink(s.kink), np.random.default_rng(2015))
        self._identity = np.eye(len(data.b))
        self._search.forget()
        self.descents_left, self.stage, self.steps, self.target = s.warm_start, 0, 0, tolerance
        self._gradient = None
        self._iterate = self._begun = self.read_iterate() / self.units

    def descend(self, x: Any) -> Step:
        """Go down the gradient of the same map once."""
        if self._gradient is None:
            self._gradient = DescentWorkspace(self.problem, self._descent, self.residual)
            self._gradient.start(warm=True, tolerance=self.target)
        step = self._gradient.descend(x)
        self._iterate = self._begun = self.read_iterate() / self.units
        return Step("gradient", step.linear_iterations)

    def newton_step(self, x: Any) -> Step:
        """Take a step of the stage that is due."""
        self.steps += 1
        if self.stage == 0:
            failure = self._regularized() if self.settings.safeguard else self._plain()
            if self.settings.safeguard and (failure is not None or self.steps >= FIRST_STEPS):
                failure = None
                self._next_stage()
        else:
            failure = self._homotopy()
        self.write_iterate(self.units * self._iterate)
        self.round_iterate()
        name = "fischer" if self.stage == 0 else "homotopy"
        return Step(name, 1, None, failure, interim=self.settings.safeguard and failure is None)

    def _plain(self) -> SolveStatus | None:
        """Take a step of the book's method: algorithm 12."""
        x, map_ = self._iterate, self.map
        f, p, q, kinks = map_.linearized(x)
        move = ~kinks if map_.kink is Kink.ZERO else np.ones(len(x), dtype=bool)
        J = map_.jacobian(p, q)
        dx = np.zeros(len(x))
        dx[move] = _solve(J[np.ix_(move, move)], -f[move])
        gradient = J.T @ f
        if np.linalg.norm(gradient / map_.d) <= 1e-12 * np.linalg.norm(f):
            return SolveStatus.LOCAL_MINIMUM
        failure = self._searched(x, dx, float(gradient @ dx), 0.5 * float(f @ f), projected=True)
        inside = map_.d * (x - np.clip(x - gradient / map_.d**2, map_.data.lower, map_.data.upper))
        return SolveStatus.LOCAL_MINIMUM if failure and np.linalg.norm(inside) <= STATIONARY * np.linalg.norm(f) else failure

    def _regularized(self) -> SolveStatus | None:
        """Take a step of the safeguarded method, along the gradient if that of Newton's is no descent."""
        x, map_ = self._iterate, self.map
        f, p, q, kinks = map_.linearized(x)
        if map_.kink is Kink.ZERO:
            p, q = np.where(kinks, 1.0, p), np.where(kinks, 0.0, q)
        J = map_.jacobian(p, q)
        gradient, nu = J.T @ f, REGULARIZATION * min(1.0, float(np.linalg.norm(f)))
        dx = -_solve(J.T @ J + nu * self._identity, gradient)
        slope = float(gradient @ dx)
        if not slope <= -DESCENT * float(dx @ dx) ** 1.05:
            dx, slope = -gradient, -float(gradient @ gradient)
        return self._searched(x, dx, slope, 0.5 * float(f @ f), projected=False)

    def _searched(self, x: np.ndarray, dx: np.ndarray, slope: float, merit: float, *, projected: bool) -> SolveStatus | None:
        """Move along a direction; return how that fails."""
        if not (np.isfinite(slope) and slope < 0):
            return SolveStatus.NON_DESCENT
        data, found = self.map.data, x

        def trial(length: float) -> float:
            nonlocal found
            found = x + length * dx
            if projected:
                found = np.clip(found, data.lower, data.upper)
            f = self.map.value(found, data.affine(found))
            return 0.5 * float(f @ f)

        self._search.remember(merit)
        length, _ = self._search.search(trial, slope)
        if length == 0.0:
            return SolveStatus.NON_DESCENT
        self._iterate = found
        return None

    def _next_stage(self) -> None:
        """Begin the next homotopy: y independent of x, and not below 1 at first."""
        start, self._mu, self._factor, self._steps_left = HOMOTOPIES[self.stage]
        self.stage += 1
        data = self.map.data
        x = self._begun if start is None else np.clip(np.full(len(self._begun), start), data.lower, data.upper)
        y = data.affine(x)
        one_sided = self.map.low & ~self.map.high
        self._iterate, self._y = x, np.where(one_sided, np.maximum(y, 1.0), y)

    def _homotopy(self) -> SolveStatus | None:
        """Take a Newton step for A x + b = y and the smoothed map of (x, y), and lower mu."""
        x, y, map_, A = self._iterate, self._y, self.map, self.map.data.A
        gap, f = map_.data.affine(x) - y, map_.value(x, y, self._mu)
        p, q, _ = map_.derivative(x, y, self._mu)
        dx = _solve(map_.jacobian(p, q), -f - q * gap)
        if not np.isfinite(dx).all():
            dx, self._steps_left = np.zeros(len(x)), 1
        dy, size, length = A @ dx + gap, float(np.hypot(np.linalg.norm(gap), np.linalg.norm(f))), 1.0
        while length > 1e-6:
            after = map_.value(x + length * dx, y + length * dy, self._mu)
            if np.hypot((1 - length) * np.linalg.norm(gap), np.linalg.norm(after)) <= (1 - 1e-4 * length) * size:
                break
            length *= 0.5
        self._iterate, self._y = x + length * dx, y + length * dy
        self._mu *= self._factor
        self._steps_left -= 1
        if self._steps_left > 0:
            return None
        if self.stage < len(HOMOTOPIES):
            self._next_stage()
            return None
        return SolveStatus.STAGNATED


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a linear system; the least-squares solution of least norm where the matrix is singular to rounding."""
    if not right.size:
        return right
    factors, pivots, info = scipy.linalg.lapack.dgetrf(matrix)
    if not (np.isfinite(factors).all() or np.isfinite(matrix).all()) or not np.isfinite(right).all():
        return np.full(right.shape, np.nan)  # LAPACK's least squares would raise or not return
    if info != 0 or not np.isfinite(factors).all():
        return np.linalg.lstsq(matrix, right, rcond=1e-12)[0]
    return scipy.linalg.lapack.dgetrs(factors, pivots, right)[0]
