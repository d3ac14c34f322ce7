"""Subspace minimization after projected Gauss-Seidel sweeps.

Sweeps find the free set, a linear solve finds x on it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import warp as wp
from annotated_types import Ge

from warp_lcp.deadline import check_time
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step
from warp_lcp.problem.operator_protocol import HasRows, HasSweep, check_taken
from warp_lcp.settings import Count, Relaxation, Settings, Share
from warp_lcp.solvers.psor import SweepWorkspace
from warp_lcp.subproblems.active_set_kernels import ON_FREE, projected_move
from warp_lcp.subproblems.principal_system import principal_system
from warp_lcp.sweeps.sweep import sweep_for

KERNELS = KernelFile(Path(__file__).parent / "headers/gradient_projection.h")
BETWEEN = KERNELS["subspace.between"]
FOLLOW = KERNELS["subspace.follow"]
ROUNDING = 1e-14  # a smaller relative change of the energy counts as none


@dataclass(frozen=True, kw_only=True)
class SubspaceMinimization(Settings):
    """Subspace minimization after projected Gauss-Seidel sweeps.

    It does sweeps, then solves A_FF x_F = -(b_F + A_FH x_H) for the unknowns off their bounds, and
    projects ([Book] 2.2.5, algorithm 7, eq. 2.95).

    A step consists of `sweeps` projected Gauss-Seidel sweeps and up to `solves` such solves, until
    the free set stays ([Book] eq. 2.98). Each solve is inexact: it is as accurate as the whole
    solve still needs. Its projected correction is halved until the energy x'A x / 2 + b'x or the
    residual falls, up to `backtracks` times; if neither falls, x is left as after the sweeps. The
    book takes full steps, whose "jaggyness" (fig. 2.10) this avoids; `backtracks = -1` takes full
    steps as the book does.

    Bounds may be affine in x: they are constants of each linear solve. Held unknowns then move with
    their bounds, and only the residual judges the step, as there is no energy. With friction the
    residual may have to rise first: `backtracks = -1` solves a stack of 10 boxes to 1e-13 in 13
    steps, where 200 safeguarded steps end at 5e-4 (`benchmarks.contacts`), but it diverges in the
    time steps of a brick wall.

    `linear_iterations` counts sweeps and preconditioned iterations.

    Args:
        sweeps: of each step, >= 1.
        solves: on the free set, of each step, at most; >= 1.
        omega: relaxation factor of the sweeps, in (0, 2).
        eta: each linear solve reduces its residual by this factor, or to the accuracy that the
            whole solve still needs.
        max_linear_iterations: maximum number of iterations of one linear solve.
        backtracks: halvings of a correction; -1 takes each correction in full.
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate
            rounded to float32 as well.
        cycle: settings of multigrid cycles.
    """

    supports: ClassVar = (HasSweep, HasRows)
    needs: ClassVar[str] = (
        "as for ProjectedSOR; regular principal blocks (dense: least squares otherwise)"
    )
    preconditioned: ClassVar[bool] = True
    affine_bounds: ClassVar[bool] = True

    sweeps: Count = 5
    solves: Count = 2
    omega: Relaxation = 1.0
    eta: Share = 0.1
    max_linear_iterations: Count = 200
    backtracks: Annotated[int, Ge(-1)] = 5
    precision: PrecisionName = "mixed"
    cycle: CycleSettings = field(default_factory=CycleSettings)

    def init(self, problem: LCP) -> SubspaceWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A cannot be swept, or its principal systems cannot be solved.
        """
        check_taken(self, problem.A)
        work = SubspaceWorkspace(problem, self)
        work.diagonal.check()
        return work

    def step(self, problem: LCP, work: SubspaceWorkspace, x: DeviceArray) -> Step:
        """Sweep, then minimize on the free set until it stays."""
        for _ in range(self.sweeps):
            check_time()
            work.sweep.run(x, forward=True)
        work.round_iterate()
        iterations, active = self.sweeps, 0
        for solve in range(self.solves):
            moved, active = work.classify(x)
            if solve > 0 and not moved:
                break
            iterations += work.minimize(x)
        return Step("subspace", iterations, active, work.contraction.test(x))


class SubspaceWorkspace(SweepWorkspace):
    """Workspace of the method for one problem."""

    def __init__(self, problem: LCP, settings: SubspaceMinimization) -> None:
        super().__init__(problem, settings.precision)
        self.settings, layout = settings, problem.layout
        self.sweep = sweep_for(problem, self.diagonal, settings.omega)
        self.system = principal_system(
            problem, self.precision.correction, bounded=False, settings=settings.cycle
        )
        self.free, self._before = layout.zeros(wp.uint8), layout.zeros(wp.float64)
        affine = problem.bounds.affine is not None
        self._old_bounds = [layout.zeros(wp.float64) for _ in range(2)] if affine else []
        self._sums = RowReduction(rows_of(self.x), 2)
        self._stale, self._target = True, 0.0

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the free set; the operator may have changed."""
        super().start(warm=warm, tolerance=tolerance)
        self.floating = floating
        self._stale, self._target = True, tolerance
        self.system.refresh()

    def classify(self, x: DeviceArray) -> tuple[int, int]:
        """Find the free set; return how many unknowns changed sides and are held.

        An unknown is free where l < x < u ([Book] eq. 2.92).
        """
        p = self.problem
        p.bounds.follow(x)
        found = self._sums.of(
            BETWEEN, bounds=p.bounds.operands, x=x, unknown=p.unknown, free=self.free
        )
        moved, held = (int(v) for v in found)
        if moved or self._stale:
            self.system.restrict(self.free)
            self._stale = False
        return moved, held

    def minimize(self, x: DeviceArray) -> int:
        """Solve on the free set and move x along the projected correction.

        It solves A_FF e_F = -y_F / size, then x <- clip(x + size e, l, u) with the correction
        halved until the residual or the energy falls. Returns the number of linear iterations.
        """
        s, residual = self.settings, self.residual
        norm, energy = residual.evaluate(x), self._energy(x)
        size = self._right_side(1.0)
        if size == 0 or norm <= self._target:
            return 0
        self._right_side(1 / size)
        if self.floating is not None:
            self.floating.project(self.system.r, self.free)
        iterations = self.system.solve(
            max(s.eta, 0.3 * self._target / size), s.max_linear_iterations
        )[0]
        wp.copy(self._before, x)
        for halving in range(max(s.backtracks, 0) + 1):
            check_time()
            self._correct(x, size * 0.5**halving)
            if (
                s.backtracks < 0
                or residual.evaluate(x) < norm
                or self._energy(x) < energy - ROUNDING * abs(energy)
            ):
                return iterations
        wp.copy(x, self._before)
        residual.invalidate()
        return iterations

    def _correct(self, x: DeviceArray, scale: float) -> None:
        """Set x = clip(x0 + scale e, l, u) from the x0 before the correction.

        Held unknowns then follow bounds that are affine in x.
        """
        p = self.problem
        p.bounds.follow(self._before)
        projected_move(
            self._sums.rows, p.bounds.operands, self._before, self.system.e, scale, x, guarded=False
        )
        if self._old_bounds:
            for old, bound in zip(self._old_bounds, (p.lower, p.upper), strict=True):
                wp.copy(old, bound)
            p.bounds.follow(x)
            old_lower, old_upper = self._old_bounds
            FOLLOW.bind(
                self._sums.rows,
                bounds=p.bounds.operands,
                x=x,
                old_lower=old_lower,
                old_upper=old_upper,
            ).launch()
        self._finish_move(x)
        self.residual.invalidate()

    def _energy(self, x: DeviceArray) -> float:
        """Return the energy x'A x / 2 + b'x = x'(y + b) / 2, y being that of x.

        Infinite where it does not exist: A is not symmetric, or bounds are affine.
        """
        if not self.problem.A.symmetric or self._old_bounds:
            return np.inf
        for slot, other in enumerate((self.residual.y, self.problem.b)):
            self._sums.dot(x, other, slot)
        return 0.5 * float(self._sums.scalars.numpy().sum())

    def _right_side(self, scale: float) -> float:
        """Set the right-hand side to -scale y on the free set; return y's norm there."""
        return float(
            np.sqrt(
                self._sums.of(
                    ON_FREE, y=self.residual.y, free=self.free, g=self.system.r, scale=scale
                )[0]
            )
        )
