"""Reduced system of a grid: conjugate gradients that move x itself, by the fused passes of projected multigrid."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import warp as wp

from warp_lcp.deadline import time_is_up
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil
from warp_lcp.problem.solve import Precision, Step
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.reduced import grid_step_kernels as engine
from warp_lcp.reduced.multigrid_residual import AssessedResidual
from warp_lcp.reduced.multigrid_workspace import MultigridWorkspace

IDLE = StoppingCriteria.patience  # iterations of one linear solve without a smaller residual


class MinimumMapResidual(AssessedResidual):
    """The natural residual, with the free set that the minimum map has there: unknowns with x - y / A_ii within their bounds.

    Attributes:
        away: whether unknowns that are held are not at their bounds yet.
    """

    _away: wp.array[Any]
    _minimum_map = True

    def __init__(self, problem: LCP, A: HasStencil, hierarchy: Hierarchy, *, rounded: bool) -> None:
        super().__init__(problem, A, hierarchy, rounded=rounded)
        planes, rows, _ = A.stencil.padding.counts
        # rows with such unknowns
        self._away = wp.zeros(planes * rows, dtype=wp.uint8, device=A.device)

    @property
    def away(self) -> bool:
        """Whether held unknowns are not at their bounds, on any rank; read back."""
        found, across = bool(self._away.numpy().any()), self.problem.layout.across
        return found if across is None else across.any(found)

    def hold(self, x: wp.array[Any]) -> None:
        """Move held unknowns onto their bounds, and the right-hand side with them."""
        p, s, finest = self.problem, self._A.stencil, self._finest
        engine.HOLD.bind(
            s.rows,
            bounds=p.bounds.operands,
            x=x,
            g=finest.b,
            away=self._away,
            ROUNDED=self._rounded,
        ).launch(wp.launch)
        s.wrap(x)
        if s.ghosts is not None:
            self._away.fill_(1)  # which rows beside a cut have moved, others know
        _, around_y, around_z = s.periodic
        engine.RIGHT_SIDE.bind(
            s.rows,
            stencil=s,
            around_y=around_y,
            around_z=around_z,
            x=x,
            b=p.b,
            free=finest.stencil.d,
            g=finest.b,
            away=self._away,
            scalars=self.scalars,
        ).launch(wp.launch)
        self._away.zero_()


class FusedGridSystem:
    """Newton's equations on a grid without a correction in memory, see `ReducedSystem`.

    Each iteration of conjugate gradients, preconditioned by a multigrid cycle, moves x itself,
    projected, and evaluates the residual and the free set there. The linear solve ends when the
    residual is small enough, or as soon as an iterate calls other unknowns free: what it was to
    solve is not the system any more. Conjugate gradients carry their direction on to the next
    system.

    Args:
        problem: of a grid.
        settings: of Newton's method.

    Attributes:
        iterate: the multigrid passes, with their iterate and hierarchy.
        whole: the energy has fallen to a new least, so that the residual may rise; or there are no
            bounds, or x is not finite.
    """

    iterate: MultigridWorkspace
    whole = False

    def __init__(self, problem: LCP, settings: Any) -> None:
        self._settings = settings
        self.iterate = passes = MultigridWorkspace(
            problem,
            problem.A,  # type: ignore[arg-type]
            settings,
            residual=MinimumMapResidual,
            ahead=False,
        )
        self._exact = passes.precision is not Precision.SINGLE
        # Where x is rounded to float32 the energy says little of a step, and Newton's own safeguard
        # decides.
        passes.cycles_against_creeping = self._exact
        self._target, self._active, self._length, self._step = 0.0, 0, 1.0, 0.0
        self._sinks = False  # whether the energy has fallen to a new least

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Forget the search direction; the operator may have changed."""
        self._target = tolerance
        self.iterate.start(warm=warm, tolerance=tolerance, floating=floating)

    def monotone_cycle(self) -> Step | None:
        """Take a projected cycle while the start is cold, or the free set creeps, or Newton's steps have failed."""
        return self.iterate.monotone_step() if self.iterate.cycles_left > 0 else None

    def classify(self) -> Step | None:
        """Do nothing more: the evaluation of the residual at x has found the free set."""
        self._active, self._length = self.iterate.residual.active, 1.0
        return None

    def restrict(self) -> bool:
        """Move held unknowns onto their bounds; the hierarchy follows the free set before its next cycle."""
        passes, residual = self.iterate, self.iterate.residual
        assert isinstance(residual, MinimumMapResidual)
        if residual.away:
            passes.store_best()
            residual.hold(passes.x)
        return True

    def solve(self) -> int:
        """Move x by conjugate gradients until its residual is small enough, or its free set another one."""
        passes, residual, s = self.iterate, self.iterate.residual, self._settings
        wanted, least, iterations, idle = (
            max(s.eta * residual.norm, self._target),
            residual.norm,
            0,
            0,
        )
        while True:
            passes.truncated_step()
            iterations += 1
            if (
                passes.stale
                or not residual.norm > wanted
                or iterations >= s.max_linear_iterations
                or time_is_up()
            ):
                break
            least, idle = (residual.norm, 0) if residual.norm < least else (least, idle + 1)
            if idle >= IDLE and not self._exact:  # what rounding x to float32 leaves
                break
        self._sinks = passes.descent.sinks and self._exact
        self.whole = self._sinks or not math.isfinite(residual.norm) or not passes.bounded
        return iterations

    def move(self, length: float) -> float:
        """Let x go only this part of the last iteration's step; with length 1 it is there."""
        passes = self.iterate
        if length == 1.0:
            return passes.residual.norm
        self._prepare_shortening()
        passes.shorten_step(self._length, length, self._step)
        self._length = length
        return passes.residual.evaluate(passes.x)

    def _prepare_shortening(self) -> None:
        """Note the whole step before the first part of it is taken back."""
        if self._length == 1.0:
            self._step = float(self.iterate.residual.scalars.numpy()[int(engine.STEP)])
            self.iterate.store_best()
            self.iterate.forget_direction()

    def accept(self, iterations: int) -> Step:
        """Return the step; the energy judges a shortened one now, iterations of the solve have been judged."""
        if self._length < 1.0:
            self.iterate.judge()
            self._sinks = self.iterate.descent.sinks
        return Step("newton", iterations, self._active, interim=self._sinks)

    def fall_back(self, iterations: int, norms: deque[float], best: float, length: float) -> Step:
        """Take projected cycles from where the search has ended."""
        passes = self.iterate
        self._prepare_shortening()
        passes.begin_cycles(passes.descent.due(0))
        return Step(
            "monotone cycle", iterations + passes.monotone_step().linear_iterations, self._active
        )
