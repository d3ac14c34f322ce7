"""Conjugate gradients on a grid in fused passes, preconditioned by multigrid."""

from __future__ import annotations

from pathlib import Path
from typing import no_type_check

import warp as wp

from warp_lcp.kernels import FusedKernel, KernelFile
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import Launch, launch
from warp_lcp.kernels.vectors import Reduction
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient, first_iteration, next_iteration
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.subproblems import grid_step_kernels as engine
from warp_lcp.subproblems.grid_step_kernels import BETA, CARRY, NORM, SIZE, STEP
from warp_lcp.subproblems.grid_step_kernels import SLOTS as STEP_SLOTS

# Slots of the device scalars after those of a step, from the square of the residual on.
SQUARE = wp.constant(STEP_SLOTS)
ITERATIONS = wp.constant(STEP_SLOTS + 3)
SLOTS = STEP_SLOTS + 5

KERNELS = KernelFile(
    Path(__file__).parent / "headers/reduced_systems.h",
    {"BETA": BETA, "STEP": STEP, "ITERATIONS": ITERATIONS},
)
DIRECT = KERNELS["grid_conjugate_gradient.direct"]
STEP_ALONG = KERNELS["grid_conjugate_gradient.step"]
# Both planes are in the cache.
ADVANCE = FusedKernel("grid_conjugate_gradient.advance", (DIRECT, 0), (STEP_ALONG, 1))

f64 = wp.array(dtype=wp.float64)


@no_type_check
@forward_kernel(module="warp_lcp.grid_conjugate_gradient")
def begin_grid_kernel(scalars: f64, going: wp.array(dtype=int), tolerance: wp.float64, limit: int):
    """Initialize: no old direction, no norm yet."""
    scalars[CARRY] = wp.float64(0.0)
    scalars[NORM] = wp.float64(0.0)
    scalars[SIZE] = wp.float64(1.0)
    going[0] = first_iteration(scalars, SQUARE, tolerance, limit)


@no_type_check
@forward_kernel(module="warp_lcp.grid_conjugate_gradient")
def end_grid_kernel(scalars: f64, going: wp.array(dtype=int)):
    """Decide after an iteration whether to go on."""
    more = next_iteration(scalars, SQUARE)
    going[0] = wp.where(scalars[STEP] == wp.float64(0.0), 0, more)


class FusedConjugateGradient(ConjugateGradient):
    """Conjugate gradients in fused passes, preconditioned by a multigrid cycle.

    For one CPU thread and a grid without periodic axes. Besides the descent of the cycle there are
    two passes over the finest level. The last part of the cycle sums the products of z = M r for
    beta and alpha. A second pass computes the direction, moves the solution and subtracts alpha A p
    from the residual, one plane behind. Beta comes from z'A p, so that no product of residuals is
    carried over; the norm of the residual decides when to stop.

    Args:
        source: the operator's stencil.
        hierarchy: preconditioner; its finest `b` is the right-hand side, which becomes the
            residual.
        weighted: residuals are measured as ||d^(-1/2) r||, d the finest diagonal, else as ||r||.
    """

    _end_kernel = end_grid_kernel

    def __init__(self, source: PaddedStencil, hierarchy: Hierarchy, *, weighted: bool) -> None:
        finest = hierarchy.finest
        r, s = finest.b, finest.stencil
        self._allocate(r, SLOTS, int(SQUARE))
        scalars = self._scalars.array
        sums = self._reduction = Reduction(
            r.size, r.device, scalars, columns=4, threads=s.rows.places
        )
        direct = DIRECT.bind(s.rows, z=finest.x, q=self._p, scalars=scalars)
        step = STEP_ALONG.bind(
            s.rows,
            stencil=s,
            q=self._p,
            x=self.x,
            r=r,
            scalars=scalars,
            weighted=weighted,
            out=sums.partials,
        )
        self._passes = direct, step
        self._program = hierarchy.cycle_with(
            engine.CLIMB, engine.measure_kernel(finest, self._p, sums.partials)
        )
        self._advance(self._program.launch)

    def clear(self) -> None:
        """Clear values outside the current rows of the operator."""
        self.x.zero_()
        self._p.zero_()

    def _launch_beginning(self) -> None:
        """Launch the start; the first iteration writes x and p."""
        launch(
            begin_grid_kernel,
            1,
            [self._scalars.array, self._going, *self._goal[:2]],
            device=self.device,
        )

    def _turn(self, launch: Launch) -> None:
        """Compute beta and alpha from the cycle's sums z'A z, z'A p, r'z and r'p."""
        self._reduction.add_up(int(engine.ZAZ), columns=4, launch=launch)
        launch(engine.plan_step_kernel, 1, [self._scalars.array], device=self.device)

    def _move(self, launch: Launch) -> None:
        """Update p = z + beta p, x += alpha p and r -= alpha A p; sum r'r."""
        ADVANCE.launch(*self._passes, launch=launch)
        self._reduction.add_up(int(SQUARE), launch=launch)
