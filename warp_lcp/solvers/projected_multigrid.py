"""Multigrid for grid LCPs at the price of a linear solve: monotone cycles, then truncated cycles with a carried CG direction."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import CycleSettings, Hierarchy
from warp_lcp.operators.grid_poisson import GridPoisson
from warp_lcp.problem import LCP
from warp_lcp.program import Launch, Program
from warp_lcp.residual import NaturalResidual
from warp_lcp.solve import IterateInBuffers, Precision, Step
from warp_lcp.solvers import projected_multigrid_kernels as kernels
from warp_lcp.vectors import Reduction, convert, launch_spans

# planes that a thread sums over: on CUDA, a place for the sums of every cell would cost more memory than the rest of the method
PLANES_A_THREAD = {"cpu": 1, "cuda": 16}


@dataclass(frozen=True, kw_only=True)
class ProjectedMultigrid:
    """Solve the LCP of a grid in about as many multigrid cycles as the linear system needs.

    Cold, the first steps are projected (monotone) cycles, which move whole aggregates on and off their bounds. Then each step evaluates
    y = A x + b in float64, takes the unknowns that sit at a bound with y of the right sign out of the hierarchy (they are *truncated*),
    preconditions -y by one linear cycle on the rest, makes the correction conjugate to the last direction while that set stays the same,
    and projects the step onto the bounds. There are no inner tolerances: without bounds this is preconditioned conjugate gradients with a
    true residual, and the same code is the linear solver. If the residual rises `patience` times running, a monotone cycle follows.

    Args:
        precision: "mixed": iterate float64, corrections float32; "double"; or "single": the iterate rounded to float32 as well.
        monotone_cycles: projected cycles of a cold start.
        patience: rises of the residual before a monotone cycle is taken.
        cycle: how multigrid cycles go.

    Raises:
        ValueError: an argument is outside its range.
    """

    precision: str = "mixed"
    monotone_cycles: int = 2
    patience: int = 3
    cycle: CycleSettings = field(default_factory=CycleSettings)

    def __post_init__(self) -> None:
        """Check the settings."""
        Precision(self.precision)
        for name, least in (("monotone_cycles", 0), ("patience", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} = {getattr(self, name)}: must be >= {least}")

    def init(self, problem: LCP) -> MultigridWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is not a grid operator.
        """
        if not isinstance(problem.A, GridPoisson):
            raise ValueError(f"{type(problem.A).__name__} is no grid operator: ProjectedMultigrid needs one; MinimumMapNewton takes others")
        return MultigridWorkspace(problem, problem.A, self)

    def step(self, problem: LCP, work: MultigridWorkspace, x: wp.array[Any]) -> Step:
        """Take a monotone cycle while the start is cold or the residual keeps rising, else a truncated one."""
        if work.wants_monotone_cycle():
            return work.monotone_step()
        return work.truncated_step()


class AssessedResidual(NaturalResidual):
    """The natural residual, evaluated together with the free set and the right-hand side on it.

    Attributes:
        classify: whether unknowns at a bound leave the free set.
        stale: whether the free set has changed since the hierarchy was built.
        active: unknowns held.
    """

    def __init__(self, problem: LCP, A: GridPoisson, hierarchy: Hierarchy) -> None:
        super().__init__(problem)
        self._A, self._finest, self._hierarchy, self._version = A, hierarchy.finest, hierarchy, A.version
        s = A.stencil
        planes, rows, chunks = s.threads
        slab = PLANES_A_THREAD["cuda" if A.device.is_cuda else "cpu"]
        self.threads = (-(-planes // slab), rows, chunks)
        R = self.row_sums = kernels.RowSums()
        R.planes, R.all_planes, R.rows, R.chunks, R.threads = slab, planes, rows, chunks, math.prod(self.threads)
        self.scalars = wp.zeros(kernels.SLOTS, dtype=wp.float64, device=A.device)
        self.sums = Reduction(problem.layout.size, A.device, self.scalars, columns=5, threads=R.threads)
        self.row_kernels = kernels.row_kernels(*s.storage, self._finest.stencil.d.dtype, hierarchy.real)
        self.classify, self.stale, self.active, self._norm_of_b = False, True, 0, 0.0

    def start(self, x: wp.array[Any], *, keep: bool) -> None:
        """Set x to clip(x, l, u) or clip(0, l, u); a guess is classified, a cold start is not."""
        if self._version != self._A.version:
            self._version, self.stale = self._A.version, True
            self._hierarchy.refresh()
        super().start(x, keep=keep)
        self.classify = keep
        if not keep:
            self._norm_of_b = super().norm_of_b()
            self.set(kernels.SIZE, self._norm_of_b or 1.0)

    def norm_of_b(self) -> float:
        """Return ||b|| over the unknowns."""
        return self._norm_of_b

    def evaluate(self, x: wp.array[Any]) -> float:
        """Compute the norm of the natural residual at x, the free set and the right-hand side."""
        self.assess(x)
        return self.read()

    def assess(self, x: wp.array[Any], *, launch: Launch = wp.launch) -> None:
        """Launch the evaluation."""
        p, s, finest = self.problem, self._A.stencil, self._finest
        s.wrap(x, launch=launch)
        inputs = [
            *s.operands, self.row_sums, x, p.b, *p.bounds, p.unknown, finest.stencil.d, finest.b, self.scalars, self.classify,
            self.sums.partials,
        ]  # fmt: skip
        launch(self.row_kernels.assess, self.threads, inputs, device=p.device)
        self.sums.add_up(int(kernels.NORM), columns=3, launch=launch)

    def read(self) -> float:
        """Read what the evaluation found."""
        square, moved, active = self.scalars.numpy()[:3]
        self.norm, self.current, self.active = float(np.sqrt(square)), True, int(active)
        self.stale = self.stale or moved > 0
        return self.norm

    def set(self, slot: int, value: float) -> None:
        """Write a scalar."""
        self.scalars[int(slot) : int(slot) + 1].fill_(value)


class MultigridWorkspace(IterateInBuffers):
    """Memory of the method for one problem."""

    def __init__(self, problem: LCP, A: GridPoisson, settings: ProjectedMultigrid) -> None:
        super().__init__(problem.layout.zeros(wp.float64))
        self.problem, self.A, self.settings, self.precision = problem, A, settings, Precision(settings.precision)
        self.bounded = problem.bounded
        real = self.precision.correction
        self._p, self._ap = problem.layout.zeros(real), problem.layout.zeros(real)
        # a projected cycle forgets the search direction, so its bounds may lie in that memory: finite numbers, and 0 off the unknowns
        self.hierarchy = Hierarchy(A.stencil, real, bounded=self.bounded, settings=settings.cycle, bounds=(self._p, self._ap))
        self.residual = AssessedResidual(problem, A, self.hierarchy)
        self._flat = kernels.flat_kernels(self.hierarchy.finest.stencil.d.dtype, real)
        self._spans = self.residual._reduction.spans
        self._rounded = problem.layout.zeros(wp.float32) if self.precision is Precision.SINGLE else None
        self._programs: dict[tuple[int, int], Program] = {}  # a truncated cycle from one buffer to another
        self._mask: wp.array[Any] | None = None
        self.scratch = self.hierarchy.finest.t if real is wp.float32 else None  # free between cycles
        self.floating: Any = None
        self._cycles_left, self._rises = 0, 0

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Forget the search direction; the operator may have changed."""
        self._cycles_left = self.settings.monotone_cycles if self.bounded and not warm else 0
        self._rises = 0
        self._forget()
        size = float(self.residual.scalars.numpy()[int(kernels.SIZE)])
        rescale = not 1e-6 < self.residual.norm / size < 1e6  # corrections in float32 would overflow, or vanish
        if rescale:
            self.residual.set(kernels.SIZE, self.residual.norm)
        if self.floating is not None:
            self._classify_next()
            self.residual.evaluate(self.x)
            self._project()
        elif rescale:
            self._classify_next()
            self.residual.evaluate(self.x)
        elif self._cycles_left == 0 and not self.residual.classify and self.bounded:
            self.residual.classify = True
            self.residual.evaluate(self.x)

    def wants_monotone_cycle(self) -> bool:
        """Return whether the next step is a projected cycle."""
        if self._rises >= self.settings.patience and self.bounded:  # conjugate gradients alone may rise
            self._rises = 0
            self._forget()
            self._cycles_left = 1
            self.residual.classify = False
            self.residual.evaluate(self.x)
        return self._cycles_left > 0

    def monotone_step(self) -> Step:
        """Projected cycle on all unknowns."""
        p, finest, last = self.problem, self.hierarchy.finest, self.residual.norm
        self._rebuild()
        self._forget()
        before = [self.x, *p.bounds, p.unknown, finest.lower, finest.upper, self.residual.scalars]
        launch_spans(self._flat.gaps, self._spans, before, [], p.device)
        self.hierarchy.monotone_cycle.run()
        out = self.fresh()
        launch_spans(self._flat.add, self._spans, [self.x, finest.x, *p.bounds, out, self.residual.scalars], [], p.device)
        wp.launch(kernels.rescale_kernel, 1, [self.residual.scalars], device=p.device)
        self._round(out)
        self.advance(out)
        self._cycles_left -= 1
        self._classify_next()
        self.residual.evaluate(out)
        self._count_rises(last)
        return Step("monotone cycle", 1, None)

    def truncated_step(self) -> Step:
        """One linear cycle on the free unknowns, made conjugate to the last direction, projected."""
        p, last, active = self.problem, self.residual.norm, self.residual.active
        if self.residual.stale:
            self._rebuild()
            self._forget()  # measured: making the old direction fit the new free set costs a product and saves no iteration
        x, out = self.x, self.fresh()
        if self.floating is None and self._rounded is None:
            self._program(x, out).run()
        else:
            self.hierarchy.cycle.run()
            self._correct(x, out)
            if self.floating is not None:
                self.floating.settle(out, p.lower, p.upper)
            self._round(out)
            self.residual.assess(out)
        self.advance(out)
        self.residual.read()
        if self.floating is not None:
            self._project()
        self._count_rises(last)
        return Step("truncated cycle", 1, active)

    def _program(self, x: wp.array[Any], out: wp.array[Any]) -> Program:
        """Return the launches that step from x to out and assess it."""
        program = self._programs.get((x.ptr, out.ptr))
        if program is None:
            program = self._programs[x.ptr, out.ptr] = Program(self.A.device)
            program.extend(self.hierarchy.cycle)
            self.residual.classify = True
            self._correct(x, out, launch=program.launch)
            self.residual.assess(out, launch=program.launch)
        return program

    def _correct(self, x: wp.array[Any], out: wp.array[Any], *, launch: Launch = wp.launch) -> None:
        """Measure the cycle's correction, step from x to out."""
        p, residual, finest, device = self.problem, self.residual, self.hierarchy.finest, self.A.device
        finest.stencil.wrap(finest.x, launch=launch)
        fields = [finest.x, self._p, self._ap, finest.b, finest.t, residual.sums.partials]
        inputs = [*finest.operands, finest.stencil.grain, residual.row_sums, *fields]
        launch(residual.row_kernels.measure, residual.threads, inputs, device=device)
        residual.sums.add_up(int(kernels.ZAZ), columns=5, launch=launch)
        launch(kernels.plan_step_kernel, 1, [residual.scalars], device=device)
        before = [x, finest.x, finest.t, self._p, self._ap, *p.bounds, out, residual.scalars]
        launch_spans(self._flat.update, self._spans, before, [], device, launch=launch)

    def _rebuild(self) -> None:
        if self.residual.stale:
            self.hierarchy.rebuild()
            self.residual.stale = False

    def _classify_next(self) -> None:
        """Unknowns at their bounds leave the free set unless a projected cycle comes next."""
        self.residual.classify = self._cycles_left == 0

    def _count_rises(self, last: float) -> None:
        self._rises = self._rises + 1 if self.residual.norm > last else 0

    def _forget(self) -> None:
        """Drop the search direction."""
        self.residual.set(kernels.CARRY, 0.0)

    def _project(self) -> None:
        """Keep the right-hand side compatible on singular components."""
        free = self.hierarchy.finest.stencil.d
        if self._mask is None:
            self._mask = self.problem.layout.zeros(wp.uint8)
        wp.launch(kernels.free_mask_kernel, free.size, [free, self._mask], device=self.A.device)
        self.floating.project(self.hierarchy.finest.b, self._mask)

    def round_iterate(self) -> None:
        """Round x to its precision."""
        self._round(self.x)

    def _round(self, x: wp.array[Any]) -> None:
        if self._rounded is not None:
            convert(x, self._rounded)
            convert(self._rounded, x)
