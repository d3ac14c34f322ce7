"""Conjugate gradients on a grid, preconditioned by multigrid, in two passes over the finest level besides the way down the cycle."""

from __future__ import annotations

from pathlib import Path
from typing import no_type_check

import numpy as np
import warp as wp

from warp_lcp.krylov.conjugate_gradient import first_iteration, next_iteration
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.rows import KernelFile, Wave
from warp_lcp.rows.compiler import forward_kernel
from warp_lcp.rows.fields import zeros_like
from warp_lcp.rows.vectors import Reduction
from warp_lcp.solvers import projected_multigrid_kernels as engine
from warp_lcp.solvers.projected_multigrid_kernels import BETA, CARRY, NORM, SIZE, STEP
from warp_lcp.solvers.projected_multigrid_kernels import SLOTS as STEP_SLOTS

SQUARE = wp.constant(STEP_SLOTS)  # slots of the device scalars after those of a step: from the carried residual's square on
ITERATIONS = wp.constant(STEP_SLOTS + 3)
SLOTS = STEP_SLOTS + 5

KERNELS = KernelFile(Path(__file__).parent / "headers/gradient_projection.h", {"BETA": BETA, "STEP": STEP, "ITERATIONS": ITERATIONS})
DIRECT = KERNELS["grid_conjugate_gradient.direct"]
STEP_ALONG = KERNELS["grid_conjugate_gradient.step"]
ADVANCE = Wave("grid_conjugate_gradient.advance", (DIRECT, 0), (STEP_ALONG, 1))  # both planes are in the cache

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


class GridConjugateGradient:
    """What `ConjugateGradient` does, for one CPU thread and a grid without periodic axes.

    The cycle's last leg sums the products of its correction that beta and the step need; a second pass makes the direction, moves the
    solution and takes A p off the residual, one plane behind. Beta comes from z'A p, so that no product of residuals is carried on.

    Args:
        source: the operator's stencil.
        hierarchy: preconditioner; its finest `b` is the right-hand side, which becomes the residual.
        weighted: residuals are measured as ||d^(-1/2) r||, d the finest diagonal, else as ||r||.
    """

    def __init__(self, source: PaddedStencil, hierarchy: Hierarchy, *, weighted: bool) -> None:
        finest, device = hierarchy.finest, hierarchy.device
        r, s = finest.b, finest.stencil
        self.device, self.x, self._p = device, zeros_like(r), zeros_like(r)
        self._scalars = wp.zeros(SLOTS, dtype=wp.float64, device=device)
        self._going = wp.zeros(1, dtype=wp.int32, device=device)
        sums = Reduction(r.size, device, self._scalars, columns=4, threads=s.rows.places)
        program = self._program = hierarchy.cycle_with(engine.CLIMB, engine.measuring(finest, self._p, sums.partials))
        sums.add_up(int(engine.ZAZ), columns=4, launch=program.launch)
        program.launch(engine.plan_step_kernel, 1, [self._scalars], device=device)
        direct = DIRECT.bind(s.rows, z=finest.x, q=self._p, scalars=self._scalars)
        step = STEP_ALONG.bind(s.rows, stencil=s, q=self._p, x=self.x, r=r, scalars=self._scalars, weighted=weighted, out=sums.partials)
        ADVANCE.launch(direct, step, launch=program.launch)
        sums.add_up(int(SQUARE), launch=program.launch)
        program.launch(end_grid_kernel, 1, [self._scalars, self._going], device=device)

    def clear(self) -> None:
        """Forget what lies outside the rows that the operator has now."""
        self.x.zero_()
        self._p.zero_()

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from x = 0 until ||r|| <= tolerance, ||r|| is no number, it has grown by GROWTH over its least, or A p = 0.

        Returns:
            The iterations done and the norm of the carried residual, an estimate that rounding bounds from below.
        """
        wp.launch(begin_grid_kernel, 1, [self._scalars, self._going, tolerance, max_iterations], device=self.device)
        self._program.run_while(self._going)
        scalars = self._scalars.numpy()
        return int(scalars[int(ITERATIONS)]), float(np.sqrt(scalars[int(SQUARE)]))
