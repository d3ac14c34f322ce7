"""Penalty method: stiff springs replace the bounds.

Newton's method on the penalized equations is policy iteration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import warp as wp

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.multigrid.black_box_multigrid import takes_points
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step, WorkspaceBase
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.settings import Positive, Share
from warp_lcp.subproblems.active_set_kernels import ON_FREE
from warp_lcp.subproblems.multigrid_workspace import ColdStart
from warp_lcp.subproblems.principal_system import principal_system
from warp_lcp.subproblems.reduced_system import NewtonSettings

KERNELS = KernelFile(Path(__file__).parent / "headers/penalty.h")
MOVE = KERNELS["penalty.move"]
SORT = KERNELS["penalty.sort"]
# Ratio of the residual to the springs' error from which other errors dominate; |A D^-1| <= 2 on
# grids.
DOMINANT = 4.0
SHARE = 0.1  # of the tolerance that the penalty's own error may take
LEAST_RAISE = 10.0  # least factor by which rho grows
# Largest rho: beyond it float64 cannot represent the violation of an unknown of its bound's size.
LARGEST = 1e12
EARLY = 10  # steps in which the set may change while the residual rises


@dataclass(frozen=True, kw_only=True)
class Penalty(NewtonSettings):
    """Penalty method with policy iteration (Lai et al. 2020).

    It replaces the bounds by springs and solves the piecewise linear equations.

    The equations are A z + b + rho D (min(z - l, 0) + max(z - u, 0)) = 0, D the diagonal of the
    natural residual's d. With V the unknowns that violate a bound, a step is Newton's: (A + rho
    D_V) z+ = -b + rho D_V g, g the violated bound. It depends on V alone, so it starts from x =
    clip(z, l, u), where its right-hand side is -(A x + b): no terms cancel for any rho. On grids it
    is solved by conjugate gradients with a multigrid cycle on A + rho D_V. With an M-matrix and
    bounds on one side the equations are concave or convex: from the second step on z moves off the
    bounds, V shrinks, and is found after finitely many steps. Elsewhere V may cycle, and the solve
    ends with STAGNATED or MAX_ITERATIONS.

    The error of the method: where y > 0, z is below its bound by y / (rho d), and neighbors solve
    their equations with that z. The result is x = clip(z, l, u), and the criteria are checked on
    its natural residual, which is O(1 / rho): about |A D^-1 y_V| / rho. rho is raised in
    proportion, as a rule once, up to 1e12, where V stays or that error is most of the residual, and
    the error is more than a tenth of the tolerance.

    `linear_iterations` counts iterations on the finest grid, factorizations where A is dense.

    Args:
        rho: stiffness of the springs in units of d, without units; 1e6 suffices for tolerances down
            to about 1e-6 of the residual.
        precision: "mixed": x float64, corrections float32 on grids; "double"; or "single": x
            rounded to float32 as well.
        monotone_cycles: projected multigrid cycles of a cold start on a grid.
        eta: each linear solve reduces its residual by this factor, its square where V has stayed,
            or to the accuracy still needed.
        max_linear_iterations: maximum number of iterations of one linear solve.
        cycle: settings of multigrid cycles.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.array([[2.0, -1.0], [-1.0, 2.0]]), device="cpu")
        >>> result = wl.solve(wl.LCP(A, np.array([2.0, -3.0])), wl.Penalty())
        >>> print(result.status.name, result.x.numpy().round(4))
        CONVERGED [0.  1.5]
    """

    needs: ClassVar[str] = "M-matrix; other positive definite matrices without a proof"
    definite: ClassVar[bool] = True

    rho: Positive = 1e6
    eta: Share = 0.01

    def init(self, problem: LCP) -> PenaltyWorkspace:
        """Return a workspace."""
        return PenaltyWorkspace(problem, self)

    def step(self, problem: LCP, work: PenaltyWorkspace, x: DeviceArray) -> Step:
        """Take a monotone cycle (cold start), else a step of policy iteration."""
        if work.cycles_left > 0:
            work.cycles_left -= 1
            return work.monotone_step()
        return work.policy_step(x)


class PenaltyWorkspace(WorkspaceBase):
    """Workspace of the method for one problem.

    Attributes:
        rho: current stiffness, in units of d.
        side: stored int8 field; the bound that each unknown is beyond: -1 the lower, 1 the upper,
            else 0.
    """

    def __init__(self, problem: LCP, settings: Penalty) -> None:
        self.settings, layout = settings, problem.layout
        self.cold_start: ColdStart | None = None
        if takes_points(problem.A):
            self.cold_start = ColdStart(problem, problem.A, settings)
            self.scratch = self.cold_start.scratch
        start = self.cold_start
        super().__init__(
            problem,
            settings.precision,
            x=start.x if start else None,
            residual=start.residual if start else None,
        )
        self.system = principal_system(
            problem,
            self.precision.correction,
            bounded=False,
            settings=settings.cycle,
            shifted=True,
            hierarchy=self.cold_start.hierarchy if self.cold_start else None,
        )
        self.side, self._shift = layout.zeros(wp.int8), layout.zeros(wp.float64)
        self._free, self._inside = layout.zeros(wp.uint8), layout.zeros(wp.uint8)
        self._sums = RowReduction(rows_of(self.x), 3)
        self.rho, self.cycles_left, self.steps, self.target = settings.rho, 0, 0, 0.0

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the set and the last stiffness; the operator may have changed."""
        self.floating = floating
        s = self.settings
        self.cycles_left = (
            s.monotone_cycles
            if self.cold_start is not None and self.problem.bounded and not warm
            else 0
        )
        self.rho, self.steps, self.target = s.rho, 0, tolerance
        self._excess, self._moved, self._stale = 0.0, math.inf, True
        self.side.zero_()
        self.system.refresh()
        if self.cold_start is not None:
            self.cold_start.start(warm=warm, tolerance=tolerance, floating=floating)

    def monotone_step(self) -> Step:
        """Take a projected multigrid cycle on all unknowns."""
        assert self.cold_start is not None
        return self.cold_start.monotone_step()

    def policy_step(self, x: DeviceArray) -> Step:
        """Solve with a penalty on the unknowns beyond their bounds; update that set.

        With V that set, (A + rho D_V) e = -(A x + b) / size from x = clip(z, l, u), and z = x +
        size e. Springs are then updated at z, and z is projected onto the bounds.
        """
        s, p = self.settings, self.problem
        first = self.steps == 0
        if first:
            self.residual.affine(x)
        if first or self._raise():
            # The first step finds the springs at x; a larger rho keeps them.
            self._sort(x, first=first, keep=not first)
            self.residual.affine(x)  # unknowns within y / (rho d) of a bound are on it now
            self._stale = True
        self.steps += 1
        if self._stale:
            self.system.restrict(self._free, self._shift)
        # (A + rho D_V) e = -(A x + b) / size; the solve is more accurate once V has stayed.
        settled, size = self._moved == 0, max(self.residual.norm, 1e-300)
        self._sums.of(ON_FREE, y=self.residual.y, free=self._free, g=self.system.r, scale=1 / size)
        if self.floating is not None:  # the singular part: components without springs
            self.floating.project(self.system.r, self._inside)
        factor = max(s.eta**2 if settled else s.eta, 0.3 * SHARE * self.target / size)
        norm = self.system.norm()
        iterations = self.system.solve(factor * norm, s.max_linear_iterations)[0] if norm > 0 else 0
        # z = x + size e; then y at z, the springs of the next step, and x = clip(z, l, u).
        MOVE.bind(
            self._sums.rows, x=x, e=self.system.e, unknown=p.unknown, side=self.side, size=size
        ).launch()
        self.residual.affine(x)
        active = self._sort(x)
        self._finish_move(x)
        # This writes y, which the grid's own evaluation does not store.
        NaturalResidual.evaluate(self.residual, x)
        self._stale = self._moved > 0
        return Step("policy", iterations, active, interim=self._stale and self.steps <= EARLY)

    def _raise(self) -> bool:
        """Stiffen the springs where their error dominates; return whether it did.

        Their error must be most of the residual and more than its share of the tolerance. rho grows
        by the ratio of the two.
        """
        allowed = SHARE * self.target
        settled = self._moved == 0 or self.residual.norm <= DOMINANT * self._excess
        if not settled or not self._excess > allowed > 0 or self.rho >= LARGEST:
            return False
        self.rho = min(LARGEST, self.rho * max(LEAST_RAISE, self._excess / allowed))
        return True

    def _sort(self, x: DeviceArray, *, first: bool = False, keep: bool = False) -> int:
        """Update the springs at z, project z onto the bounds; return their number.

        A spring stays if z is still beyond its bound. Its row of the step says z - g = -y / (rho
        d), so that the sign of y decides. The solution of the linear solve has no reliable sign
        there, because it is smaller than the tolerance of the solve.
        """
        p, r = self.problem, self.residual
        moved, active, square = self._sums.of(
            SORT,
            bounds=p.bounds.operands,
            x=x,
            y=r.y,
            d=r.diagonal,
            unknown=p.unknown,
            side=self.side,
            shift=self._shift,
            free=self._free,
            inside=self._inside,
            rho=self.rho,
            unit=r.unit,
            first=first,
            keep=keep,
        )
        self._moved, self._excess = float(moved), math.sqrt(float(square)) / self.rho
        return int(active)
