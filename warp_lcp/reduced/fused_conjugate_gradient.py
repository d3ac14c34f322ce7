"""Conjugate gradients on a grid in fused passes, with a multigrid cycle as preconditioner."""

from __future__ import annotations

from pathlib import Path
from typing import no_type_check

import warp as wp

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient, first_iteration, next_iteration
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.reduced import grid_step_kernels as engine
from warp_lcp.reduced.grid_step_kernels import BETA, CARRY, NORM, SIZE, STEP
from warp_lcp.reduced.grid_step_kernels import SLOTS as STEP_SLOTS
from warp_lcp.rows import KernelFile, Wave
from warp_lcp.rows.compiler import forward_kernel
from warp_lcp.rows.program import Launch, launch
from warp_lcp.rows.vectors import Reduction

# slots of the device scalars after those of a step: from the carried residual's square on
SQUARE = wp.constant(STEP_SLOTS)
ITERATIONS = wp.constant(STEP_SLOTS + 3)
SLOTS = STEP_SLOTS + 5

KERNELS = KernelFile(
    Path(__file__).parent / "headers/fused_conjugate_gradient.h",
    {"BETA": BETA, "STEP": STEP, "ITERATIONS": ITERATIONS},
)
DIRECT = KERNELS["grid_conjugate_gradient.direct"]
STEP_ALONG = KERNELS["grid_conjugate_gradient.step"]
# both planes are in the cache
ADVANCE = Wave("grid_conjugate_gradient.advance", (DIRECT, 0), (STEP_ALONG, 1))

f64 = wp.array(dtype=wp.float64)


@no_type_check
@forward_kernel(module="warp_lcp.grid_conjugate_gradient")
def begin_grid_kernel(scalars: f64, going: wp.array(dtype=int), tolerance: wp.float64, limit: int):
    """Before the first iteration: no old direction, no norm yet."""
    scalars[CARRY] = wp.float64(0.0)
    scalars[NORM] = wp.float64(0.0)
    scalars[SIZE] = wp.float64(1.0)
    going[0] = first_iteration(scalars, SQUARE, tolerance, limit)


@no_type_check
@forward_kernel(module="warp_lcp.grid_conjugate_gradient")
def end_grid_kernel(scalars: f64, going: wp.array(dtype=int)):
    """After an iteration: decide whether to go on."""
    more = next_iteration(scalars, SQUARE)
    going[0] = wp.where(scalars[STEP] == wp.float64(0.0), 0, more)


class FusedConjugateGradient(ConjugateGradient):
    """`ConjugateGradient` in fused passes, for one CPU thread and a grid without periodic axes, preconditioned by a multigrid cycle.

    Two passes over the finest level besides the way down the cycle: the cycle's last leg sums the
    products of z = M r that beta and alpha need; a second pass makes the direction, moves the
    solution and takes alpha A p off the residual, one plane behind. Beta comes from z'A p, so that
    no product of residuals is carried on; the norm of the residual decides when to stop.

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
            engine.CLIMB, engine.measuring(finest, self._p, sums.partials)
        )
        self._advance(self._program.launch)

    def clear(self) -> None:
        """Forget what lies outside the rows that the operator has now."""
        self.x.zero_()
        self._p.zero_()

    def _launch_beginning(self) -> None:
        """Launch the start: the first iteration writes x and p."""
        launch(
            begin_grid_kernel,
            1,
            [self._scalars.array, self._going, *self._goal[:2]],
            device=self.device,
        )

    def _turn(self, launch: Launch) -> None:
        """Beta and alpha, of the sums z'A z, z'A p, r'z and r'p that the cycle has left."""
        self._reduction.add_up(int(engine.ZAZ), columns=4, launch=launch)
        launch(engine.plan_step_kernel, 1, [self._scalars.array], device=self.device)

    def _move(self, launch: Launch) -> None:
        """p = z + beta p, x += alpha p, r -= alpha A p; and r'r."""
        ADVANCE.launch(*self._passes, launch=launch)
        self._reduction.add_up(int(SQUARE), launch=launch)
