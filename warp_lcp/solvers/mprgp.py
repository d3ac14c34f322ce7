"""MPRGP with a preconditioner on the free set: conjugate gradients that know the bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import CycleSettings
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.grid_poisson import GridPoisson
from warp_lcp.problem import LCP
from warp_lcp.residual import NaturalResidual
from warp_lcp.result import SolveStatus
from warp_lcp.solve import IterateInPlace, Precision, Step
from warp_lcp.solvers import mprgp_kernels as kernels
from warp_lcp.solvers.minimum_map_newton_kernels import all_free_kernel
from warp_lcp.solvers.principal_system import DiagonalSystem, principal_system
from warp_lcp.solvers.principal_system_sparse import SparseSystem
from warp_lcp.vectors import Reduction, convert, launch_spans

SINGLE_SLACK = 1.2e-7  # a bound that float32 rounds is met within this part of it
ENERGY_ROUNDING = 1e-12  # rises of the energy within this part of it are rounding


@dataclass(frozen=True, kw_only=True)
class MPRGP:
    """Minimize 1/2 x'Ax + b'x on the bounds by projected, preconditioned conjugate gradients (Dostal; Takahashi and Batty 2023).

    Unknowns at a bound are held. While the part of the residual on them, the chopped gradient, is small against the free part
    (||beta||^2 <= Gamma^2 phi~'phi), a step of conjugate gradients on the free set, preconditioned there by one multigrid cycle, is
    projected: x = clip(x - alpha p). If that meets no bound it was plain conjugate gradients and the direction is carried on; else the
    preconditioner is rebuilt for the new set and the direction starts anew. When the chopped gradient is large, a step along it releases
    unknowns. Dostal's expansion by a half step and a fixed step is replaced by the projected step: it needed over 8 times the work of a
    linear solve, this one 1.5. Cold, the first steps on a grid are projected multigrid cycles.

    On grids the residual may rise `patience` times running, then a projected cycle follows; elsewhere a projected step that raises the
    energy is halved. `linear_iterations` counts products with A and monotone cycles.

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate rounded to float32 as well. Dense
            and user-made operators take float64 corrections.
        monotone_cycles: projected cycles of a cold start on a grid.
        gamma: Gamma > 0, how large the chopped gradient may be; larger: bounds are left later.
        patience: rises of the residual before a monotone cycle is taken on a grid.
        cycle: how multigrid cycles go.

    Raises:
        ValueError: an argument is outside its range.
    """

    supports: ClassVar[frozenset[str]] = frozenset({"dense", "sparse", "grid"})
    needs: ClassVar[str] = "A symmetric, positive semi-definite"

    precision: str = "mixed"
    monotone_cycles: int = 2
    gamma: float = 1.0
    patience: int = 3
    cycle: CycleSettings = field(default_factory=CycleSettings)

    def __post_init__(self) -> None:
        """Check the settings."""
        Precision(self.precision)
        if not (self.gamma > 0 and math.isfinite(self.gamma)):
            raise ValueError(f"gamma = {self.gamma}: must be finite and > 0")
        for name, least in (("monotone_cycles", 0), ("patience", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} = {getattr(self, name)}: must be >= {least}")

    def init(self, problem: LCP) -> GradientWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is not symmetric, or has a negative diagonal entry.
        """
        if not problem.A.symmetric:
            raise ValueError("A is not symmetric: MPRGP minimizes an energy that only a symmetric A has; take MinimumMapNewton or Lemke")
        work = GradientWorkspace(problem, self)
        negative = np.count_nonzero(work.residual.diagonal.numpy().astype(np.float64) * work.residual.unit < 0)
        if negative:
            raise ValueError(f"A has {negative} negative diagonal entries: MPRGP needs a positive semi-definite A")
        return work

    def step(self, problem: LCP, work: GradientWorkspace, x: wp.array[Any]) -> Step:
        """Take a monotone cycle while the start is cold, a proportioning step, or a projected conjugate-gradient step."""
        if work.wants_monotone_cycle():
            return work.monotone_step(x)
        if work.residual.chopped > self.gamma**2 * work.residual.reduced:
            return work.proportioning_step(x)
        return work.conjugate_step(x)


class Preconditioner(Protocol):
    """An approximate inverse of A on a free set: reads r, writes z."""

    r: wp.array[Any]
    z: wp.array[Any]

    def restrict(self, free: wp.array[Any]) -> None:
        """Take another free set."""

    def apply(self) -> None:
        """Write z."""


class SplitResidual(NaturalResidual):
    """The natural residual, with what decides on the next step: its parts, the free set, the right-hand side there.

    Attributes:
        free: stored uint8 field, 1 where an unknown is off its bounds.
        size: the right-hand side is -y / size on the free set.
        moved: whether the free set has changed since this was last set to False.
        chopped: squared norm of the residual on the held unknowns.
        reduced: product of the residual and y on the free ones.
        active: number of held unknowns.
        energy: 1/2 x'Ax + b'x, where it is wanted.
    """

    def __init__(self, problem: LCP, r: wp.array[Any], *, slack: float, with_energy: bool) -> None:
        super().__init__(problem)
        device = problem.device
        self.free, self._r, self._slack = problem.layout.zeros(wp.uint8), r, slack
        self._b = problem.b if with_energy else wp.empty(0, dtype=wp.float64, device=device)
        self.scalars = wp.zeros(kernels.SLOTS, dtype=wp.float64, device=device)
        self.sums = Reduction(problem.layout.size, device, self.scalars, columns=kernels.COLUMNS)
        self.kernels = kernels.kernels(self.diagonal.dtype, r.dtype)
        self.size, self.moved, self.chopped, self.reduced, self.active, self.energy = 1.0, True, 0.0, 0.0, 0, 0.0

    def start(self, x: wp.array[Any], *, keep: bool) -> None:
        """Set x to clip(x, l, u) or clip(0, l, u)."""
        super().start(x, keep=keep)
        if not keep:
            self.size = self.norm_of_b() or 1.0

    def evaluate(self, x: wp.array[Any]) -> float:
        """Compute y, the norm of the natural residual, the free set and the right-hand side at x."""
        p, sums = self.problem, self.sums
        if 0 < self.norm < math.inf:
            self.size = self.norm
        self.affine(x)
        before = [*self.at(x), self._b, self.free, self._r, wp.float64(1 / self.size), wp.float64(self._slack)]
        launch_spans(self.kernels.split, sums.spans, before, [sums.threads, sums.partials], p.device)
        sums.add_up(kernels.SQUARE, columns=kernels.COLUMNS)
        square, self.chopped, self.reduced, moved, active, self.energy = (float(v) for v in self.scalars.numpy()[: kernels.COLUMNS])
        self.norm, self.current, self.active, self.moved = float(np.sqrt(square)), True, int(active), self.moved or moved > 0
        return self.norm

    def chop(self, x: wp.array[Any], direction: wp.array[Any]) -> None:
        """Write the step along the chopped gradient, and its product with -y / size."""
        inputs = [*self.at(x), direction, wp.float64(1 / self.size), wp.float64(self._slack)]
        launch_spans(self.kernels.chop, self.sums.spans, inputs, [self.sums.partials], self.problem.device)
        self.sums.add_up(kernels.GAIN)

    def at(self, x: wp.array[Any]) -> list[Any]:
        """Return what kernels need to evaluate the residual's entries at x."""
        p = self.problem
        return [x, self.y, self.diagonal, wp.float64(self.unit), *p.bounds.operands, p.unknown]


class GradientWorkspace(IterateInPlace):
    """Memory of the method for one problem."""

    def __init__(self, problem: LCP, settings: MPRGP) -> None:
        self.problem, self.settings, self.precision = problem, settings, Precision(settings.precision)
        self.bounded, self.is_grid = problem.bounded, isinstance(problem.A, GridPoisson)
        self.system, self.preconditioner = _preconditioner(problem, self.precision.correction, settings.cycle)
        z, single = self.preconditioner.z, self.precision is Precision.SINGLE
        self.x = problem.layout.zeros(wp.float64)
        self._p, self._q = wp.zeros_like(z), wp.zeros_like(z)
        self._rounded = problem.layout.zeros(wp.float32) if single else None
        self.residual = SplitResidual(
            problem, self.preconditioner.r, slack=SINGLE_SLACK if single else 0.0, with_energy=not self.is_grid and self.bounded
        )
        self._trial = None if self.is_grid else problem.layout.zeros(wp.float64)
        self.floating: Any = None
        self._cycles_left, self._rises, self._carry, self._curvature = 0, 0, False, 0.0

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Forget the direction; the operator may have changed."""
        self._cycles_left = self.settings.monotone_cycles if self.is_grid and self.bounded and not warm else 0
        self._rises, self._carry, self._last = 0, False, math.inf
        self.residual.moved = True
        self.system.refresh()
        if self.floating is not None:
            self._project()

    def wants_monotone_cycle(self) -> bool:
        """Return whether the next step is a projected cycle."""
        norm = self.residual.norm
        self._rises = self._rises + 1 if norm > self._last else 0
        self._last = norm
        if self._rises >= self.settings.patience and self.is_grid and self.bounded:
            self._rises, self._cycles_left = 0, 1
        return self._cycles_left > 0

    def monotone_step(self, x: wp.array[Any]) -> Step:
        """Projected cycle on all unknowns."""
        p, system, residual = self.problem, self.system, self.residual
        self._cycles_left -= 1
        self._flat(all_free_kernel, [p.unknown, residual.free])
        system.restrict(residual.free)
        residual.moved, self._carry = True, False
        finest = system.hierarchy.finest
        self._flat(residual.kernels.gaps, [*self._at(x), finest.lower, finest.upper, system.r, wp.float64(1 / residual.size)])
        system.monotone_cycle()
        self._move(x, system.z, residual.size, x)
        return Step("monotone cycle", 1, None)

    def proportioning_step(self, x: wp.array[Any]) -> Step:
        """Step along the chopped gradient as far as the energy falls: it releases unknowns from their bounds."""
        residual, active = self.residual, self.residual.active
        self._carry = False
        residual.chop(x, self._p)
        gain = float(residual.scalars.numpy()[kernels.GAIN])
        self._product()
        residual.sums.dot(self._p, self._q, kernels.CURVATURE)
        curvature = float(residual.scalars.numpy()[kernels.CURVATURE])
        return self._projected_step(x, "proportioning", gain, curvature, active)

    def conjugate_step(self, x: wp.array[Any]) -> Step:
        """Precondition on the free set, make the direction conjugate to the last one if the set is the same, take the projected step."""
        residual, M, active = self.residual, self.preconditioner, self.residual.active
        if residual.moved:
            M.restrict(residual.free)
            residual.moved, self._carry = False, False
        if self.floating is not None:
            self._project()
        M.apply()
        beta = 0.0
        if self._carry:
            residual.sums.dot(M.z, self._q, kernels.OVERLAP)
            beta = -float(residual.scalars.numpy()[kernels.OVERLAP]) / self._curvature
        self._flat(residual.kernels.direct, [M.z, self._p, M.z.dtype(beta if math.isfinite(beta) else 0.0)])
        self._product()
        sums = residual.sums
        after = [sums.threads, sums.partials]
        launch_spans(residual.kernels.measure, sums.spans, [self._p, self._q, M.r], after, self.problem.device)
        sums.add_up(kernels.GAIN, columns=2)
        gain, curvature = (float(v) for v in residual.scalars.numpy()[kernels.GAIN : kernels.GAIN + 2])
        self._carry, self._curvature = curvature > 0, curvature
        return self._projected_step(x, "conjugate gradient", gain, curvature, active)

    def _projected_step(self, x: wp.array[Any], name: str, gain: float, curvature: float, active: int) -> Step:
        """Move x along p to the minimum of the energy, projected; shorter where the projection makes the energy rise."""
        residual, size = self.residual, self.residual.size
        if curvature > 0:
            length = gain / curvature * size
        else:  # the energy falls without end: to the farthest bound
            length = self._farthest(x) if gain > 0 else 0.0
            if not math.isfinite(length):
                return Step(name, 1, active, SolveStatus.DIVERGED)
        if self._trial is None:
            self._move(x, self._p, length, x)
            return Step(name, 1, active)
        wp.copy(self._trial, x)
        energy = residual.energy
        for _ in range(30):
            self._move(self._trial, self._p, length, x)
            residual.evaluate(x)
            if not residual.moved or residual.energy <= energy + ENERGY_ROUNDING * abs(energy):
                break
            length *= 0.5
        return Step(name, 1, active)

    def _move(self, source: wp.array[Any], direction: wp.array[Any], length: float, x: wp.array[Any]) -> None:
        p = self.problem
        self._flat(self.residual.kernels.advance, [source, direction, *p.bounds.operands, x, wp.float64(length)])
        if self.floating is not None:
            self.floating.settle(x, p.lower, p.upper)
        self._round(x)
        self.residual.current = False

    def _farthest(self, x: wp.array[Any]) -> float:
        """Return how far the first bound is along p, on the host; inf if there is none. Semi-definite matrices ask for it now and then."""
        p, at = self._p.numpy().astype(np.float64), x.numpy()
        lower, upper = self.problem.lower.numpy(), self.problem.upper.numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            gaps = np.where(p > 0, (upper - at) / p, np.where(p < 0, (lower - at) / p, np.inf))
        return float(gaps.min())

    def _product(self) -> None:
        """Q = A p."""
        A, shape = self.problem.A, self.problem.layout.stored_shape
        if isinstance(A, GridPoisson):
            A.stencil.product(self._p, self._q)
        else:
            A.apply(self._p.reshape(shape), self._q.reshape(shape))

    def _project(self) -> None:
        """Keep the right-hand side compatible on singular components."""
        self.floating.project(self.preconditioner.r, self.residual.free)

    def _at(self, x: wp.array[Any]) -> list[Any]:
        p = self.problem
        return [x, self.residual.y, *p.bounds.operands, p.unknown]

    def _flat(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        launch_spans(kernel, self.residual.sums.spans, inputs, [], self.problem.device)

    def round_iterate(self) -> None:
        """Round x to its precision."""
        self._round(self.x)

    def _round(self, x: wp.array[Any]) -> None:
        if self._rounded is not None:
            convert(x, self._rounded)
            convert(self._rounded, x)


def _preconditioner(problem: LCP, real: Any, cycle: CycleSettings) -> tuple[Any, Any]:
    """Return the principal system and what preconditions it."""
    if isinstance(problem.A, DenseOperator):  # its own system is solved directly: then this would be an active-set method
        system: Any = DiagonalSystem(problem)
    else:
        system = principal_system(problem, real, bounded=problem.bounded, settings=cycle)
    return system, system.preconditioner if isinstance(system, SparseSystem) else system

