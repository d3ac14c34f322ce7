"""Newton's method on the Fischer-Burmeister map.

Shifted principal systems are solved matrix-free; dense Jacobians are factored on the host.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.black_box_multigrid import takes_points
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.problem.bounds import INFINITY, without_far
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Precision, PrecisionName, Step, WorkspaceBase
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.residual_scaling import NoTranspose
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Count, CountOrZero, ShareOrAll, renamed
from warp_lcp.solvers.gradient_descent import DescentWorkspace, GradientDescent
from warp_lcp.subproblems.dense_problem import DenseWorkspace
from warp_lcp.subproblems.energy_monitor import DECREASE, NonmonotoneSearch
from warp_lcp.subproblems.grid_system import GridSystem
from warp_lcp.subproblems.multigrid_workspace import ColdStart
from warp_lcp.subproblems.nonsmooth_map import (
    FiniteDifferenceSystem,
    HostMap,
    Kink,
    KinkName,
    MapForm,
    NonsmoothMap,
)
from warp_lcp.subproblems.principal_system import principal_system
from warp_lcp.subproblems.reduced_system import NewtonSettings

SHARE = 0.95  # lambda of the penalized map for dense problems: measured on frictional contacts
FIRST_STEPS = 30  # limit of the regularized stage: the solves that succeed need 5 to 27 steps
# nu is this times min(1, ||f||), A's entries being near 1: J'J + nu I can be factored for every J.
REGULARIZATION = 1e-6
# Start of x (None: as the solve began), first mu, its factor, and number of steps.
HOMOTOPIES = ((None, 1.0, 0.3, 40), (10.0, 1.0, 0.5, 60))
# A point where a search has failed is stationary if its projected gradient is at most this part of
# ||f||. The shortest steps, 1e-8, leave up to that at a local minimum; where searches fail on
# contacts for other reasons the gradient is 1 to 4.
STATIONARY = 1e-4
DESCENT = 1e-10  # a direction whose slope is less than this times ||dx||^2.1 is no descent


@renamed(share="fischer_weight")
@dataclass(frozen=True, kw_only=True)
class FischerNewton(NewtonSettings):
    """Nonsmooth Newton method on the Fischer-Burmeister map, plain or penalized.

    It solves f(x) = 0 ([Book] 2.4.2-3, algorithm 12).

    f_i = lambda psi(a_i, y_i) + (1 - lambda) a_i+ y_i+ / scale, psi(a, b) = a + b - sqrt(a^2 +
    b^2), a = d (x - l) with d of the natural residual; two-sided rows take psi(a, -psi(-y, d (u -
    x))) ([Book] eq. 1.48), rows without bounds y. The step solves J dx = -f with J = diag(p d) +
    diag(q) A: divided by q it is the shifted system (A + D) dx = -f / q, D = d p / q, which
    multigrid preconditions on grids. The merit f.f / 2 may not exceed the largest of the last ones.
    Iterates may violate the bounds; a converged result does not.

    Dense problems (frictional contact, semi-definite A) are solved with factors of J on the host,
    in units in which A is equilibrated symmetrically and b is near 1, and the result is within the
    bounds. With `safeguard` such a solve is a sequence of methods. First come at most 30 steps (J'J
    + nu I)^-1 J'f with nu = 1e-6 min(1, ||f||) on the penalized map, with a nonmonotone line
    search, or steps along the gradient where that direction is no descent direction. Then two
    homotopies follow, on the smoothed map x + y - sqrt(x^2 + y^2 + 2 mu), mu -> 0. No pivoting
    method is part of the sequence.

    `linear_iterations` counts preconditioned iterations on the finest grid, factorizations where A
    is dense.

    Args:
        kink: derivative at a kink: "random", "zero", "perturbation" or "approximation" (see
            `Kink`).
        fischer_weight: lambda, the weight of the Fischer-Burmeister function in the penalized map,
            in (0, 1]; 1 is the plain map. None: 0.95 for dense matrices, 1 for others, where the
            penalty made the steps grow with the grid (ball obstacle, 65^2 to 1025^2: 6 to 11 steps
            with 0.95, 6 to 7 with 1).
        safeguard: False: monotone Armijo search along the projected path, and an end with
            NON_DESCENT or LOCAL_MINIMUM where that fails: the book's method. True: as described
            above.
        scaled: False: d = 1 in the map, and no equilibration of dense problems, as in the book;
            needs safeguard = False. Steps then depend on the units of x.
        precision: "mixed": iterate float64, corrections float32 on grids; "double"; or "single":
            the iterate rounded to float32 too.
        warm_start: steps of gradient descent on the same map before the first Newton step.
        monotone_cycles: projected multigrid cycles of a cold start on a grid.
        eta: each linear solve reduces its residual by this factor.
        max_linear_iterations: maximum number of iterations of one linear solve.
        memory: number of merits that a safeguarded search stores.
        cycle: settings of multigrid cycles.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.array([[2.0, -1.0], [-1.0, 2.0]]), device="cpu")
        >>> result = wl.solve(wl.LCP(A, np.array([2.0, -3.0])), wl.FischerNewton())
        >>> print(result.status.name, abs(result.x.numpy().round(6)))
        CONVERGED [0.  1.5]
    """

    needs: ClassVar[str] = (
        "a P0-matrix for plain steps; the safeguarded chain also solves copositive contact problems"
    )

    kink: KinkName = "perturbation"
    fischer_weight: ShareOrAll | None = None
    safeguard: bool = True
    scaled: bool = True
    warm_start: CountOrZero = 0
    memory: Count = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.safeguard and not self.scaled:
            raise ValueError(
                "scaled = False: needs safeguard = False: the safeguards have thresholds for "
                "scaled maps"
            )

    def descent(self, problem: LCP) -> GradientDescent:
        """Return the gradient descent on this method's map for a problem.

        As a warm start, only this gradient descent is consistent with the method.

        No other gradient descent is consistent with the method as a warm start.
        """
        weight = (
            self.fischer_weight
            if self.fischer_weight is not None
            else SHARE
            if isinstance(problem.A, DenseOperator)
            else 1.0
        )
        map_ = MapForm.FISCHER if weight == 1 else MapForm.PENALIZED
        precision: PrecisionName = "single" if self.precision == "single" else "double"
        return GradientDescent(
            map=map_.value, fischer_weight=weight, precision=precision, scaled=self.scaled
        )

    def init(self, problem: LCP) -> FischerWorkspace | FischerDenseWorkspace:
        """Return a workspace, on the host for dense matrices.

        With kink="approximation" it is on the device for all matrices.

        With kink="approximation" it is on the device for all matrices.
        """
        if isinstance(problem.A, DenseOperator) and Kink(self.kink) is not Kink.APPROXIMATION:
            return FischerDenseWorkspace(problem, self)
        return FischerWorkspace(problem, self)

    def step(
        self, problem: LCP, work: FischerWorkspace | FischerDenseWorkspace, x: DeviceArray
    ) -> Step:
        """Take a monotone cycle, a gradient step or a Newton step.

        Cycles and gradient steps come first, after a cold start.

        Cycles and gradient steps come first, while the start is cold.
        """
        if work.cycles_left > 0:
            work.cycles_left -= 1
            assert isinstance(work, FischerWorkspace)
            return work.monotone_step()
        if work.descents_left > 0:
            work.descents_left -= 1
            return work.descend(x)
        return work.newton_step(x)


class FischerWorkspace(WorkspaceBase):
    """Workspace of the method for one problem, on the device."""

    def __init__(self, problem: LCP, settings: FischerNewton) -> None:
        self.settings, self.kink, layout = settings, Kink(settings.kink), problem.layout
        self.cold_start: ColdStart | None = None
        if takes_points(problem.A) and self.kink is not Kink.APPROXIMATION:
            self.cold_start = ColdStart(problem, problem.A, settings)
            self.scratch = self.cold_start.scratch
        start = self.cold_start
        super().__init__(
            problem,
            settings.precision,
            x=start.x if start else None,
            residual=start.residual if start else None,
        )
        self._from, self._shift = layout.zeros(wp.float64), layout.zeros(wp.float64)
        self.free = layout.zeros(wp.uint8)
        self._descent = settings.descent(problem)
        map_, share = MapForm(self._descent.map), self._descent.fischer_weight
        self.system = (
            FiniteDifferenceSystem(problem, self.residual, map_, share, scaled=settings.scaled)
            if self.kink is Kink.APPROXIMATION
            else principal_system(
                problem,
                self.precision.correction,
                bounded=False,
                settings=settings.cycle,
                shifted=True,
                hierarchy=self.cold_start.hierarchy if self.cold_start else None,
            )
        )
        self.map = NonsmoothMap(
            problem, self.residual, map_, share, self.kink, scaled=settings.scaled
        )
        grid = isinstance(self.system, GridSystem) and self.system.fused
        self._fusable = grid and settings.safeguard and self.precision is not Precision.SINGLE
        self._search = NonmonotoneSearch(memory=settings.memory if settings.safeguard else 1)
        self._gradient: DescentWorkspace | None = None
        self.cycles_left = self.descents_left = self.steps = 0
        self.target = self._scale = self._merit = self._gone = 0.0

    @property
    def _hierarchy(self) -> Hierarchy:
        """Hierarchy of a grid's system."""
        assert isinstance(self.system, GridSystem)
        return self.system.hierarchy

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the state of the last solve; the operator may have changed."""
        self.floating = floating
        s = self.settings
        self.cycles_left = (
            s.monotone_cycles
            if self.cold_start is not None and self.problem.bounded and not warm
            else 0
        )
        self.descents_left, self.steps, self.target = s.warm_start, 0, tolerance
        self._scale = self._merit = self._gone = 0.0
        self._search.forget()
        self.map.begin()
        self.system.refresh()
        if self.cold_start is not None:
            self.cold_start.start(warm=warm, tolerance=tolerance, floating=floating)
        # The singular part: components none of whose unknowns has a bound.
        if self.floating is not None:
            p = self.problem
            free = (p.unknown.numpy() == 1) & np.isinf(p.lower.numpy()) & np.isinf(p.upper.numpy())
            self._without_bounds = wp.array(free.astype(np.uint8), device=p.device)

    def monotone_step(self) -> Step:
        """Take a projected multigrid cycle on all unknowns."""
        assert self.cold_start is not None
        return self.cold_start.monotone_step()

    @property
    def _fused(self) -> bool:
        """Whether a step is one pass over memory; the problem must allow it."""
        return self._fusable and self.floating is None

    def newton_step(self, x: DeviceArray) -> Step:
        """Solve for Newton's direction, and search along it.

        The system is (A + D) e = r with D = d p / q and r = -f / (q size), in units of the
        residual's norm, `size`: the step is dx = size e. A full step that lowers the merit f'f / 2
        enough is taken without a search. The trial at a new x already condenses the system of the
        next step. If the search fails, x returns to the start of the step, and a gradient step
        follows.
        """
        s, fused = self.settings, self._fused
        if self._scale == 0:
            if not fused and self.cold_start is not None:
                self.residual.affine(x)
            self._condense(x)
        # From here on all is in units of the residual's norm, `size`: r is -f / (q size), and the
        # step is size e.
        size, merit = 1 / self._scale, self._merit
        self._scale = 0.0
        if isinstance(self.system, FiniteDifferenceSystem):
            self.system.linearize(x, self.free, size)
        elif fused:
            self._hierarchy.rebuild()
        else:
            self.system.restrict(self.free, self._shift)
        if self.floating is not None:
            self.floating.project(self.system.r, self._without_bounds)
        norm = self.map.norm if fused else self.system.norm()
        iterations = self.system.solve(s.eta * norm, s.max_linear_iterations)[0] if norm > 0 else 0
        self._search.store_merit(merit)
        self._gone = 0.0
        if not s.safeguard:
            wp.copy(self._from, x)
        if self._take_full_step(x, size, merit) or self._searched(x, size):
            if self.residual.norm <= self.target:
                self._project(x)
            return Step("fischer", iterations)
        self._scale = 0.0
        self._go(x, 0.0)
        self._evaluate(x)
        return self._fall_back(x, iterations)

    def _take_full_step(self, x: DeviceArray, size: float, merit: float) -> bool:
        """Move by size e; return whether the merit falls as for an exact direction.

        The slope of an exact Newton direction is -f'f.
        """
        return self._trial(x, size) <= self._search.limit - 2 * DECREASE * merit

    def _searched(self, x: DeviceArray, size: float) -> bool:
        """Return to the start and search along e by the merit's own slope.

        That differs from -f'f where e is inexact. Returns whether the search succeeds.
        """
        self._go(x, 0.0)
        self._evaluate(x)
        slope = size * self.map.slope(x, self.system.e)
        return slope < 0 and self._search.search(lambda t: self._trial(x, t * size), slope)[0] > 0.0

    def _project(self, x: DeviceArray) -> None:
        """Move x onto its bounds, which it may violate by what the criteria allow.

        The solve goes on if the criteria are not met there.
        """
        self.residual.start(x, keep=True)
        self._round(x)
        self._evaluate(x)
        self._scale = 0.0

    def _evaluate(self, x: DeviceArray) -> float:
        """Return the norm of the natural residual, and write y.

        The grid's own evaluation does not store y.
        """
        return NaturalResidual.evaluate(self.residual, x)

    def _condense(self, x: DeviceArray, move: float = 0.0) -> float:
        """Write the system of the next step; return the merit f'f / 2.

        If passes are fused, the same pass moves x by `move` e first.
        """
        self.steps += 1
        self._scale = 1 / max(self.residual.norm, 1e-300)
        if self._fused:
            self._merit = self.map.step(
                x, self.system.e, move, self._hierarchy.finest, self._scale, self.steps
            )
            return self._merit
        self._merit = self.map.condense(
            x, self._shift, self.system.r, self.free, self._scale, self.steps
        )
        return self._merit

    def _fall_back(self, x: DeviceArray, iterations: int) -> Step:
        """Take a gradient step where Newton's direction fails, or return the failure."""
        try:
            if not self.settings.safeguard:
                stationary = self.map.is_stationary(x, STATIONARY)
                return Step(
                    "fischer",
                    iterations,
                    None,
                    SolveStatus.LOCAL_MINIMUM if stationary else SolveStatus.NON_DESCENT,
                )
            step = self.descend(x)
        except NoTranspose:  # an operator that has products only
            return Step("fischer", iterations, None, SolveStatus.NON_DESCENT)
        return Step("gradient", iterations + step.linear_iterations, None, step.failure)

    def descend(self, x: DeviceArray) -> Step:
        """Take one gradient step on the same map."""
        shared = self.cold_start is None  # a grid's own residual does not keep y
        if self._gradient is None:
            self._gradient = DescentWorkspace(
                self.problem,
                self._descent,
                self.residual if shared else NaturalResidual(self.problem),
            )
            self._gradient.start(warm=True, tolerance=self.target)
        if shared:
            return self._gradient.descend(x)
        self._gradient.residual.evaluate(x)
        step = self._gradient.descend(x)
        self.residual.mark_evaluated(self._gradient.residual.norm)
        return step

    def _trial(self, x: DeviceArray, scale: float) -> float:
        """Move x, and return the merit.

        The system is then that of the next step, because a full step is nearly always taken.
        """
        if self._fused:
            move, self._gone = scale - self._gone, scale
            return self._condense(x, move) if math.isfinite(move) else math.inf
        self._go(x, scale)
        self._finish_move(x)
        return self._condense(x) if math.isfinite(self._evaluate(x)) else math.inf

    def _go(self, x: DeviceArray, scale: float) -> None:
        """Move to x + scale e from the start of the step.

        Without bounds the last move is undone by a negative one, which saves a copy of x.
        """
        if self.settings.safeguard:
            self.map.advance(x, self.system.e, scale - self._gone, x, projected=False)
        else:
            self.map.advance(self._from, self.system.e, scale, x, projected=True)
        self._gone = scale


class FischerDenseWorkspace(DenseWorkspace):
    """Workspace of the method for one dense problem.

    Steps are taken in units in which A is equilibrated, and may leave the bounds; x is the
    projection of the iterate onto them.

    Attributes:
        stage: 0 while steps are Newton's on the map itself, k in the k-th homotopy.
        units: of x, one for each unknown.
    """

    def __init__(self, problem: LCP, settings: FischerNewton) -> None:
        super().__init__(problem, settings.precision)
        self.settings, self._descent = settings, settings.descent(problem)
        self.cycles_left, self.descents_left, self.stage, self.steps = 0, settings.warm_start, 0, 0
        self.units: np.ndarray = np.ones(0)
        self.cold_start: ColdStart | None = None
        self._search = NonmonotoneSearch(memory=settings.memory if settings.safeguard else 1)
        self._gradient: DescentWorkspace | None = None

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the problem, and begin the first stage."""
        super().start(warm=warm, tolerance=tolerance)
        s = self.settings
        data, self.units = self.data, np.ones(len(self.data.b), dtype=np.float64)
        if s.scaled:
            data, self.units = self.data.scaled()
        # Squares of larger numbers overflow.
        lower, upper = without_far(data.lower, data.upper, INFINITY)
        data = replace(data, lower=lower, upper=upper)
        self.map = HostMap(
            data,
            self._descent.fischer_weight,
            Kink(s.kink),
            np.random.default_rng(2015),
            scaled=s.scaled,
        )
        self._identity = np.eye(len(data.b))
        self._search.forget()
        self.descents_left, self.stage, self.steps, self.target = s.warm_start, 0, 0, tolerance
        self._gradient = None
        self._iterate = self._start = self.read_iterate() / self.units

    def descend(self, x: DeviceArray) -> Step:
        """Take one gradient step on the same map."""
        if self._gradient is None:
            self._gradient = DescentWorkspace(self.problem, self._descent, self.residual)
            self._gradient.start(warm=True, tolerance=self.target)
        step = self._gradient.descend(x)
        self._iterate = self._start = self.read_iterate() / self.units
        return Step("gradient", step.linear_iterations)

    def newton_step(self, x: DeviceArray) -> Step:
        """Take a step of the current stage."""
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
        """Take a step of the book's method: algorithm 12.

        It solves J dx = -f with J = diag(p) + diag(q) A, in the units of the map, and searches
        along the projected path. Kink "zero" leaves unknowns at a kink where they are.
        """
        x, map_ = self._iterate, self.map
        f, p, q, kinks = map_.linearized(x)
        move = ~kinks if map_.kink is Kink.ZERO else np.ones(len(x), dtype=bool)
        J = map_.jacobian(p, q)
        dx = np.zeros(len(x))
        dx[move] = _solve(J[np.ix_(move, move)], -f[move])
        # A stationary point of f'f / 2 that is no solution.
        gradient = J.T @ f
        if np.linalg.norm(gradient / map_.d) <= 1e-12 * np.linalg.norm(f):
            return SolveStatus.LOCAL_MINIMUM
        failure = self._searched(x, dx, float(gradient @ dx), 0.5 * float(f @ f), projected=True)
        # Projected gradient of the merit.
        inside = map_.d * (x - np.clip(x - gradient / map_.d**2, map_.data.lower, map_.data.upper))
        return (
            SolveStatus.LOCAL_MINIMUM
            if failure and np.linalg.norm(inside) <= STATIONARY * np.linalg.norm(f)
            else failure
        )

    def _regularized(self) -> SolveStatus | None:
        """Take a regularized step: dx = -(J'J + nu I)^-1 J'f.

        If it is no descent direction of f'f / 2, the negative gradient -J'f replaces it.
        """
        x, map_ = self._iterate, self.map
        f, p, q, kinks = map_.linearized(x)
        # At a kink the row of J is d e_i'.
        if map_.kink is Kink.ZERO:
            p, q = np.where(kinks, 1.0, p), np.where(kinks, 0.0, q)
        J = map_.jacobian(p, q)
        gradient, nu = J.T @ f, REGULARIZATION * min(1.0, float(np.linalg.norm(f)))
        dx = -_solve(J.T @ J + nu * self._identity, gradient)
        slope = float(gradient @ dx)
        if not slope <= -DESCENT * float(dx @ dx) ** 1.05:
            dx, slope = -gradient, -float(gradient @ gradient)
        return self._searched(x, dx, slope, 0.5 * float(f @ f), projected=False)

    def _searched(
        self, x: np.ndarray, dx: np.ndarray, slope: float, merit: float, *, projected: bool
    ) -> SolveStatus | None:
        """Search along a direction; return the failure, None if the merit falls.

        The merit is |f(x + t dx)|^2 / 2, at a point clipped to the bounds if `projected`.

        Args:
            x: the iterate, of the dense problem.
            dx: the direction.
            slope: of the merit along dx at t = 0; the search needs slope < 0.
            merit: at t = 0.
            projected: whether trial points are clipped.
        """
        if not (np.isfinite(slope) and slope < 0):
            return SolveStatus.NON_DESCENT
        data, moved = self.map.data, x

        def trial(length: float) -> float:
            nonlocal moved
            moved = x + length * dx
            if projected:
                moved = np.clip(moved, data.lower, data.upper)
            f = self.map.value(moved, data.affine(moved))
            return 0.5 * float(f @ f)

        self._search.store_merit(merit)
        length, _ = self._search.search(trial, slope)
        if length == 0.0:
            return SolveStatus.NON_DESCENT
        self._iterate = moved
        return None

    def _next_stage(self) -> None:
        """Begin the next homotopy, at its own start with its own first mu.

        y is independent of x, and at least 1 at first for one-sided bounds.
        """
        start, self._mu, self._factor, self._steps_left = HOMOTOPIES[self.stage]
        self.stage += 1
        data = self.map.data
        x = (
            self._start
            if start is None
            else np.clip(np.full(len(self._start), start), data.lower, data.upper)
        )
        y = data.affine(x)
        one_sided = np.isfinite(data.lower) & ~np.isfinite(data.upper)
        self._iterate, self._y = x, np.where(one_sided, np.maximum(y, 1.0), y)

    def _homotopy(self) -> SolveStatus | None:
        """Take a Newton step for A x + b = y and the smoothed map, then lower mu.

        The unknowns are (x, y). With the gap g = A x + b - y, which a step of length t reduces to
        (1 - t) g, dx solves (diag(p) + diag(q) A) dx = -f - q g and dy = A dx + g. The length is
        halved until hypot(||g||, ||f||) falls.
        """
        x, y, map_, A = self._iterate, self._y, self.map, self.map.data.A
        gap, (f, p, q, _) = map_.data.affine(x) - y, map_.linearized(x, y, self._mu)
        dx = _solve(map_.jacobian(p, q), -f - q * gap)
        if not np.isfinite(dx).all():
            dx, self._steps_left = np.zeros(len(x)), 1
        dy, size, length = (
            A @ dx + gap,
            float(np.hypot(np.linalg.norm(gap), np.linalg.norm(f))),
            1.0,
        )
        # Armijo's condition on hypot(||gap||, ||f||); the gap is linear in the step length.
        while length > 1e-6:
            after = map_.value(x + length * dx, y + length * dy, self._mu)
            if (
                np.hypot((1 - length) * np.linalg.norm(gap), np.linalg.norm(after))
                <= (1 - 1e-4 * length) * size
            ):
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
    """Solve a linear system.

    Returns the least-squares solution of least norm where the matrix is singular to rounding.
    """
    if not right.size:
        return right
    factors, pivots, info = scipy.linalg.lapack.dgetrf(matrix)
    if (
        not (np.isfinite(factors).all() or np.isfinite(matrix).all())
        or not np.isfinite(right).all()
    ):
        return np.full(right.shape, np.nan)  # LAPACK's least squares would raise or not return
    if info != 0 or not np.isfinite(factors).all():
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=1e-12)[0])
    return np.asarray(scipy.linalg.lapack.dgetrs(factors, pivots, right)[0])
