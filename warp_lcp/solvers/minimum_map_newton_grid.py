"""Newton's method on the minimum map on grids, with the passes of `ProjectedMultigrid` over memory."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_lcp.deadline import time_is_up
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil
from warp_lcp.problem.solve import Step
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.reduced import grid_step_kernels as engine
from warp_lcp.solvers.projected_multigrid_workspace import AssessedResidual, MultigridWorkspace

if TYPE_CHECKING:
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

DECREASE = 1e-4  # share of a step by which the residual must fall
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
        self._away = wp.zeros(planes * rows, dtype=wp.uint8, device=A.device)  # rows with such unknowns

    @property
    def away(self) -> bool:
        """Whether held unknowns are not at their bounds, on any rank; read back."""
        found, across = bool(self._away.numpy().any()), self.problem.layout.across
        return found if across is None else across.any(found)

    def hold(self, x: wp.array[Any]) -> None:
        """Move held unknowns onto their bounds, and the right-hand side with them."""
        p, s, finest = self.problem, self._A.stencil, self._finest
        engine.HOLD.bind(s.rows, bounds=p.bounds.operands, x=x, g=finest.b, away=self._away, ROUNDED=self._rounded).launch(wp.launch)
        s.wrap(x)
        if s.ghosts is not None:
            self._away.fill_(1)  # which rows beside a cut have moved, others know
        _, around_y, around_z = s.periodic
        engine.RIGHT_SIDE.bind(
            s.rows, stencil=s, around_y=around_y, around_z=around_z, x=x, b=p.b, free=finest.stencil.d, g=finest.b, away=self._away,
            scalars=self.scalars,
        ).launch(wp.launch)  # fmt: skip
        self._away.zero_()


class GridNewtonWorkspace(MultigridWorkspace):
    """Memory of the method for one grid problem.

    A Newton step holds what the minimum map does not call free, moves it onto its bounds, and solves on the rest by conjugate gradients
    with a multigrid cycle. Each iteration moves x itself, projected, and evaluates the residual there, so that no correction is kept. The
    linear solve ends when the residual is small enough, or as soon as an iterate calls other unknowns free: what it was to solve is not
    the system any more. Conjugate gradients carry their direction on to the next system.

    Args:
        problem: the problem.
        A: its operator.
        settings: the method.
    """

    def __init__(self, problem: LCP, A: HasStencil, settings: MinimumMapNewton) -> None:
        super().__init__(problem, A, settings)  # type: ignore[arg-type]
        self._newton, self._norms, self._target = settings, list[float](), 0.0

    def _residual(self, problem: LCP, rounded: bool) -> MinimumMapResidual:
        return MinimumMapResidual(problem, self.A, self.hierarchy, rounded=rounded)

    def start(self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None) -> None:
        """Forget the search direction and the residuals; the operator may have changed."""
        self._norms, self._target = [], tolerance
        super().start(warm=warm, tolerance=tolerance, floating=floating)

    def wants_monotone_cycle(self) -> bool:
        """Return whether the start is still cold, or Newton's steps have failed."""
        return self._cycles_left > 0

    def step(self, x: wp.array[Any] | None = None) -> Step:
        """Take a monotone cycle while the start is cold, else a safeguarded Newton step; x is the workspace's own."""
        return self.monotone_step() if self.wants_monotone_cycle() else self.newton_step()

    def newton_step(self) -> Step:
        """Solve on the free set, and shorten the step if the residual exceeds the largest of the last ones."""
        residual, s = self.residual, self._newton
        assert isinstance(residual, MinimumMapResidual)
        self._norms = [*self._norms, residual.norm][-s.memory :]
        wanted, active, iterations, limit = max(s.eta * residual.norm, self._target), residual.active, 0, max(self._norms)
        if residual.away:
            self._store()
            residual.hold(self.x)
        least, idle = residual.norm, 0
        while True:
            self.truncated_step()
            iterations += 1
            if self.stale or not residual.norm > wanted or iterations >= s.max_linear_iterations or time_is_up():
                break
            least, idle = (residual.norm, 0) if residual.norm < least else (least, idle + 1)
            if idle >= IDLE and self._rounded is not None:  # what rounding x to float32 leaves
                break
        sinks = self.descent.sinks and self._rounded is None  # then the residual may rise
        if sinks or not residual.norm > (1 - DECREASE) * limit or not math.isfinite(residual.norm) or not self.bounded:
            return Step("newton", iterations, active, interim=sinks)
        return self._shorten(limit, iterations, active)

    def _creeps(self) -> bool:
        """Where x is rounded to float32 the energy says little of a step, and Newton's own safeguard has the word."""
        return super()._creeps() and self._rounded is None

    def _shorten(self, limit: float, iterations: int, active: int) -> Step:
        """Take the longest of the halves of the last move that the safeguard allows; if there is none, projected cycles."""
        residual, s = self.residual, self._newton
        whole, length = float(residual.scalars.numpy()[int(engine.STEP)]), 1.0
        self._store()
        self._forget()
        for _ in range(s.backtracks):
            self._set_length(length, 0.5 * length, whole)
            length *= 0.5
            if residual.evaluate(self.x) <= (1 - DECREASE * length) * limit:
                self._judge()
                return Step("newton", iterations, active, interim=self.descent.sinks)
        self._begin_cycles(self.descent.due(0))
        return Step("monotone cycle", iterations + self.monotone_step().linear_iterations, active)

    def _set_length(self, old: float, new: float, whole: float) -> None:
        """Change how far x has moved along the last direction, in parts of the whole step."""
        residual = self.residual
        residual.set(engine.STEP, (old - new) * whole)
        self._undo(self.x)
        self._round(self.x)
        residual.set(engine.STEP, new * whole)
