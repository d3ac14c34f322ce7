"""Newton's method on the minimum map: an active set, a linear solve on the free unknowns, a safeguard."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import CycleSettings
from warp_lcp.problem import LCP
from warp_lcp.residual import NaturalResidual
from warp_lcp.result import SolveStatus
from warp_lcp.solve import IterateInPlace, Precision, Step
from warp_lcp.solvers.minimum_map_newton_kernels import all_free_kernel, kernels
from warp_lcp.solvers.principal_system import GridSystem, principal_system
from warp_lcp.vectors import Reduction, convert, launch_spans

MOVED, ACTIVE, FREE_NORM = range(3)  # slots of the device scalars; ACTIVE follows MOVED


@dataclass(frozen=True, kw_only=True)
class MinimumMapNewton:
    """Solve on the unknowns that the minimum map calls free, hold the others at their bounds ([Book] 2.4.1, Schur-reduced).

    Unknown i is held where x_i - y_i / A_ii is outside [l_i, u_i]. Cold, the first steps on a grid are projected multigrid cycles, which
    find the active set to within a few cells; a Newton step alone moves its boundary by about a layer a step. Each Newton correction is
    solved inexactly in the corrections' precision, and the step is shortened along its projection onto the bounds if the residual would
    exceed the largest of the last `memory` ones. Converges on a grid in a few steps; on dense matrices A should be a P-matrix.

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate rounded to float32 as well.
        monotone_cycles: projected cycles of a cold start on a grid.
        eta: each linear solve reduces its residual by this factor, or to what the whole solve still needs.
        max_linear_iterations: the most conjugate-gradient iterations of one step.
        backtracks: halvings of a step before it is given up.
        memory: residuals that a step may fall back to.
        cycle: how multigrid cycles go.

    Raises:
        ValueError: an argument is outside its range.
    """

    supports: ClassVar[frozenset[str]] = frozenset({"dense", "sparse", "grid"})
    needs: ClassVar[str] = "positive definite or P-matrix"

    precision: str = "mixed"
    monotone_cycles: int = 2
    eta: float = 0.2
    max_linear_iterations: int = 200
    backtracks: int = 6
    memory: int = 4
    cycle: CycleSettings = field(default_factory=CycleSettings)

    def __post_init__(self) -> None:
        """Check the settings."""
        Precision(self.precision)
        if not 0 < self.eta < 1:
            raise ValueError(f"eta = {self.eta}: must be in (0, 1)")
        for name, least in (("monotone_cycles", 0), ("max_linear_iterations", 1), ("backtracks", 0), ("memory", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} = {getattr(self, name)}: must be >= {least}")

    def init(self, problem: LCP) -> NewtonWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is neither a grid operator, dense nor symmetric.
        """
        return NewtonWorkspace(problem, self)

    def step(self, problem: LCP, work: NewtonWorkspace, x: wp.array[Any]) -> Step:
        """Take a monotone cycle while the start is cold, else a safeguarded Newton step."""
        if work.cycles_left > 0:
            work.cycles_left -= 1
            return work.monotone_cycle(x)
        return work.newton_step(x)


class NewtonWorkspace(IterateInPlace):
    """Memory of the method for one problem."""

    def __init__(self, problem: LCP, settings: MinimumMapNewton) -> None:
        self.problem, self.settings, self.precision = problem, settings, Precision(settings.precision)
        layout = problem.layout
        self.bounded = problem.bounded
        self.x, self.trial = layout.zeros(wp.float64), layout.zeros(wp.float64)
        self.residual = NaturalResidual(problem)
        self.system = principal_system(problem, self.precision.correction, bounded=self.bounded, settings=settings.cycle)
        self.free = layout.zeros(wp.uint8)
        self._scalars = wp.zeros(3, dtype=wp.float64, device=problem.device)
        self._reduction = Reduction(layout.size, problem.device, self._scalars, columns=2)
        self._kernels = kernels(self.residual.diagonal.dtype, self.system.r.dtype)
        self._rounded = layout.zeros(wp.float32) if self.precision is Precision.SINGLE else None
        self.floating: Any = None
        self.start(warm=False, tolerance=0.0)

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Forget the active set; the operator may have changed."""
        cold_grid = isinstance(self.system, GridSystem) and self.bounded and not warm
        self.cycles_left = self.settings.monotone_cycles if cold_grid else 0
        self.free.zero_()
        self.stale = True
        self.norms: list[float] = []
        self.target = tolerance
        self.system.refresh()

    def monotone_cycle(self, x: wp.array[Any]) -> Step:
        """Projected cycle on all unknowns from x."""
        p, system = self.problem, self.system
        assert isinstance(system, GridSystem)
        self._flat(all_free_kernel, [p.unknown, self.free])
        if self.stale:
            system.restrict(self.free)
        self.stale = True  # the next Newton step takes cells out again
        size = self.residual.norm
        self._flat(self._kernels.right_side, [self.residual.y, self.free, 1 / size, system.r])
        finest = system.hierarchy.finest
        self._flat(self._kernels.gaps, [x, p.lower, p.upper, p.unknown, 1 / size, finest.lower, finest.upper])
        system.monotone_cycle()
        self._flat(self._kernels.correct, [x, system.z, p.lower, p.upper, size, x])
        self._round(x)
        if self.cycles_left > 0:
            self.stale = False
        return Step("monotone cycle", 1, None)

    def newton_step(self, x: wp.array[Any]) -> Step:
        """Classify, solve on the free set, move along the projected step."""
        p, residual = self.problem, self.residual
        self.norms = [*self.norms, residual.norm][-self.settings.memory :]
        before = [x, residual.y, residual.diagonal, residual.unit, p.lower, p.upper, p.unknown, self.free]
        reduction = self._reduction
        launch_spans(self._kernels.classify, reduction.spans, before, [reduction.threads, reduction.partials], p.device)
        reduction.add_up(MOVED, columns=2)
        moved, active = (int(v) for v in self._scalars.numpy()[:2])
        residual.affine(x)  # the held unknowns have moved to their bounds
        if moved or self.stale:
            self.system.restrict(self.free)
            self.stale = False
        size = self._free_norm()
        if size == 0:
            return Step("newton", 0, active)
        iterations = self._solve(size)
        return self._move(x, size, iterations, active)

    def _solve(self, size: float) -> int:
        """Solve for the correction; returns linear iterations."""
        s = self.settings
        self._flat(self._kernels.right_side, [self.residual.y, self.free, 1 / size, self.system.r])
        if self.floating is not None:
            self.floating.project(self.system.r, self.free)
        target = 0.3 * self.target / size
        return self.system.solve(max(s.eta, target), s.max_linear_iterations)[0]

    def _move(self, x: wp.array[Any], size: float, iterations: int, active: int) -> Step:
        """Accept the longest of the halved, projected steps that the safeguard allows."""
        p, residual, s = self.problem, self.residual, self.settings
        wp.copy(self.trial, x)
        limit, scale, best, best_scale = max(self.norms), 1.0, math.inf, 1.0
        for _ in range(s.backtracks + 1):
            self._flat(self._kernels.correct, [self.trial, self.system.e, p.lower, p.upper, scale * size, x])
            if self.floating is not None:
                self.floating.settle(x, p.lower, p.upper)
            self._round(x)
            norm = residual.evaluate(x)
            if norm <= (1 - 1e-4 * scale) * limit:
                return Step("newton", iterations, active)
            if norm < best:
                best, best_scale = norm, scale
            scale *= 0.5
        self._flat(self._kernels.correct, [self.trial, self.system.e, p.lower, p.upper, best_scale * size, x])
        self._round(x)
        if isinstance(self.system, GridSystem) and self.bounded:
            residual.evaluate(x)
            self.stale = True
            residual.current = False
            return Step("monotone cycle", iterations + self.monotone_cycle(x).linear_iterations, active)
        failure = SolveStatus.NON_DESCENT if best > limit else None
        residual.current = False
        return Step("newton", iterations, active, failure)

    def _free_norm(self) -> float:
        launch_spans(
            self._kernels.free_square, self._reduction.spans, [self.residual.y, self.free], [self._reduction.partials], self.problem.device
        )
        self._reduction.add_up(FREE_NORM)
        return float(np.sqrt(self._scalars.numpy()[FREE_NORM]))

    def _flat(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        launch_spans(kernel, self._reduction.spans, inputs, [], self.problem.device)

    def round_iterate(self) -> None:
        """Round x to its precision."""
        self._round(self.x)

    def _round(self, x: wp.array[Any]) -> None:
        if self._rounded is not None:
            convert(x, self._rounded)
            convert(self._rounded, x)
