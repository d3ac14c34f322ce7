"""MPRGP: projected conjugate gradients with a preconditioner on the free set."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import zeros_like
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.multigrid.black_box_multigrid import takes_points
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.stencil_level import StencilLevel
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import (
    Precision,
    PrecisionName,
    Step,
    Workspace,
    WorkspaceBase,
)
from warp_lcp.problem.operator_protocol import HasStencil, has
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Count, CountOrZero, Positive, Settings
from warp_lcp.subproblems import grid_step_kernels as engine
from warp_lcp.subproblems.active_set_kernels import projected_move
from warp_lcp.subproblems.diagonal_system import DiagonalSystem
from warp_lcp.subproblems.energy_monitor import EnergyMonitor
from warp_lcp.subproblems.grid_system import projected_cycle
from warp_lcp.subproblems.principal_system import principal_system
from warp_lcp.subproblems.sparse_system import SparseSystem
from warp_lcp.sweeps.sweep import Diagonal

KERNELS = KernelFile(Path(__file__).parent / "headers/gradient_projection.h")
SPLIT = KERNELS["mprgp.split"]
SPLIT_KNOWN = KERNELS["mprgp.split_known"]
RELEASE = KERNELS["mprgp.release"]
GAIN = KERNELS["mprgp.gain"]
SINGLE_SLACK = 1.2e-7  # relative distance within which a bound counts as met in float32
ENERGY_ROUNDING = 1e-12  # relative rises of the energy up to this are rounding
# Relative fall of the energy below which rounding of its sum may pretend a fall over as many steps
# as the patience.
NOISE = 1e-14


@dataclass(frozen=True, kw_only=True)
class MPRGP(Settings):
    """Modified proportioning with reduced gradient projections, preconditioned.

    It minimizes 1/2 x'Ax + b'x within the bounds (Dostal; Takahashi and Batty 2023).

    Unknowns at a bound are held. The chopped gradient is the part of the residual on them. While it
    is small compared with the free part (||beta||^2 <= Gamma^2 phi~'phi), a step is one of
    conjugate gradients on the free set, preconditioned there by one multigrid cycle, and then
    projected: x = clip(x - alpha p). If the projection meets no bound, the direction is kept for
    the next step; otherwise the preconditioner is rebuilt for the new set and the direction is
    reset. When the chopped gradient is large, a step along it releases unknowns. The projected step
    replaces Dostal's expansion by a half step and a fixed step, which needed over 8 times the work
    of a linear solve; the projected step needs 1.5 times. After a cold start on a grid, the first
    steps are projected multigrid cycles.

    On grids a projected cycle follows a step that its projection has made worse, and also
    `patience` steps without a new least energy, as in `ProjectedMultigrid`; elsewhere a projected
    step that raises the energy is halved. While steps lower the energy, the patience of the
    stopping criteria does not run out. `linear_iterations` counts monotone cycles and products with
    A: one for each step, two if the step releases unknowns.

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate
            rounded to float32 as well. Dense and user-made operators take float64 corrections.
        monotone_cycles: projected cycles of a cold start on a grid.
        gamma: Gamma > 0, how large the chopped gradient may be; larger: bounds are left later.
        patience: steps without a new least energy before monotone cycles are taken on a grid.
        cycle: settings of multigrid cycles.
    """

    needs: ClassVar[str] = "A symmetric, positive semi-definite"

    precision: PrecisionName = "mixed"
    monotone_cycles: CountOrZero = 1  # on splashes of 64^3 and 128^3 two save no time
    gamma: Positive = 1.0
    patience: Count = 3
    cycle: CycleSettings = field(default_factory=CycleSettings)

    def init(self, problem: LCP) -> MPRGPWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is not symmetric, or has a negative diagonal entry.
        """
        return self._checked(problem, None)

    def init_after(self, problem: LCP, before: Workspace) -> MPRGPWorkspace:
        """Return a workspace with the preconditioner of the method before.

        Only a sparse matrix's is reused. Raises as `init`.
        """
        system = before.system if isinstance(before, HasSystem) else None
        return self._checked(problem, system if isinstance(system, SparseSystem) else None)

    def _checked(self, problem: LCP, system: SparseSystem | None) -> MPRGPWorkspace:
        """Return a workspace if A is symmetric without negative diagonal entries."""
        if not problem.A.symmetric:
            raise ValueError(
                "A is not symmetric: MPRGP minimizes an energy that exists only for a symmetric A; "
                "use MinimumMapNewton or Lemke"
            )
        work = MPRGPWorkspace(problem, self, system)
        negative = np.count_nonzero(Diagonal(problem, work.residual).values() < 0)
        if negative:
            raise ValueError(
                f"A has {negative} negative diagonal entries: MPRGP needs a positive semi-definite "
                "A"
            )
        return work

    def step(self, problem: LCP, work: MPRGPWorkspace, x: DeviceArray) -> Step:
        """Take a monotone cycle or a projected conjugate-gradient step.

        Cycles come first, while the start is cold. A proportioning step precedes the gradient step
        if the chopped gradient is large: ||beta||^2 > gamma^2 phi~'phi.
        """
        if work.wants_monotone_cycle():
            return work.monotone_step(x)
        active = work.residual.active
        release = work.residual.chopped > self.gamma**2 * work.residual.reduced
        if (release and not work.proportion()) or not work.conjugate():
            return Step("unbounded", 1, active, SolveStatus.DIVERGED)
        return Step(
            "proportioning" if release else "conjugate gradient",
            2 if release else 1,
            active,
            interim=work.sinks(),
        )


class SplitResidual(NaturalResidual):
    """Natural residual with the data that choose the next step.

    The norms of its parts, the free set, the right-hand side there, and the chopped step.

    Args:
        problem: the problem.
        r: stored field, receives the right-hand side -y / size on the free set.
        chopped_step: stored field like r, receives -residual / (A_ii size) on the held unknowns.
        slack: an unknown within this relative distance of a bound is at it.

    Attributes:
        free: stored uint8 field, 1 where an unknown is off its bounds.
        size: see `r`.
        free_set: version of the free set: it grows when the set changes.
        chopped: squared norm of the residual on the held unknowns.
        reduced: product of the residual and y on the free ones.
        release: product of -y / size and the chopped step.
        active: number of held unknowns.
        energy: 1/2 x'Ax + b'x.
    """

    def __init__(
        self, problem: LCP, r: DeviceArray, chopped_step: DeviceArray, *, slack: float
    ) -> None:
        super().__init__(problem)
        self.free, self._r, self._chopped_step, self._slack = (
            problem.layout.zeros(wp.uint8),
            r,
            chopped_step,
            slack,
        )
        self.rows = Rows.flat(problem.layout.size, problem.device)
        (
            self.size,
            self.free_set,
            self.chopped,
            self.reduced,
            self.release,
            self.active,
            self.energy,
        ) = 1.0, 1, 0.0, 0.0, 0.0, 0, 0.0
        self._norm_of_b = 0.0
        self._stencil = problem.A.stencil if has(problem.A, HasStencil) else None
        self.sums = RowReduction(self.rows, 2, slots=engine.SLOTS)
        self._split = RowReduction(
            self._stencil.rows if self._stencil else self.rows, len(SPLIT.sums)
        )

    def start(self, x: DeviceArray, *, keep: bool) -> None:
        """Set x to clip(x, l, u) or clip(0, l, u)."""
        super().start(x, keep=keep)
        if not keep:
            self._norm_of_b = super().norm_of_b()
            self.size, self.norm = self._norm_of_b or 1.0, 0.0

    def norm_of_b(self) -> float:
        """Return ||b|| over the unknowns, as it was at the start of the solve."""
        return self._norm_of_b

    def evaluate(self, x: DeviceArray) -> float:
        """Compute the norm of the natural residual at x, and all attributes.

        One pass evaluates y = A x + b, the residual and its parts, the free set, g = -y / size on
        it and the chopped step. On grids y is not stored.
        """
        p = self.problem
        if 0 < self.norm < math.inf:
            self.size = self.norm
        kernel, stencil = (
            (SPLIT_KNOWN, self.known) if self._stencil is None else (SPLIT, self._stencil)
        )
        if self._stencil is None:
            self.affine(x)
        else:
            self._stencil.wrap(x)
        sums = self._split.of(
            kernel,
            stencil=stencil,
            bounds=p.bounds.operands,
            x=x,
            b=p.b,
            unknown=p.unknown,
            free=self.free,
            g=self._r,
            step=self._chopped_step,
            inverse=1 / self.size,
            slack=self._slack,
        )
        square, self.chopped, self.reduced, self.release, moved, active, self.energy = (
            float(v) for v in sums
        )
        self.active = int(active)
        if moved > 0:
            self.free_set += 1
        return self.mark_evaluated(float(np.sqrt(square)))

    def measure(self, finest: StencilLevel, p: DeviceArray) -> list[float]:
        """Return z'Az, z'Ap, r'z and r'p on a grid's finest level.

        The level's x is z, its b is r.
        """
        engine.measure_kernel(finest, p, self._split.partials).launch(wp.launch)
        self._split.add_up(0, columns=4)
        return [float(v) for v in self._split.scalars.numpy()[:4]]

    def dot(self, a: DeviceArray, b: DeviceArray) -> float:
        """Return a.b."""
        self.sums.dot(a, b, 0)
        return float(self.sums.scalars.numpy()[0])


@runtime_checkable
class HasSystem(Protocol):
    """A workspace with equations on the free unknowns."""

    system: object


class MPRGPWorkspace(WorkspaceBase):
    """Workspace of the method for one problem.

    Args:
        problem: the problem.
        settings: the method.
        system: a sparse matrix's principal system to share; its own if None.
    """

    residual: SplitResidual

    def __init__(self, problem: LCP, settings: MPRGP, system: SparseSystem | None = None) -> None:
        precision, self.settings = Precision(settings.precision), settings
        self.bounded, self.is_grid = problem.bounded, takes_points(problem.A)
        self.system, self.preconditioner = _preconditioner(
            problem, precision.correction, settings.cycle, system
        )
        z = self.preconditioner.z
        self._fields = [problem.layout.zeros(wp.float64) for _ in range(2 if self.is_grid else 3)]
        self._best: DeviceArray = self._fields[0]
        self._p, self._q = zeros_like(z), zeros_like(z)
        # A multigrid cycle overwrites z completely.
        self._chopped = z if self.is_grid else zeros_like(z)
        slack = SINGLE_SLACK if precision is Precision.SINGLE else 0.0
        residual = SplitResidual(problem, self.preconditioner.r, self._chopped, slack=slack)
        super().__init__(problem, precision, x=self._best, residual=residual)
        self._cycles_left, self._cycled, self._released, self._carry, self._curvature = (
            0,
            False,
            False,
            False,
            0.0,
        )
        self._energy_monitor = EnergyMonitor(self.precision.epsilon)
        self._restricted = 0  # the version of the free set that the preconditioner is restricted to

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the direction; the operator may have changed."""
        self.floating = floating
        self._cycles_left = (
            self.settings.monotone_cycles if self.is_grid and self.bounded and not warm else 0
        )
        self._cycled, self._released, self._carry, self._lowest = (
            False,
            False,
            False,
            self.residual.energy,
        )
        self._energy_monitor.start(self.residual.energy, self.residual.norm)
        self._restricted = 0
        self.system.refresh()

    @property
    def stale(self) -> bool:
        """Whether the free set has changed since the preconditioner was restricted to it."""
        return self._restricted != self.residual.free_set

    def sinks(self) -> bool:
        """Return whether the energy has fallen beyond rounding.

        Since the last time that it had; on grids, whether the step before has lowered it.
        """
        if self.is_grid:
            return self._energy_monitor.sinks
        sinks = self.residual.energy < self._lowest - NOISE * abs(self._lowest)
        self._lowest = self.residual.energy if sinks else self._lowest
        return sinks

    def wants_monotone_cycle(self) -> bool:
        """Judge the last step; return whether the next one is a projected cycle."""
        if not (self.is_grid and self.bounded):
            return False
        fell = self._energy_monitor.record(self.residual.energy, self.residual.norm)
        if self._cycled:
            self._energy_monitor.weigh(fell)
        elif self._cycles_left == 0 and self._energy_monitor.needs_cycle(
            fell, moved=self.stale or self._released
        ):
            self._cycles_left = 1
        self._cycles_left = self._cycles_left or self._energy_monitor.due(self.settings.patience)
        self._cycled, self._released = self._cycles_left > 0, False
        return self._cycled

    def monotone_step(self, x: DeviceArray) -> Step:
        """Take a projected cycle on all unknowns."""
        residual = self.residual
        self._cycles_left -= 1
        self._restricted, self._carry = 0, False
        residual.affine(x)
        projected_cycle(
            self.problem, self.system, x, residual.y, residual.size, residual.free, residual.sums
        )
        self._move(self.system.z, residual.size)
        return Step("monotone cycle", 1, None)

    def proportion(self) -> bool:
        """Step along the chopped gradient to the minimum of the energy.

        The step releases unknowns. With the direction p = -residual / A_ii on the held unknowns its
        length is -y'p / p'Ap, and on grids the right-hand side is updated by the same product A p.

        Returns:
            False: the energy is unbounded below along the direction.
        """
        residual, direction = self.residual, self._chopped
        self._carry, self._released = False, True
        self._product(direction)
        curvature = residual.dot(direction, self._q)
        if not (self.is_grid and curvature > 0):
            # The residual at the end of a step writes another chopped step, and this one may be
            # repeated.
            wp.copy(self._p, direction)
            return self._projected_step(self._p, residual.release, curvature)
        factor, target, p = residual.release / curvature, self._target(), self.problem
        stencil = p.A.stencil  # type: ignore[attr-defined]
        RELEASE.bind(
            residual.rows,
            stencil=stencil,
            bounds=p.bounds.operands,
            x=self.x,
            step=direction,
            q=self._q,
            to=target,
            free=residual.free,
            g=self.preconditioner.r,
            part=factor,
            length=factor * residual.size,
        ).launch()
        self._settle(target)
        self._restricted = 0
        return True

    def conjugate(self) -> bool:
        """Take the projected step along a preconditioned conjugate direction.

        The right-hand side is preconditioned on the free set. The direction is made conjugate to
        the last one if the set is the same.

        Returns:
            False: the energy is unbounded below along the direction.
        """
        residual, M = self.residual, self.preconditioner
        if self.stale:
            M.restrict(residual.free)
            self._restricted, self._carry = residual.free_set, False
        if self.floating is not None:
            self.floating.project(M.r, residual.free)
        M.apply()
        return self._grid_step() if self.is_grid else self._general_step()

    def _general_step(self) -> bool:
        """Take the step of any operator, with q = A p kept from step to step.

        beta = -z'q / p'q of the last direction p, then p <- z + beta p.
        """
        residual, M, beta = self.residual, self.preconditioner, 0.0
        if self._carry:
            beta = -residual.dot(M.z, self._q) / self._curvature
        bounds, beta = self.problem.bounds.operands, beta if math.isfinite(beta) else 0.0
        projected_move(residual.rows, bounds, None, self._p, 0.0, None, z=M.z, beta=beta)
        self._product(self._p)
        gain, curvature = (
            float(v) for v in residual.sums.of(GAIN, along=self._p, q=self._q, g=M.r)
        )
        self._carry, self._curvature = curvature > 0, curvature
        return self._projected_step(self._p, gain, curvature)

    def _grid_step(self) -> bool:
        """Take the step of a grid in two passes.

        The first sums the products of z and p, the second computes p and moves x.
        """
        residual, finest = self.residual, self.system.hierarchy.finest
        finest.stencil.wrap(finest.x)
        zaz, zap, gz, gp = residual.measure(finest, self._p)
        beta, curvature, gain = 0.0, zaz, gz
        if self._carry:
            beta, curvature, gain = engine.conjugate.func(
                zaz, zap, gz, gp, self._curvature, engine.LEAST_REST.value
            )
        if not curvature > 0:
            wp.copy(self._p, finest.x)
            self._carry = False
            return self._projected_step(self._p, gz, zaz)
        self._carry, self._curvature = True, curvature
        target, bounds, length = (
            self._target(),
            self.problem.bounds.operands,
            gain / curvature * residual.size,
        )
        projected_move(
            residual.rows, bounds, self.x, self._p, length, target, z=finest.x, beta=beta
        )
        self._settle(target)
        return True

    def _projected_step(self, direction: DeviceArray, gain: float, curvature: float) -> bool:
        """Move x to the energy's minimum along a direction p, projected.

        x <- clip(x + t p, l, u) with t = gain / curvature: the energy's decrease per length of p,
        and p'A p. The step is halved where the projection raises the energy x'A x / 2 + b'x.
        """
        residual = self.residual
        if curvature > 0:
            length = gain / curvature * residual.size
        else:  # the energy is unbounded below: move to the first bound
            length = self._first_bound(direction) if gain > 0 else 0.0
            if not math.isfinite(length):
                return False
        energy = residual.energy
        origin = self._move(direction, length)
        for _ in range(0 if self.is_grid else 30):
            check_time()
            residual.evaluate(self.x)
            if not self.stale or residual.energy <= energy + ENERGY_ROUNDING * abs(energy):
                break
            length *= 0.5
            self._advance(origin, direction, length, self.x)
        return True

    def _move(self, direction: DeviceArray, length: float) -> DeviceArray:
        """Step along a direction; return the memory of the x before."""
        origin = self.x
        self._advance(origin, direction, length, self._target())
        return origin

    def _target(self) -> DeviceArray:
        """Return memory for the next x, other than the best iterate's.

        It is not x's own either where a step may be repeated.
        """
        if self.is_grid and self.x is not self._best:
            return self.x
        return next(f for f in self._fields if f is not self._best and f is not self.x)

    def _advance(
        self, origin: DeviceArray, direction: DeviceArray, length: float, target: DeviceArray
    ) -> None:
        """Compute x = clip(origin + length direction, l, u)."""
        projected_move(
            self.residual.rows, self.problem.bounds.operands, origin, direction, length, target
        )
        self._settle(target)

    def _settle(self, target: DeviceArray) -> None:
        """Make the result of a step the current x."""
        self.x = target
        self._finish_move(self.x)
        self.residual.invalidate()

    def keep(self) -> None:
        """Store x as the best iterate: the next step is written to other memory."""
        self._best = self.x

    def restore(self) -> None:
        """Set x to the best iterate."""
        self.x = self._best

    def _first_bound(self, direction: DeviceArray) -> float:
        """Return the distance to the first bound along a direction; inf without one.

        Computed on the host. Semi-definite matrices need it occasionally.
        """
        p, at = direction.numpy().astype(np.float64), self.x.numpy()
        lower, upper = self.problem.lower.numpy(), self.problem.upper.numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            gaps = np.where(p > 0, (upper - at) / p, np.where(p < 0, (lower - at) / p, np.inf))
        return float(gaps.min())

    def _product(self, direction: DeviceArray) -> None:
        """Compute q = A times a direction."""
        A, shape = self.problem.A, self.problem.layout.stored_shape
        if self.is_grid:
            A.stencil.product(direction, self._q)  # type: ignore[attr-defined]
        else:
            A.apply(direction.reshape(shape), self._q.reshape(shape))


def _preconditioner(
    problem: LCP, real: DataType, cycle: CycleSettings, system: Any
) -> tuple[Any, Any]:
    """Return the principal system and its preconditioner."""
    # A dense matrix's own system is solved directly, which would be an active-set method.
    if system is None and isinstance(problem.A, DenseOperator):
        system = DiagonalSystem(problem)
    elif system is None and isinstance(problem.A, SparseOperator):
        # Narrow matrices too, for the same reason.
        system = SparseSystem(problem.A, real)
    elif system is None:
        system = principal_system(problem, real, bounded=problem.bounded, settings=cycle)
    return system, system.preconditioner if isinstance(system, SparseSystem) else system
