"""Reduced system of any operator, with a stored correction.

A principal system is solved for the correction, along which the iterate moves.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step, WorkspaceBase
from warp_lcp.problem.operator_protocol import HasStencil, has
from warp_lcp.problem.result import SolveStatus
from warp_lcp.subproblems.active_set_kernels import CLASSIFY, ON_FREE, projected_move
from warp_lcp.subproblems.coarse_problem import CoarseStencilProblem, FullApproximationCorrection
from warp_lcp.subproblems.dense_system import DampedSteps, DenseSystem
from warp_lcp.subproblems.grid_step_kernels import SLOTS
from warp_lcp.subproblems.initial_cycles import LARGE, cold_cycles
from warp_lcp.subproblems.line_system import LineSystem
from warp_lcp.subproblems.principal_system import PrincipalSystem, principal_system
from warp_lcp.subproblems.sparse_system import SparseSystem

if TYPE_CHECKING:
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton


class CorrectionSystem:
    """Newton's equations solved by a principal system, see `ReducedSystem`.

    For grids, matrices, sums with a term of low rank, and operators with products only. The
    equations are divided by the residual's norm, so that corrections in float32 neither overflow
    nor vanish.

    Args:
        problem: the problem.
        settings: of Newton's method.
        iterate: of a system that has worked on the problem before; None: its own.

    Attributes:
        principal: solves on free sets, for the correction `e`.
        free: the free set, stored uint8 field.
        active: number of held unknowns.
        moved: number of unknowns by which the free set differs from the last one.
        size: divisor of the equations: the residual's norm at the start of the step.
        start_of_step: stored field; x with held unknowns on their bounds, once `move` has been
            called.
        cycles: projected cycles of a cold start; None if not available.
        coarse: problem on coarse unknowns that moves a creeping active set; None if not available.
        damped: Levenberg-Marquardt steps of dense problems; None for other problems.
    """

    whole = False

    def __init__(
        self, problem: LCP, settings: MinimumMapNewton, iterate: WorkspaceBase | None = None
    ) -> None:
        self._problem, self._settings, layout = problem, settings, problem.layout
        self.iterate = WorkspaceBase(problem, settings.precision) if iterate is None else iterate
        real, x = self.iterate.precision.correction, self.iterate.x
        self.start_of_step = layout.zeros(wp.float64)
        self.principal = principal_system(
            problem, real, bounded=problem.bounded, settings=settings.cycle
        )
        self.free = layout.zeros(wp.uint8)
        self.sums = RowReduction(rows_of(x), 4, slots=SLOTS, comm=layout.comm)
        helped = problem.bounded and settings.safeguard
        self.cycles = (
            cold_cycles(problem, self.principal, self.sums, settings.monotone_cycles)
            if helped
            else None
        )
        self.coarse = _coarse_problem(problem, self.principal, settings) if helped else None
        self.damped = DampedSteps(problem) if isinstance(self.principal, DenseSystem) else None
        self.floating: FloatingComponents | None = None
        self.active, self.moved, self.size, self._square, self._cycles_left = 0, 0.0, 1.0, 0.0, 0

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the active set; the operator may have changed."""
        self.floating, self._target = floating, tolerance
        self._cycles_left = self.cycles.begin() if self.cycles is not None and not warm else 0
        for part in (self.coarse, self.damped):
            if part is not None:
                part.start()
        self.free.zero_()
        self._stale = True  # whether the principal system has another free set
        # With an M-matrix, the active set of each whole step is part of the one before, whether the
        # residual rises or falls.
        self._monotone = (
            isinstance(self.principal, SparseSystem)
            and self.principal.cycled
            and not self._problem.A.symmetric
        )
        # Whether the active set has become smaller; number of unknowns in the last one.
        self._shrinks, self._last_active = False, math.inf
        self.principal.refresh()

    def monotone_cycle(self) -> Step | None:
        """Take a projected cycle after a cold start, else return None."""
        if self._cycles_left == 0:
            return None
        self._cycles_left -= 1
        return self._cycle()

    def _cycle(self) -> Step:
        """Take a projected cycle on all unknowns.

        It is undone if it raises the residual far, as it may where A is not symmetric.
        """
        x, residual, symmetric = self.iterate.x, self.iterate.residual, self._problem.A.symmetric
        assert self.cycles is not None
        if not symmetric:
            wp.copy(self.start_of_step, x)
        most = self.cycles.run(x, residual, self.free, restrict=self._stale)
        self.iterate.round_iterate()
        residual.invalidate()
        if not symmetric and not residual.evaluate(x) <= most:  # no energy falls there
            wp.copy(x, self.start_of_step)
            self._cycles_left = 0
            residual.invalidate()
        # A grid's system keeps all unknowns from cycle to cycle; Newton's step removes some of them
        # again.
        self._stale = not (self.cycles.repairs and self._cycles_left > 0)
        return Step("monotone cycle", 1, None, interim=True)

    def classify(self) -> Step | None:
        """Find the free set; return a step that replaces Newton's, or None.

        The step is a correction of x on coarse unknowns if the active set creeps, or the proof that
        equations have no solution. The pass also writes g = -y / size on the free set.
        """
        p, residual = self._problem, self.iterate.residual
        if self.damped is not None and self.damped.proves_infeasible(residual.norm, self._target):
            return Step("newton", 0, 0, SolveStatus.INFEASIBLE)
        self.size = residual.norm
        moved, active, shifted, square = self.sums.of(
            CLASSIFY,
            stencil=residual.known,
            bounds=p.bounds.operands,
            x=self.iterate.x,
            unknown=p.unknown,
            free=self.free,
            g=self.principal.r,
            scale=1 / self.size,
        )
        self.moved, self.active, self._shifted, self._square = (
            float(moved),
            int(active),
            bool(shifted),
            float(square),
        )
        self._shrinks, self._last_active = (
            self._monotone and self.active < self._last_active,
            self.active,
        )
        return (
            self._coarse_step()
            if self.coarse is not None and self.coarse.is_due(self.moved)
            else None
        )

    def _coarse_step(self) -> Step:
        """Correct x by the coarse problem, with held unknowns at their bounds.

        x <- clip(x + P e, l, u).
        """
        x, residual = self.iterate.x, self.iterate.residual
        assert self.coarse is not None
        residual.affine(x)
        self.start_of_step.assign(
            self.coarse.correction(self._problem, x.numpy(), residual.y.numpy())
        )
        self._set(x, self.start_of_step, 1.0)
        self._stale = True
        return Step("coarse problem", 1, self.active, interim=True)

    def restrict(self) -> bool:
        """Restrict the principal system to the free set; write its right-hand side.

        The system is A_FF e_F = -y_F, with y = A x + b divided by `size`.
        Held unknowns are on their bounds, where `classify` has put them. Returns whether the
        right-hand side is nonzero.
        """
        residual = self.iterate.residual
        if self.moved or self._stale:
            self.principal.restrict(self.free)
            self._stale = False
        if self._shifted:
            residual.affine(self.iterate.x)
            self._square = float(
                self.sums.of(
                    ON_FREE, y=residual.y, free=self.free, g=self.principal.r, scale=1 / self.size
                )[0]
            )
        self._shrinks = self._shrinks and self._square != 0
        return self._square != 0

    def solve(self) -> int:
        """Solve for the correction, more accurately if the active set has not moved."""
        s, r = self._settings, self.principal.r
        if self.floating is not None:
            self.floating.project(r, self.free)
        norm, target = math.sqrt(self._square) / self.size, 0.3 * self._target / self.size
        return self.principal.solve(
            max((s.eta if self.moved else s.eta**2) * norm, target), s.max_linear_iterations
        )[0]

    def move(self, length: float) -> float:
        """Set x to clip(x0 + length size e) from the start x0 of the step."""
        check_time()
        x, whole = self.iterate.x, length == 1.0
        self._set(
            x if whole else self.start_of_step,
            self.principal.e,
            length * self.size,
            saved_base=self.start_of_step if whole else None,
        )
        self.settle()
        return self.iterate.residual.evaluate(x)

    def settle(self) -> None:
        """Choose the constants of floating components, which a move leaves open."""
        if self.floating is not None:
            self.floating.settle(self.iterate.x, self._problem.lower, self._problem.upper)
            self.iterate.round_iterate()

    def accept(self, iterations: int) -> Step:
        """Return the accepted step.

        On an M-matrix the residual need not fall while the active set shrinks.
        """
        return Step("newton", iterations, self.active, interim=self._shrinks)

    def fall_back(self, iterations: int, norms: deque[float], best: float, length: float) -> Step:
        """Continue after a failed search.

        Takes the best length, and on a grid a projected cycle from there; on dense problems a
        damped step; else the step fails.
        """
        x, residual = self.iterate.x, self.iterate.residual
        if not self._settings.safeguard:
            return self._take_back(iterations)
        self._set(self.start_of_step, self.principal.e, length * self.size)
        if self.cycles is not None and self.cycles.repairs:
            residual.evaluate(x)
            self._stale = True
            return self._step("monotone cycle", iterations + self._cycle().linear_iterations)
        if best <= max(norms):
            return self.accept(iterations)
        if self.damped is None:
            return self._take_back(iterations, "regularized")
        wp.copy(x, self.start_of_step)
        lower = self.damped.take_shortest_step(x, residual)
        residual.evaluate(x)
        if lower:
            norms.clear()
        return self._step(
            "regularized", iterations, self.damped.status if lower else SolveStatus.NON_DESCENT
        )

    def _take_back(self, iterations: int, name: str = "newton") -> Step:
        """Return x to the start of the step, and fail."""
        wp.copy(self.iterate.x, self.start_of_step)
        self.iterate.residual.evaluate(self.iterate.x)
        return self._step(name, iterations, SolveStatus.NON_DESCENT)

    def _step(self, name: str, iterations: int, failure: SolveStatus | None = None) -> Step:
        return Step(name, iterations, self.active, failure, interim=self._shrinks)

    def _set(
        self, base: DeviceArray, e: DeviceArray, scale: float, saved_base: DeviceArray | None = None
    ) -> None:
        """Set x = clip(base + scale e), rounded, where e is not 0.

        If `saved_base` is given, it receives base.
        """
        projected_move(
            self.sums.rows,
            self._problem.bounds.operands,
            base,
            e,
            scale,
            self.iterate.x,
            saved_x=saved_base,
            guarded=False,
        )
        self.iterate.round_iterate()
        self.iterate.residual.invalidate()


def _coarse_problem(
    problem: LCP, system: PrincipalSystem, settings: MinimumMapNewton
) -> FullApproximationCorrection | None:
    """Return the coarse problem of an operator, None if it has none.

    A large sparse matrix has one, and a stencil that needs lines.
    """
    A = problem.A
    if isinstance(system, LineSystem) and has(A, HasStencil):
        return CoarseStencilProblem(A, system, settings)
    return (
        FullApproximationCorrection(A, settings)
        if isinstance(A, SparseOperator) and A.unknowns >= LARGE
        else None
    )
