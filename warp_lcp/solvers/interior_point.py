"""Interior-point method: Newton's method on the Kojima map.

By default with Mehrotra's predictor and corrector.

w = x - l and v = u - x, infinite where there is no bound; s and t are their multipliers, 0 there.
With dx known, ds = (tau - w s - second dx_a ds_a) / w - (s / w) dx and dt = (tau - v t + second
dx_a dt_a) / v + (t / v) dx, where dx_a is the predictor's step; `joined` is 1 where the correction
e is added to it. FUSED passes go over the rows of a grid whose system is condensed at the end of
the step, the others over flat fields.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels import FusedKernel, KernelFile, PrecomputedProduct
from warp_lcp.kernels.fields import zeros_like
from warp_lcp.kernels.layout import KernelStencil
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.multigrid.black_box_multigrid import takes_points
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step, WorkspaceBase
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.settings import Count, Positive, Share
from warp_lcp.subproblems.equilibration import EquilibratedWorkspace
from warp_lcp.subproblems.grid_system import GridSystem
from warp_lcp.subproblems.multigrid_workspace import ColdStart
from warp_lcp.subproblems.principal_system import principal_system
from warp_lcp.subproblems.reduced_system import NewtonSettings

LARGEST_START = 1e6  # times the residual's norm: largest ||b|| that sets the size of the start

KERNELS = KernelFile(Path(__file__).parent / "headers/interior_point.h")
INSIDE = KERNELS["interior_point.inside"]
MULTIPLIERS = KERNELS["interior_point.multipliers"]
CONDENSE = KERNELS["interior_point.condense"]
MOVE = KERNELS["interior_point.move"]
RATIOS = KERNELS["interior_point.ratios"]
CENTER = KERNELS["interior_point.center"]
# A plane is condensed when the one above it has moved.
ADVANCE = FusedKernel("interior_point.advance", (MOVE, 0), (CONDENSE, 1))


# A near start has w A_ii and s at least this multiple of the residual's root mean square; 3 to 50
# were measured.
NEAR = 10.0


@dataclass(frozen=True, kw_only=True)
class InteriorPoint(NewtonSettings):
    """Primal-dual interior-point method: follow the central path to the solution.

    [Book] 2.3, eq. 2.105-2.114, algorithm 9; by default Mehrotra's predictor-corrector (1992).

    With w = x - l, v = u - x and multipliers s, t >= 0, the solution has A x + b = s - t, W s = 0,
    V t = 0. A step is Newton's for W s = V t = tau: (A + D) dx = -(A x + b) + tau / w - tau / v
    with D = s / w + t / v, and it is shortened so that w, v, s and t all stay positive. Equations
    have D = 0, unknowns with l = u are held. Mehrotra's rule solves with tau = 0 first (the
    predictor), sets sigma = (mu_after / mu)^3 and solves again with tau = sigma mu and the
    predictor's second-order terms. The book's rule solves once with tau = mu / k and goes the share
    k / (N + 1) of the way to the boundary in step k. All variables take one common step, without
    which the method does not converge for LCPs that are no quadratic programs.

    A must be positive semi-definite (x'Ax >= 0; it need not be symmetric), else steps may become
    arbitrarily short. Dense and sparse problems are solved in units in which all rows have similar
    sizes. Where there is no solution, the iterates diverge. If A then has at most 40,000 entries, a
    linear program decides whether INFEASIBLE is proved. float32 can represent D up to 1e30, so D is
    not limited. On grids the shifted systems are solved by conjugate gradients with multigrid,
    stopped on the norm of d^(-1/2) r, d the diagonal of A + D. `linear_iterations` counts their
    iterations.

    Args:
        precision: "mixed": iterate and multipliers float64, corrections float32 on grids; "double";
            or "single": x rounded as well.
        mehrotra: predictor and corrector; False: the book's step rule.
        horizon: N of the book's rule, the number of steps in which it reaches the boundary.
        backoff: share of the longest step that is taken, in (0, 1).
        start: a cold start has w A_ii and s at least this multiple of the root mean square of b, or
            of the residual at clip(0, l, u) if that is larger.
        monotone_cycles: projected multigrid cycles of a cold start on a grid, from which the path
            is joined where it is near.
        predictor_eta: the predictor's linear solve reduces its residual by this factor.
        eta: the same of the corrector, and of the book's step.
        max_linear_iterations: maximum number of iterations of one linear solve.
        cycle: settings of multigrid cycles.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.array([[2.0, -1.0], [-1.0, 2.0]]), device="cpu")
        >>> result = wl.solve(wl.LCP(A, np.array([2.0, -3.0])), wl.InteriorPoint())
        >>> print(result.status.name, result.x.numpy().round(4))
        CONVERGED [0.  1.5]
    """

    needs: ClassVar[str] = "A positive semi-definite; it need not be symmetric"
    definite: ClassVar[bool] = True

    mehrotra: bool = True
    horizon: Count = 100
    backoff: Share = 0.995
    start: Positive = 15.0
    predictor_eta: Share = 0.3
    eta: Share = 0.2

    def init(self, problem: LCP) -> InteriorPointWorkspace | EquilibratedWorkspace:
        """Return a workspace: for dense and sparse problems one that equilibrates them."""
        if EquilibratedWorkspace.suits(problem):
            return EquilibratedWorkspace(
                problem, self.precision, lambda scaled: InteriorPointWorkspace(scaled, self)
            )
        return InteriorPointWorkspace(problem, self)

    def step(
        self, problem: LCP, work: InteriorPointWorkspace | EquilibratedWorkspace, x: DeviceArray
    ) -> Step:
        """Take a monotone cycle after a cold start, then path-following steps."""
        if isinstance(work, EquilibratedWorkspace):
            return work.step(self.step)
        if work.cycles_left > 0:
            work.cycles_left -= 1
            return work.monotone_step(x)
        if not work.begun:
            work.begin(x)
        return work.path_step(x)


@dataclass(frozen=True, slots=True)
class ComplementaryPairs:
    """Distances of x to its bounds and their multipliers.

    Stored float64 fields; w s = v t = mu on the central path.

    Attributes:
        w: x - l; infinite without a lower bound.
        v: u - x; infinite without an upper bound.
        s: multiplier of the lower bound.
        t: multiplier of the upper bound.
    """

    w: DeviceArray
    v: DeviceArray
    s: DeviceArray
    t: DeviceArray


@dataclass(frozen=True, slots=True)
class PathDirection:
    """A direction along the central path: ds and dt follow from dx.

    Attributes:
        a: the predictor's direction of x.
        e: the solution of the linear system.
        scale: of both.
        second: factor of the second-order terms dw ds and dv dt.
        joined: 1 if the predictor's direction is part of the corrector's, else 0.
        tau: target of the products w s and v t.
    """

    a: DeviceArray
    e: DeviceArray
    scale: float
    second: float
    joined: float
    tau: float


@dataclass(frozen=True, slots=True)
class PathSystem:
    """The linear system of a step: A + D with D = s / w + t / v.

    Attributes:
        x: iterate, a stored field.
        b: of the problem.
        unknown: 1 where there is an unknown.
        free: which unknowns move, uint8.
        D: diagonal that is added (written).
        r: right-hand side (written).
        scale: of the right-hand side.
        tau: target of the products w s and v t.
    """

    x: DeviceArray
    b: DeviceArray
    unknown: DeviceArray
    free: DeviceArray
    D: DeviceArray
    r: DeviceArray
    scale: float
    tau: float


class InteriorPointWorkspace(WorkspaceBase):
    """Workspace of the method for one problem.

    Attributes:
        mu: mean of the products w s and v t, units of x y.
        cold_start: monotone cycles, on a grid with bounds.
    """

    def __init__(self, problem: LCP, settings: InteriorPoint) -> None:
        self.settings, layout = settings, problem.layout
        self.cold_start: ColdStart | None = None
        shared = None
        if takes_points(problem.A) and problem.bounded:
            cycles = self.cold_start = ColdStart(problem, problem.A, settings)
            self.scratch, shared = cycles.scratch, cycles.hierarchy
            super().__init__(problem, settings.precision, x=cycles.x, residual=cycles.residual)
        else:
            super().__init__(problem, settings.precision)
        self.system = principal_system(
            problem,
            self.precision.correction,
            bounded=False,
            settings=settings.cycle,
            shifted=problem.bounded,
            hierarchy=shared,
        )
        upper = problem.bounds.may_bind[1]
        self._w, self._s = layout.zeros(wp.float64), layout.zeros(wp.float64)
        self._v, self._t = (
            (layout.zeros(wp.float64), layout.zeros(wp.float64)) if upper else (self._w, self._s)
        )
        self._D, self.free = layout.zeros(wp.float64), layout.zeros(wp.uint8)
        self._predicted = zeros_like(self.system.e)
        # Conjugate gradients leave the residual in r.
        self._carries = isinstance(self.system, GridSystem) and problem.A.symmetric
        fused = isinstance(self.system, GridSystem) and self.system.fused
        self._upper, self._fusable = (
            upper,
            fused and problem.bounded and settings.mehrotra and self._rounded is None,
        )
        self._sums, self._longest = (
            RowReduction(rows_of(self.x), 3),
            wp.zeros(1, dtype=wp.float64, device=problem.device),
        )
        self._grid_sums = (
            RowReduction(problem.A.stencil.rows, 3)  # type: ignore[attr-defined]
            if self._fusable
            else self._sums
        )
        self.cycles_left = self.steps = self.count = 0
        self.near = self.begun = False
        self.mu = self.target = self.size = 0.0

    @property
    def _hierarchy(self) -> Hierarchy:
        """Hierarchy of a grid's system."""
        assert isinstance(self.system, GridSystem)
        return self.system.hierarchy

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the path; the operator may have changed."""
        self.floating = floating
        s = self.settings
        cold_grid = self.problem.bounded and self._carries and not warm
        self.cycles_left = s.monotone_cycles if cold_grid else 0
        self.near = warm or self.cycles_left > 0
        self.begun = False
        self.steps, self.mu, self.count, self.target = 0, 0.0, 0, tolerance
        self.system.refresh()
        if self.cold_start is not None:
            self.cold_start.start(warm=not cold_grid, tolerance=tolerance, floating=floating)

    def monotone_step(self, x: DeviceArray) -> Step:
        """Take a projected multigrid cycle on all unknowns."""
        assert self.cold_start is not None
        return self.cold_start.monotone_step()

    @property
    def is_grid(self) -> bool:
        """Whether the residual is a grid's own, which does not store y."""
        return self.cold_start is not None

    @property
    def _fused(self) -> bool:
        """Whether the pass that moves x also evaluates and condenses there.

        Used by one CPU thread, without periodic axes.
        """
        return self._fusable and self.floating is None and self.count > 0

    def begin(self, x: DeviceArray) -> None:
        """Move x inside its bounds, and choose the multipliers.

        Far from the path their size follows from b and the residual, near it from the residual
        alone: s and t are at least `least`, and so are w A_ii and v A_ii [units of y]. With n
        multipliers `least` = NEAR ||r|| / sqrt(n) near the path, else start max(||b||, ||r||) /
        sqrt(unknowns), ||b|| limited to LARGEST_START ||r||. mu = (w's + v't) / n.
        """
        p = self.problem
        self._inside(x, 0.0)
        self.count = int(self._multipliers(0.0)[1])
        if self.count:
            if self.near:
                least = NEAR * self.residual.norm / math.sqrt(self.count)
            # A far start: the size of b, or of the residual if that is larger.
            else:
                unknowns = max(int(np.count_nonzero(p.unknown.numpy() == 1)), 1)
                # b may be 0 where the bounds are not, and one held row of b may be far larger than
                # the others.
                size = max(
                    min(self.residual.norm_of_b(), LARGEST_START * self.residual.norm),
                    self.residual.norm,
                )
                least = self.settings.start * size / math.sqrt(unknowns)
            self._inside(x, least)
            self.residual.affine(x)
            self.mu = self._multipliers(least)[0] / self.count
        elif self.is_grid:
            self.residual.affine(x)
        self.begun, self.condensed = True, False
        # The singular part: components none of whose unknowns has a bound.
        if self.floating is not None:
            free, w, v = self.free.numpy() != 0, self._w.numpy(), self._v.numpy()
            self._without_bounds = wp.array(
                (free & np.isinf(w) & np.isinf(v)).astype(np.uint8), device=p.device
            )

    def path_step(self, x: DeviceArray) -> Step:
        """Solve for the direction; move nearly as far as w, v, s and t stay positive.

        The predictor solves (A + D) dx = -(A x + b) with tau = 0, D = s / w + t / v. Mehrotra's
        corrector solves again with tau = sigma mu and the second-order terms. The book's rule
        solves once with tau = mu / k. The step is `share` of the longest one; all variables take
        the same length. The system is scaled by 1 / size, the norm of the residual, so that float32
        can hold it.
        """
        s, self.steps = self.settings, self.steps + 1
        if self._fused:
            return self._fused_step(x)
        self.size = max(self.residual.norm, 1e-300)
        tau = 0.0 if s.mehrotra else self.mu / self.steps
        second = 0.0
        # D = s / w + t / v and r = -(A x + b) + tau / w - tau / v, over `size`.
        self._sums.of(
            CONDENSE,
            self._pairs,
            self._condensing(x, self._D, tau),
            stencil=self._stencil,
            bounds=self.problem.bounds.operands,
            UPPER=self._upper,
            FUSED=False,
        )
        self.system.restrict(self.free, self._D if self.problem.bounded else None)
        self._project()
        iterations = self._solve(s.predictor_eta if s.mehrotra and self.count else s.eta)
        longest, products = self._ratios(second, tau)
        if s.mehrotra and self.count:
            # Mehrotra's corrector, from the predictor's ratios.
            tau, second = self._center(longest, products), 1.0
            self._correct(tau, y=self.residual.y, D=None)
            self._project()
            iterations += self._solve(s.eta)
            longest, _ = self._ratios(second, tau)
        # The same length for x, w, v, s and t.
        share = s.backoff if s.mehrotra else min(s.backoff, self.steps / (s.horizon + 1))
        length = min(1.0, share / longest) if longest > 0 else 1.0
        self._move(x, second, tau, length)
        if self.is_grid:
            NaturalResidual.evaluate(self.residual, x)
        name = "predictor-corrector" if s.mehrotra else "path"
        return Step(name, iterations, None, interim=not s.mehrotra and self.steps <= s.horizon)

    def _fused_step(self, x: DeviceArray) -> Step:
        """Take Mehrotra's step of `path_step` in four passes over memory.

        The pass that moves x also condenses the system of the next step.

        Solve the predictor's system (tau = 0), choose tau = sigma mu from the longest predictor
        step, solve again with the corrector's right-hand side, and move by min(1, backoff a),
        where a is the longest step that leaves w, v, s and t >= 0.
        """
        s, finest = self.settings, self._hierarchy.finest
        if not self.condensed:
            self.condensed = True
            self._advance(x, 0.0, 0.0)
        self._hierarchy.rebuild()
        iterations = self.system.solve(s.predictor_eta * self._norm(1), s.max_linear_iterations)[0]
        tau = self._center(*self._ratios(0.0, 0.0))
        self._correct(tau, y=None, D=finest.stencil.d)
        iterations += self.system.solve(s.eta * self._norm(0), s.max_linear_iterations)[0]
        longest, _ = self._ratios(1.0, tau)
        self._advance(x, tau, min(1.0, s.backoff / longest) if longest > 0 else 1.0)
        return Step("predictor-corrector", iterations, None)

    def _center(self, longest: float, products: float) -> float:
        """Return Mehrotra's tau = sigma mu with sigma = (mu_after / mu)^3.

        mu_after is that of the longest predictor step of length a: (1 - a) mu + a^2 (dw ds + dv dt)
        / count.
        """
        # The products vanish by rounding, or by coefficients that corrections cannot represent.
        if not self.mu > 0:
            return 0.0
        length = min(1.0, 1 / longest) if longest > 0 else 1.0
        after = (1 - length) * self.mu + length**2 * products / self.count
        return self.mu * min(1.0, max(0.0, after / self.mu)) ** 3

    @property
    def _pairs(self) -> ComplementaryPairs:
        return ComplementaryPairs(self._w, self._v, self._s, self._t)

    @property
    def _pass_sums(self) -> RowReduction:
        """Sums of the kernels: over a grid's rows where passes are fused."""
        return self._grid_sums if self._fused else self._sums

    def _direction(self, second: float, tau: float) -> PathDirection:
        joined = 1.0 if self._carries else 0.0
        return PathDirection(self._predicted, self.system.e, self.size, second, joined, tau)

    @property
    def _stencil(self) -> KernelStencil:
        r = self.residual
        return (
            self.problem.A.stencil  # type: ignore[attr-defined]
            if self._fused
            else PrecomputedProduct(r.diagonal, r.unit, r.y)
        )

    def _condensing(self, x: DeviceArray, D: DeviceArray, tau: float) -> PathSystem:
        p = self.problem
        return PathSystem(x, p.b, p.unknown, self.free, D, self.system.r, 1 / self.size, tau)

    def _advance(self, x: DeviceArray, tau: float, length: float) -> None:
        """Move, unless the length is 0, and condense the next system there.

        The same pass sums the square of the residual's norm at the new x.
        """
        sums, rows, bounds, upper = (
            self._grid_sums,
            self._grid_sums.rows,
            self.problem.bounds.operands,
            self._upper,
        )
        direction, moving = self._direction(1.0, tau), None
        self.size = max(self.residual.norm, 1e-300)
        if length:
            moving = MOVE.bind(
                rows,
                self._pairs,
                direction,
                bounds=bounds,
                x=x,
                length=length,
                out=sums.partials[2 * rows.places :],
                UPPER=upper,
                FUSED=True,
            )
        system = self._condensing(x, self._hierarchy.finest.stencil.d, 0.0)
        condensing = CONDENSE.bind(
            rows,
            self._pairs,
            system,
            stencil=self._stencil,
            bounds=bounds,
            out=sums.partials,
            UPPER=upper,
            FUSED=True,
        )
        ADVANCE.launch(moving, condensing)
        sums.add_up(0, columns=3)
        self.residual.mark_evaluated(self._norm(0))
        if length:
            self.mu = float(sums.scalars.numpy()[2]) / self.count

    def _norm(self, slot: int) -> float:
        """Return the norm whose square a fused pass has summed."""
        return float(np.sqrt(self._grid_sums.scalars.numpy()[slot]))

    def _ratios(self, second: float, tau: float) -> tuple[float, float]:
        """Return the reciprocal of the longest step, and sum(dw ds + dv dt).

        The reciprocal is 0 if the step is not limited. It is the largest of -dw / w, -dv / v, -ds /
        s and -dt / t.
        """
        self._longest.zero_()
        sums = self._pass_sums.of(
            RATIOS,
            self._pairs,
            self._direction(second, tau),
            longest=self._longest,
            UPPER=self._upper,
            FUSED=self._fused,
        )
        products = float(sums[0])
        return float(self._longest.numpy()[0]), products

    def _correct(self, tau: float, *, y: DeviceArray | None, D: DeviceArray | None) -> None:
        """Write the corrector's right-hand side."""
        self._pass_sums.of(
            CENTER,
            self._pairs,
            e=self.system.e,
            free=self.free,
            a=self._predicted,
            r=self.system.r,
            y=y,
            D=D,
            scale=self.size,
            tau=tau,
            carried=self._carries,
            UPPER=self._upper,
            FUSED=self._fused,
        )

    def _move(self, x: DeviceArray, second: float, tau: float, length: float) -> None:
        """Take the step, and store mu = (w's + v't) / the number of multipliers."""
        sums = self._sums.of(
            MOVE,
            self._pairs,
            self._direction(second, tau),
            bounds=self.problem.bounds.operands,
            x=x,
            length=length,
            UPPER=self._upper,
            FUSED=False,
        )
        self.mu = float(sums[0]) / max(self.count, 1)
        self._finish_move(x)

    def _inside(self, x: DeviceArray, width: float) -> None:
        """Set w and v to at least width / d, and x accordingly."""
        p, r = self.problem, self.residual
        INSIDE.bind(
            self._sums.rows,
            self._pairs,
            bounds=p.bounds.operands,
            x=x,
            unknown=p.unknown,
            free=self.free,
            d=r.diagonal,
            unit=r.unit,
            width=width,
            UPPER=self._upper,
            FUSED=False,
        ).launch()

    def _multipliers(self, least: float) -> tuple[float, float]:
        """Set s and t to the parts of y of each sign, at least `least`.

        Returns the sum of the products w s and v t, and the number of finite bounds.
        """
        total, count = self._sums.of(
            MULTIPLIERS, self._pairs, y=self.residual.y, least=least, UPPER=self._upper, FUSED=False
        )
        return float(total), float(count)

    def _solve(self, eta: float) -> int:
        """Reduce the right-hand side by a factor; return linear iterations."""
        target = eta
        if not self.count:
            target = max(eta, 0.3 * self.target / self.size)
        return self.system.solve(target * self.system.norm(), self.settings.max_linear_iterations)[
            0
        ]

    def _project(self) -> None:
        """Remove the part that a singular component without bounds cannot meet."""
        if self.floating is not None:
            self.floating.project(self.system.r, self._without_bounds)
