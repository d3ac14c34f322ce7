"""Conjugate gradients on a grid, preconditioned by multigrid, in two passes over the finest level besides the way down the cycle."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.stencil import Stencil
from warp_lcp.rows.program import Program
from warp_lcp.rows.vectors import Reduction
from warp_lcp.solvers import grid_conjugate_gradient_kernels as kernels
from warp_lcp.solvers import projected_multigrid_kernels as engine


class GridConjugateGradient:
    """What `ConjugateGradient` does, for one CPU thread and a grid without periodic axes.

    The cycle's last leg sums the products of its correction that beta and the step need; a second pass makes the direction, moves the
    solution and takes A p off the residual, one plane behind. Beta comes from z'A p, so that no product of residuals is carried on.

    Args:
        source: the operator's stencil.
        hierarchy: preconditioner; its finest `b` is the right-hand side, which becomes the residual.
        weighted: residuals are measured as ||d^(-1/2) r||, d the finest diagonal, else as ||r||.
    """

    def __init__(self, source: Stencil, hierarchy: Hierarchy, *, weighted: bool) -> None:
        finest, device = hierarchy.finest, hierarchy.device
        r, s = finest.b, finest.stencil
        self.device, self.x, self._p = device, wp.zeros_like(r), wp.zeros_like(r)
        self._scalars = wp.zeros(kernels.SLOTS, dtype=wp.float64, device=device)
        self._going = wp.zeros(1, dtype=wp.int32, device=device)
        sums = Reduction(r.size, device, self._scalars, columns=4, threads=s.rows.places)
        program = self._program = Program(device)
        assert hierarchy.open_cycle is not None
        program.extend(hierarchy.open_cycle)
        engine.CLIMB.launch(*hierarchy.last_leg(), engine.measuring(finest, self._p, sums.partials), launch=program.launch)
        sums.add_up(int(engine.ZAZ), columns=4, launch=program.launch)
        program.launch(engine.plan_step_kernel, 1, [self._scalars], device=device)
        direct = kernels.DIRECT.bind(s.rows, z=finest.x, q=self._p, scalars=self._scalars)
        fields = {"q": self._p, "x": self.x, "r": r, "scalars": self._scalars, "weighted": weighted, "out": sums.partials}
        kernels.ADVANCE.launch(direct, kernels.STEP_ALONG.bind(s.rows, stencil=s, **fields), launch=program.launch)
        sums.add_up(int(kernels.SQUARE), launch=program.launch)
        program.launch(kernels.end_kernel, 1, [self._scalars, self._going], device=device)

    def clear(self) -> None:
        """Forget what lies outside the rows that the operator has now."""
        self.x.zero_()
        self._p.zero_()

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from x = 0 until ||r|| <= tolerance, ||r|| is no number, it has grown by GROWTH over its least, or A p = 0.

        Returns:
            The iterations done and the norm of the carried residual, an estimate that rounding bounds from below.
        """
        wp.launch(kernels.begin_kernel, 1, [self._scalars, self._going, tolerance, max_iterations], device=self.device)
        self._program.run_while(self._going)
        scalars = self._scalars.numpy()
        return int(scalars[int(kernels.ITERATIONS)]), float(np.sqrt(scalars[int(kernels.SQUARE)]))
