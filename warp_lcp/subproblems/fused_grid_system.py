"""Reduced system of a grid in fused passes.

Conjugate gradients move x itself, by the passes of projected multigrid.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.deadline import time_is_up
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Precision, Step
from warp_lcp.problem.operator_protocol import HasStencil
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.subproblems import grid_step_kernels as engine
from warp_lcp.subproblems.multigrid_workspace import MultigridWorkspace
from warp_lcp.subproblems.residual_and_active_set import ResidualAndActiveSet

if TYPE_CHECKING:
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

IDLE = StoppingCriteria.patience  # iterations of one linear solve without a smaller residual


class MinimumMapResidual(ResidualAndActiveSet):
    """Natural residual with the free set of the minimum map.

    Free are the unknowns with x - y / A_ii within their bounds.

    Attributes:
        away: whether held unknowns are not at their bounds yet.
    """

    _away: DeviceArray
    _minimum_map = True

    def __init__(self, problem: LCP, A: HasStencil, hierarchy: Hierarchy, *, rounded: bool) -> None:
        super().__init__(problem, A, hierarchy, rounded=rounded)
        planes, rows, _ = A.stencil.padding.counts
        # Rows with such unknowns.
        self._away = wp.zeros(planes * rows, dtype=wp.uint8, device=A.device)

    @property
    def away(self) -> bool:
        """Whether held unknowns are not at their bounds, on any rank; read back."""
        found, comm = bool(self._away.numpy().any()), self.problem.layout.comm
        return found if comm is None else comm.any(found)

    def project_held(self, x: DeviceArray) -> None:
        """Move held unknowns onto their bounds, and update the right-hand side.

        Only in flagged rows and those beside them: g = -(A x + b) / size on the free set.
        """
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
            self._away.fill_(1)  # rows beside a cut may have moved on another rank
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
    """Newton's equations on a grid without a stored correction, see `ReducedSystem`.

    Each iteration of conjugate gradients, preconditioned by a multigrid cycle, moves x itself,
    projected, and evaluates the residual and the free set there. The linear solve ends when the
    residual is small enough, or as soon as the free set of an iterate differs, because the system
    has then changed. Conjugate gradients keep their direction for the next system.

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

    def __init__(self, problem: LCP, settings: MinimumMapNewton) -> None:
        self._settings = settings
        self._exact = Precision(settings.precision) is not Precision.SINGLE
        self.iterate = MultigridWorkspace(
            problem,
            problem.A,  # type: ignore[arg-type]
            settings,
            residual=MinimumMapResidual,
            ahead=False,
            # With x rounded to float32 the energy is too noisy: Newton's own safeguard decides.
            cycles_against_creeping=self._exact,
        )
        self._target, self._active, self._length, self._step = 0.0, 0, 1.0, 0.0
        self._sinks = False  # whether the energy has fallen to a new least

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the search direction; the operator may have changed."""
        self._target = tolerance
        self.iterate.start(warm=warm, tolerance=tolerance, floating=floating)

    def monotone_cycle(self) -> Step | None:
        """Take a projected cycle if one is due.

        That is after a cold start, if the free set creeps, or if Newton's steps have failed.
        """
        return self.iterate.monotone_step() if self.iterate.cycles_left > 0 else None

    def classify(self) -> Step | None:
        """Do nothing more: the evaluation of the residual has found the free set."""
        self._active, self._length = self.iterate.residual.active, 1.0
        return None

    def restrict(self) -> bool:
        """Move held unknowns onto their bounds.

        The hierarchy is updated for the free set before its next cycle.
        """
        passes, residual = self.iterate, self.iterate.residual
        assert isinstance(residual, MinimumMapResidual)
        if residual.away:
            passes.store_best()
            residual.project_held(passes.x)
        return True

    def solve(self) -> int:
        """Move x by conjugate gradients; return the number of iterations.

        They end when the residual's norm is at most max(eta |r_0|, tolerance), with |r_0| that at
        the start, or when the free set changes.
        """
        passes, residual, s = self.iterate, self.iterate.residual, self._settings
        target, least, iterations, idle = (
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
                or not residual.norm > target
                or iterations >= s.max_linear_iterations
                or time_is_up()
            ):
                break
            least, idle = (residual.norm, 0) if residual.norm < least else (least, idle + 1)
            if idle >= IDLE and not self._exact:  # the rounding of x to float32 limits the residual
                break
        self._sinks = passes.energy_monitor.sinks and self._exact
        self.whole = self._sinks or not math.isfinite(residual.norm) or not passes.bounded
        return iterations

    def move(self, length: float) -> float:
        """Shorten the last iteration's step to this part of it; return the residual.

        With length 1 x is already there.
        """
        passes = self.iterate
        if length == 1.0:
            return passes.residual.norm
        self._prepare_shortening()
        passes.shorten_step(self._length, length, self._step)
        self._length = length
        return passes.residual.evaluate(passes.x)

    def _prepare_shortening(self) -> None:
        """Store the whole step before it is shortened."""
        if self._length == 1.0:
            self._step = float(self.iterate.residual.scalars.numpy()[int(engine.STEP)])
            self.iterate.store_best()
            self.iterate.forget_direction()

    def accept(self, iterations: int) -> Step:
        """Return the accepted step.

        The energy judges a shortened step here; the iterations of the solve have been judged.
        """
        if self._length < 1.0:
            self.iterate.judge()
            self._sinks = self.iterate.energy_monitor.sinks
        return Step("newton", iterations, self._active, interim=self._sinks)

    def fall_back(self, iterations: int, norms: deque[float], best: float, length: float) -> Step:
        """Take projected cycles from the end of the search."""
        passes = self.iterate
        self._prepare_shortening()
        passes.begin_cycles(passes.energy_monitor.due(0))
        return Step(
            "monotone cycle", iterations + passes.monotone_step().linear_iterations, self._active
        )
