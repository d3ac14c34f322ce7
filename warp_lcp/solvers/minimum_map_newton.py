"""Newton's method on the minimum map: an active set, a linear solve on the free unknowns, a safeguard."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.multigrid.aggregates import MonotoneAggregation
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.line_hierarchy import takes_points
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.result import SolveStatus
from warp_lcp.problem.solve import IterateMemory, PrecisionName, Step
from warp_lcp.reduced.dense_problem import incompatible
from warp_lcp.reduced.grid_step_kernels import SLOTS
from warp_lcp.reduced.principal_system import (
    CLASSIFY,
    ON_FREE,
    DenseSystem,
    GridSystem,
    LineSystem,
    PrincipalSystem,
    principal_system,
    projected_cycle,
    projected_move,
)
from warp_lcp.reduced.sparse_system import SparseSystem
from warp_lcp.rows.vectors import Sums, rows_of
from warp_lcp.settings import Count, CountOrZero, Settings, Share
from warp_lcp.solvers.minimum_map_newton_coarse import CoarseProblem, CoarseStencilProblem
from warp_lcp.solvers.minimum_map_newton_direct import DirectNewtonWorkspace
from warp_lcp.solvers.minimum_map_newton_grid import GridNewtonWorkspace

LARGE = 1000  # unknowns from which a cold start on a sparse matrix takes projected cycles
# unknowns from which that is six cycles for each on a grid: one costs a fifth of a Newton step, which moves the set by a row, and rows are
# many. With 4, 8, 16 and 32 cycles a membrane on 600,000 nodes takes 16, 15, 12 and 6 Newton steps, 7.0, 5.4, 4.8 and 4.4 s
HUGE = 1 << 16
# growth of the residual by which a projected cycle on an operator that is not symmetric is undone, on a grid over the last one's, on a
# matrix over the start's: torsion with wind on 250^2 nodes takes it to 11 times that, and the more nodes the more, to good effect
RISEN, RISEN_ON_MATRIX = 10.0, 1000.0
PROGRESS = 0.999  # a residual above this part of the smallest so far is no progress
STALLED = 10  # steps without progress after which damped steps end
REGULARIZATIONS = (1e-8, 1e-4, 1e-2, 0.1, 1.0, 10.0, 100.0)  # of J'J, times its mean diagonal


@dataclass(frozen=True, kw_only=True)
class MinimumMapNewton(Settings):
    """Nonsmooth Newton method on the minimum map, reduced to the free unknowns.

    It solves the linear system on the unknowns that the minimum map calls free and holds the others
    at their bounds ([Book] 2.4.1).

    Unknown i is held where x_i - y_i / d_i, with the natural residual's d, is outside [l_i, u_i]. Cold, the first steps on a grid are
    projected multigrid cycles, which find the active set to within a few cells; a Newton step alone moves its boundary by about a layer a
    step. Each Newton correction is solved inexactly in the corrections' precision, and the step is shortened along its projection onto the
    bounds if the residual would exceed the largest of the last `memory` ones (Grippo, Lampariello, Lucidi 1986). On a large sparse matrix,
    an active set that creeps all the same is moved by a problem on coarse points (Brandt and Cryer 1983) if A is nearly a diagonally
    dominant M-matrix. Converges on a grid in a few steps; on other matrices A should be a P-matrix. Where it is not, free blocks may be
    singular and steps fail: dense problems try Levenberg-Marquardt steps of the minimum map and end with STAGNATED after 10 steps
    without progress, others end with NON_DESCENT, or STAGNATED where steps repeat themselves; INFEASIBLE if equations have no solution.
    `wl.solve` without a method goes on by other methods (`wl.default_chain`).

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate rounded to float32 as well.
        monotone_cycles: projected cycles of a cold start on a grid; twice as many, on aggregates, where a large sparse matrix is nearly a
            diagonally dominant M-matrix, six times from 65,536 unknowns on.
        eta: each linear solve reduces its residual by this factor, or to the accuracy still needed. On a grid it ends earlier if
            the free set of an iterate changes; elsewhere it continues to the factor's square once the active set has settled.
        max_linear_iterations: maximum number of conjugate-gradient iterations of one step.
        backtracks: maximum number of halvings of a step.
        memory: number of last residuals whose maximum a step may not exceed (nonmonotone search).
        cycle: settings of multigrid cycles.
        direct: begin with whole steps that LAPACK solves on the host, for matrices of at most 200 unknowns or a bandwidth up to 3: what
            `default_method` chooses there. The steps above take over where these lead nowhere.
        safeguard: True: as described above. False: the book's method alone, its Newton steps with Armijo's monotone search from the
            first to the last, and NON_DESCENT where no share of a step lowers the residual, as on some contacts ([Book] fig. C.2b).
    """

    needs: ClassVar[str] = "positive definite or P-matrix"
    definite: ClassVar[bool] = True
    distributed: ClassVar[bool] = True
    preconditioned: ClassVar[bool] = True
    any_numbering: ClassVar[bool] = True

    precision: PrecisionName = "mixed"
    monotone_cycles: CountOrZero = 2
    eta: Share = 0.1
    max_linear_iterations: Count = 200
    backtracks: CountOrZero = 6
    memory: Count = 4
    cycle: CycleSettings = field(default_factory=CycleSettings)
    direct: bool = False
    safeguard: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.direct and not self.safeguard:
            raise ValueError("direct = True: needs safeguarded steps and cannot be combined with safeguard = False")

    def init(self, problem: LCP) -> NewtonWorkspace | GridNewtonWorkspace | DirectNewtonWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is neither a grid operator, dense nor symmetric; or `direct`, and A is neither small nor narrow.
        """
        if self.direct:
            return DirectNewtonWorkspace(problem, self)
        if self.safeguard and takes_points(problem.A):
            return GridNewtonWorkspace(problem, problem.A, self)
        return self.safeguarded(problem)

    def safeguarded(self, problem: LCP) -> NewtonWorkspace:
        """Return a workspace of safeguarded steps, for any operator that the method takes."""
        return NewtonWorkspace(problem, self)

    def step(self, problem: LCP, work: Any, x: wp.array[Any]) -> Step:
        """Take a monotone cycle while the start is cold, else a safeguarded Newton step."""
        return work.step(x)


class NewtonWorkspace(IterateMemory):
    """Memory of the method for one problem."""

    def __init__(self, problem: LCP, settings: MinimumMapNewton) -> None:
        super().__init__(problem, settings.precision)
        self.settings, self.bounded, layout = settings, problem.bounded, problem.layout
        self.trial = layout.zeros(wp.float64)
        self.system = self._principal_system()
        self.free = layout.zeros(wp.uint8)
        self._sums = Sums(rows_of(self.x), 4, slots=SLOTS, across=layout.across)
        helped = self.bounded and settings.safeguard
        cycled = helped and isinstance(problem.A, SparseOperator) and problem.A.unknowns >= LARGE
        self.aggregates = MonotoneAggregation(problem.A) if cycled else None  # type: ignore[arg-type]
        self.coarse = CoarseProblem(problem.A, settings) if cycled else None
        if helped and isinstance(self.system, LineSystem):
            self.coarse = CoarseStencilProblem(problem.A, self.system, settings)  # type: ignore[arg-type]
        self.start(warm=True, tolerance=0.0)

    def _principal_system(self) -> PrincipalSystem:
        """Return what solves on free sets."""
        return principal_system(self.problem, self.precision.correction, bounded=self.bounded, settings=self.settings.cycle)

    def start(self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None) -> None:
        """Forget the active set; the operator may have changed."""
        self.floating = floating
        cold_grid = isinstance(self.system, GridSystem) and self.bounded and self.settings.safeguard and not warm
        self.cycles_left = self.settings.monotone_cycles if cold_grid else 0
        if self.aggregates is not None and not warm and self.settings.monotone_cycles > 0 and self.aggregates.refresh():
            self.cycles_left = (2 if self.problem.A.shape[0] < HUGE else 6) * self.settings.monotone_cycles
        if self.coarse is not None:
            self.coarse.start()
        self._norm_at_start = 0.0
        self.free.zero_()
        self.stale = True
        self.norms: list[float] = []
        self.target = tolerance
        # dense equations, of which it is not known yet whether they have a solution; a damped step has reduced the residual
        self._equations, self._damped = isinstance(self.system, DenseSystem) and not self.bounded, False
        self._least, self._waited, self._shrinks, self._active = math.inf, 0, False, math.inf
        # with an M-matrix each active set of whole steps is part of the one before, whatever the residual does
        self._monotone = isinstance(self.system, SparseSystem) and self.system.cycled and not self.problem.A.symmetric
        self.system.refresh()

    def step(self, x: wp.array[Any]) -> Step:
        """Take a monotone cycle while the start is cold, else a Newton step."""
        if self.cycles_left > 0:
            self.cycles_left -= 1
            return self.monotone_cycle(x)
        return self.newton_step(x)

    def monotone_cycle(self, x: wp.array[Any]) -> Step:
        """Projected cycle on all unknowns from x."""
        p, system, residual = self.problem, self.system, self.residual
        before = residual.norm
        most = RISEN * before
        if not p.A.symmetric:
            wp.copy(self.trial, x)
        if self.aggregates is not None:
            self._norm_at_start = self._norm_at_start or before
            most = RISEN_ON_MATRIX * self._norm_at_start
            self.aggregates.cycle(x, p.b, p.lower, p.upper)
            self._round(x)
        else:
            assert isinstance(system, GridSystem)
            projected_cycle(p, system, x, residual.y, residual.norm, self.free, self._sums, restrict=self.stale)
            self.stale = True  # the next Newton step takes cells out again
            self._correct(x, system.z, before, x)
        if not p.A.symmetric and not residual.evaluate(x) <= most:  # no energy falls there
            wp.copy(x, self.trial)
            self.cycles_left, residual.current = 0, False
        if self.cycles_left > 0:
            self.stale = self.aggregates is not None
        return Step("monotone cycle", 1, None, interim=True)

    def newton_step(self, x: wp.array[Any]) -> Step:
        """Classify, solve on the free set, move along the projected step."""
        p, residual = self.problem, self.residual
        falls = residual.norm <= PROGRESS * self._least
        if self._equations and (self._damped or not falls) and residual.norm > self.target:
            self._equations = False
            if incompatible(p):
                return Step("newton", 0, 0, SolveStatus.INFEASIBLE)
        self._least, self._waited = min(residual.norm, self._least), 0 if falls else self._waited + 1
        self.norms = [*self.norms, residual.norm][-(self.settings.memory if self.settings.safeguard else 1) :]
        size = residual.norm
        moved, active, shifted, square = self._sums.of(
            CLASSIFY, stencil=residual.known, bounds=p.bounds.operands, x=x, unknown=p.unknown, free=self.free, g=self.system.r,
            scale=1 / size,
        )  # fmt: skip
        self._shrinks, self._active = self._monotone and active < self._active, float(active)
        if self.coarse is not None and self.coarse.is_due(float(moved)):
            return self._coarse_step(x, int(active))
        if moved or self.stale:
            self.system.restrict(self.free)
            self.stale = False
        if shifted:  # held unknowns have moved to their bounds
            residual.affine(x)
            square = self._sums.of(ON_FREE, y=residual.y, free=self.free, g=self.system.r, scale=1 / size)[0]
        if square == 0:
            return Step("newton", 0, int(active))
        iterations = self._solve(float(np.sqrt(square)) / size, size, settled=not moved)
        step = self._move(x, size, iterations, int(active))
        return replace(step, interim=step.interim or self._shrinks)

    def _coarse_step(self, x: wp.array[Any], active: int) -> Step:
        """Correct x, with held unknowns at their bounds, by the coarse problem."""
        assert self.coarse is not None
        p, residual = self.problem, self.residual
        residual.affine(x)
        self.trial.assign(self.coarse.correction(p, x.numpy(), residual.y.numpy()))
        self._correct(x, self.trial, 1.0, x)
        self.norms, self.stale, self._least, self._waited = [], True, math.inf, 0
        return Step("coarse problem", 1, active, interim=True)

    def _solve(self, norm: float, size: float, *, settled: bool) -> int:
        """Solve for the correction, more accurately if the active set has not moved; returns linear iterations."""
        s = self.settings
        if self.floating is not None:
            self.floating.project(self.system.r, self.free)
        target = 0.3 * self.target / size
        return self.system.solve(max((s.eta**2 if settled else s.eta) * norm, target), s.max_linear_iterations)[0]

    def _move(self, x: wp.array[Any], size: float, iterations: int, active: int) -> Step:
        """Accept the longest of the halved, projected steps that the safeguard allows."""
        p, residual, s = self.problem, self.residual, self.settings
        limit, scale, best, best_scale = max(self.norms), 1.0, math.inf, 1.0
        for _ in range(s.backtracks + 1):
            check_time()
            self._correct(x if scale == 1 else self.trial, self.system.e, scale * size, x, kept=self.trial if scale == 1 else None)
            if self.floating is not None:
                self.floating.settle(x, p.lower, p.upper)
                self._round(x)
            norm = residual.evaluate(x)
            if norm <= (1 - 1e-4 * scale) * limit:
                return Step("newton", iterations, active)
            if norm < best:
                best, best_scale = norm, scale
            scale *= 0.5
        if not s.safeguard:
            wp.copy(x, self.trial)
            residual.evaluate(x)
            return Step("newton", iterations, active, SolveStatus.NON_DESCENT)
        self._correct(self.trial, self.system.e, best_scale * size, x)
        if isinstance(self.system, GridSystem) and self.bounded:
            residual.evaluate(x)
            self.stale = True
            residual.current = False
            return Step("monotone cycle", iterations + self.monotone_cycle(x).linear_iterations, active)
        if best <= limit:
            residual.current = False
            return Step("newton", iterations, active)
        wp.copy(x, self.trial)
        descended = isinstance(self.system, DenseSystem) and self._regularized(x, limit)
        residual.evaluate(x)
        failure = SolveStatus.STAGNATED if self._waited >= STALLED else None
        return Step("regularized", iterations, active, failure if descended else SolveStatus.NON_DESCENT)

    def _regularized(self, x: wp.array[Any], limit: float) -> bool:
        """Take the shortest of some Levenberg-Marquardt steps of the minimum map that reduces its norm; return whether one does.

        Where Newton's steps cycle, and where the free block is singular, (J'J + nu I)^-1 J'r is still a descent direction.
        """
        p, residual, start = self.problem, self.residual, x.numpy().copy()
        norm, y = residual.evaluate(x), residual.y.numpy()
        d = residual.diagonal.numpy().astype(np.float64)
        lower, upper, A = p.lower.numpy(), p.upper.numpy(), p.A.matrix.numpy().astype(np.float64)  # type: ignore[attr-defined]
        r = d * (start - np.clip(start - y / d, lower, upper))
        held = (start - y / d < lower) | (start - y / d > upper)
        J = np.where(held[:, None], np.diag(d), A)
        gradient, normal = J.T @ r, J.T @ J
        size = float(np.trace(normal)) / len(r)
        for nu in REGULARIZATIONS:
            check_time()
            dx = np.linalg.solve(normal + nu * size * np.eye(len(r)), -gradient)
            x.assign(np.clip(start + dx, lower, upper))
            if residual.evaluate(x) <= (1 - 1e-6) * norm:
                self.norms.clear()  # from here on no step may undo this one
                self._damped = True
                return True
        x.assign(start)
        return False

    def _correct(self, base: wp.array[Any], e: wp.array[Any], scale: float, x: wp.array[Any], kept: wp.array[Any] | None = None) -> None:
        """Set x = clip(base + scale e), rounded, where e is not 0; remember base if `kept` is given."""
        projected_move(self._sums.rows, self.problem.bounds.operands, base, e, scale, x, kept=kept, guarded=False)
        self._round(x)
