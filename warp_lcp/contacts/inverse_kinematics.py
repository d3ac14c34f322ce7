"""Inverse kinematics with joint limits as a sequence of boxed LCPs ([Book] 1.3.4)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warp_lcp.contacts.articulated_figure import ArticulatedFigure
from warp_lcp.default_chain import default_chain
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.solve_loop import solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import CountOrZero, NonNegative, Positive, Settings
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting

Vector = np.ndarray
# Ratios of actual to predicted decrease above which the trust region grows, and below which it
# shrinks.
AGREES, DISAGREES = 0.75, 0.25
LEAST_RADIUS = 1e-13  # [rad]: smaller steps are rounding
INNER = StoppingCriteria(rtol=1e-10, max_iterations=500)  # of each LCP
# Relative to reach^2: smallest eigenvalue of a model with curvature, after a shift.
DEFINITE = 1e-6


@dataclass(frozen=True, eq=False)
class StepProblem:
    """Step problem: minimize 1/2 d'H d + c'd within joint limits and a trust region.

    c = -J'(g - f), with the limits at theta + d and |d_i| <= radius.

    Args:
        H: the model's symmetric matrix [m^2], shape (n, n).
        c: gradient of the objective [m^2], shape (n,).
        lower: least step [rad], <= 0, shape (n,).
        upper: largest step [rad], >= 0, shape (n,).
    """

    H: Vector
    c: Vector
    lower: Vector
    upper: Vector

    def lcp(self, *, device: wp.DeviceLike = None) -> LCP:
        """Return the boxed LCP in the step itself: y = H d + c, l <= d <= u."""
        return LCP(DenseOperator(self.H, device=device), self.c, self.lower, self.upper)

    def multipliers(self, *, device: wp.DeviceLike = None) -> LCP:
        """Return the book's LCP in the 2n multipliers of the limits.

        [Book] eq. 1.143-1.144; all limits must be finite. With B = [I; -I]: H d + c = B'x, so that
        0 <= x is complementary to B H^-1 B' x + (-l; u) - B H^-1 c >= 0. The matrix is positive
        semi-definite of rank n: the two rows of a limit are negatives of each other.

        Raises:
            ValueError: H is singular, which it is without damping if there are more hinges than
                goals; or a bound is infinite.
        """
        if not np.isfinite([self.lower, self.upper]).all():
            raise ValueError("lower and upper must be finite, for one multiplier each")
        B = np.concatenate([np.eye(len(self.c)), -np.eye(len(self.c))])
        try:
            solved = np.linalg.solve(self.H, np.column_stack([B.T, self.c]))
        except np.linalg.LinAlgError:
            raise ValueError("H is singular: damping must be positive") from None
        M = B @ solved[:, :-1]
        return LCP(
            DenseOperator(0.5 * (M + M.T), device=device),
            np.concatenate([-self.lower, self.upper]) - B @ solved[:, -1],
        )

    def step(self, x: Vector) -> Vector:
        """Return the step d = H^-1 (B'x - c) of multipliers x."""
        n = len(self.c)
        return np.linalg.solve(self.H, x[:n] - x[n:] - self.c)

    def decrease(self, d: Vector) -> float:
        """Return the predicted decrease of the objective [m^2]."""
        return float(-d @ (self.c + 0.5 * (self.H @ d)))


@dataclass(frozen=True, eq=False)
class ReachedPose:
    """Result of `InverseKinematics.solve`.

    Args:
        theta: angles [rad], shape (n,), within the limits.
        objective: 1/2 |g - f(theta)|^2 [m^2].
        projected_gradient: measure of convergence [rad].
        status: CONVERGED; MAX_ITERATIONS; or STAGNATED: no step above rounding lowers the
            objective.
        iterations: number of LCPs, one per iteration.
        rejected: number of steps that did not lower the objective.
        unsolved: number of LCPs that did not converge.
        overshoot: largest distance of an LCP's solution from its bounds [rad], before clipping.
        history: objective at the start and after each iteration [m^2]; it never grows.
    """

    theta: Vector
    objective: float
    projected_gradient: float
    status: SolveStatus
    iterations: int
    rejected: int
    unsolved: int
    overshoot: float
    history: list[float]

    def __bool__(self) -> bool:
        """Whether a point of first-order optimality was found."""
        return self.status is SolveStatus.CONVERGED


@dataclass(frozen=True, kw_only=True)
class InverseKinematics(Settings):
    """Inverse kinematics within joint limits: one boxed LCP per step.

    It minimizes 1/2 |g - f(theta)|^2 ([Book] 1.3.4, eqs. 1.130-1.144). The Gauss-Newton model at
    theta, (J'J + mu I) d - J'(g - f) = y with max(l - theta, -radius) <= d <= min(u - theta,
    radius), is solved by any method. The book accepts all steps; here a step is accepted only if
    the objective falls, and the radius of the box follows the agreement with the model. Converged:
    |theta - clip(theta - grad / reach^2, l, u)| <= tolerance for the largest angle.

    The damping mu keeps H definite, which most methods need, and shortens steps where J is nearly
    singular, at the cost of iterations: see docs/theory.md for measurements. A goal out of reach
    has a residual, whose curvature the Gauss-Newton model lacks: `curvature` adds -sum_k (g - f)_k
    f_k'' and shifts the sum to be definite.

    Args:
        method: method of the LCPs, with its default chain; the default supports any damping; with
            `multipliers` it must support semi-definite A.
        damping: mu in units of reach^2, >= 0.
        radius: initial limit of the change of an angle in a step [rad], > 0.
        tolerance: tolerance of the projected gradient [rad], > 0.
        max_iterations: limit of LCPs, >= 0.
        curvature: use the complete second derivative of the objective.
        multipliers: solve the book's LCP in the multipliers of the limits instead of the boxed one
            in the step.
        device: Warp device of the LCPs; the default device if None.

    Raises:
        ValueError: an argument is outside its range.

    Example:
        >>> from warp_lcp.contacts.articulated_figure import planar_chain
        >>> lower, upper = np.array([-3.0, 0.0]), np.array([3.0, 2.5])  # the elbow bends one way
        >>> arm = planar_chain([1.0, 1.0], lower=lower, upper=upper)
        >>> solver = InverseKinematics(device="cpu")
        >>> pose = solver.solve(arm, np.array([[1.0, 1.0]]), start=np.array([0.3, 0.3]))
        >>> within = (pose.theta >= arm.lower).all()
        >>> print(pose.status.name, arm.positions(pose.theta).round(6), within)
        CONVERGED [[1. 1.]] True
    """

    method: Solver = field(default_factory=IncrementalPivoting)
    damping: NonNegative = 1e-4
    radius: Positive = 0.5
    tolerance: Positive = 1e-7
    max_iterations: CountOrZero = 500
    curvature: bool = False
    multipliers: bool = False
    device: wp.DeviceLike = None

    def solve(
        self, figure: ArticulatedFigure, goals: Vector, start: Vector | None = None
    ) -> ReachedPose:
        """Return the pose whose end effectors are closest to their goals.

        It is a local minimum near the start.

        Args:
            figure: the articulated figure.
            goals: g [m], shape (e, dimension).
            start: angles [rad], shape (n,), clipped to the limits; 0 if None.

        Raises:
            ValueError: goals or start has a wrong shape or values that are not finite.
        """
        lower, upper, scale = figure.lower, figure.upper, figure.reach**2
        theta = np.clip(
            _checked(
                np.zeros(figure.hinges) if start is None else start, (figure.hinges,), "start"
            ),
            lower,
            upper,
        )
        goals = _checked(goals, (len(figure.effectors), figure.dimension), "goals")
        error = (goals - figure.positions(theta)).ravel()
        history, radius, rejected, unsolved, overshoot = (
            [0.5 * float(error @ error)],
            self.radius,
            0,
            0,
            0.0,
        )
        status, gradient = None, -figure.jacobian(theta).T @ error
        while status is None:
            measure = float(np.abs(theta - np.clip(theta - gradient / scale, lower, upper)).max())
            status = self._status(measure, radius, len(history) - 1)
            if status is not None:
                break
            model = self._model(figure, theta, error, radius)
            d, solved, beyond = self._step(model)
            unsolved, overshoot = unsolved + (not solved), max(overshoot, beyond)
            trial = np.clip(theta + d, lower, upper)
            new = (goals - figure.positions(trial)).ravel()
            fall, estimate_run = (
                0.5 * float((error - new) @ (error + new)),
                model.decrease(trial - theta),
            )
            if fall > 0 and 0.5 * float(new @ new) <= history[-1]:
                theta, error, gradient = trial, new, -figure.jacobian(trial).T @ new
            else:
                rejected += 1
            history.append(0.5 * float(error @ error))
            radius = self._radius(radius, fall, estimate_run, float(np.abs(d).max()))
        return ReachedPose(
            theta,
            history[-1],
            measure,
            status,
            len(history) - 1,
            rejected,
            unsolved,
            overshoot,
            history,
        )

    def _status(self, measure: float, radius: float, iterations: int) -> SolveStatus | None:
        """Return the status with which the iteration ends; None if it continues."""
        if measure <= self.tolerance:
            return SolveStatus.CONVERGED
        if iterations >= self.max_iterations:
            return SolveStatus.MAX_ITERATIONS
        return SolveStatus.STAGNATED if radius < LEAST_RADIUS else None

    def _model(
        self, figure: ArticulatedFigure, theta: Vector, error: Vector, radius: float
    ) -> StepProblem:
        """Return the problem of a step from theta, where g - f is `error`.

        H = J'J + (damping reach^2) 1 and c = -J'(g - f) [m^2]. With `curvature`,
        sum_k (g - f)_k d^2 f_k / dtheta^2 is subtracted, which gives the Hessian of |g - f|^2 / 2;
        the diagonal then grows until the least eigenvalue is at least DEFINITE reach^2. The bounds
        of a step are the joint limits less theta, and +-radius [rad].
        """
        J, scale = figure.jacobian(theta), figure.reach**2
        H, shift = J.T @ J, self.damping * scale
        if self.curvature:
            H = H - figure.curvature(theta, error)
            shift += max(0.0, DEFINITE * scale - float(np.linalg.eigvalsh(H)[0]))
        H = H + shift * np.eye(len(theta))
        return StepProblem(
            H,
            -J.T @ error,
            np.maximum(figure.lower - theta, -radius),
            np.minimum(figure.upper - theta, radius),
        )

    def _step(self, model: StepProblem) -> tuple[Vector, bool, float]:
        """Return a clipped step, whether its LCP converged, and the distance clipped."""
        problem = (
            model.multipliers(device=self.device)
            if self.multipliers
            else model.lcp(device=self.device)
        )
        result = solve(problem, default_chain(self.method, problem), stopping=INNER)
        x = result.x.numpy().astype(np.float64)
        d = model.step(x) if self.multipliers else x
        inside = np.clip(d, model.lower, model.upper)
        return inside, bool(result), float(np.abs(d - inside).max())

    def _radius(self, radius: float, fall: float, estimate_run: float, length: float) -> float:
        """Return the next radius of the trust region.

        Half of the step if the model was wrong, twice the radius if it was right and the step was
        short.
        """
        if estimate_run <= 0 or fall < DISAGREES * estimate_run:
            return 0.5 * min(radius, max(length, LEAST_RADIUS))
        if fall > AGREES * estimate_run and length > 0.9 * radius:
            return min(2 * radius, np.pi)
        return radius


def _checked(values: ArrayLike, shape: tuple[int, ...], name: str) -> Vector:
    """Return an array after checks of its shape and of finite numbers."""
    values = np.asarray(values, dtype=np.float64)
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}: expected {shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds values that are not finite")
    return values
