"""Nonsmooth nonlinear conjugate gradient method (NNCG).

Fletcher-Reeves directions from the changes of projected Gauss-Seidel sweeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step
from warp_lcp.problem.operator_protocol import HasRows, HasSweep, check_taken
from warp_lcp.problem.residual import WITHIN
from warp_lcp.settings import Relaxation, Settings
from warp_lcp.solvers.psor import DIRECTIONS, Direction, SweepWorkspace
from warp_lcp.sweeps.sweep import sweep_for

KERNELS = KernelFile(Path(__file__).parent / "headers/gradient_projection.h")
TAKEN = KERNELS["nncg.taken"]
CARRY_ON = KERNELS["nncg.carry_on"]


@dataclass(frozen=True, kw_only=True)
class NNCG(Settings):
    """Nonsmooth nonlinear conjugate gradients over projected Gauss-Seidel sweeps.

    [Book] 2.2.6, algorithm 8; Silcowitz-Hansen et al. 2010.

    The change of a sweep is the negative gradient, g = x - PGS(x), of a function whose minimum is
    the sweep's fixed point. With beta = |g|^2 / |g_old|^2: x <- PGS(x) + beta p and p <- beta p - g
    without a line search; where beta > 1, p <- 0 and x <- PGS(x). Unlike algorithm 8, x is
    projected onto the bounds after the move along p, so that iterates stay feasible. Where bounds
    are affine in x, the unknowns that they depend on are projected first: if friction kept the
    bounds from before the move, most of the acceleration would be lost (a box on others a thousand
    times lighter, 5,000 sweeps: 3e-3 of the first residual instead of 4e-11). There is no proof of
    convergence. On 64^3 cells to 1e-6 it took 250 sweeps; projected Gauss-Seidel took 3,900 with
    omega = 1, and 150 to 200 with the best omega, 1.9.

    Args:
        direction: of its sweeps, "forward", "backward" or "symmetric".
        omega: relaxation factor of its sweeps, in (0, 2).
        precision: "mixed" or "double" keep the iterate in float64, "single" rounds it to float32.
    """

    supports: ClassVar = (HasSweep, HasRows)
    needs: ClassVar[str] = "as for ProjectedSOR"
    affine_bounds: ClassVar[bool] = True

    direction: Direction = "forward"
    omega: Relaxation = 1.0
    precision: PrecisionName = "mixed"

    def init(self, problem: LCP) -> NNCGWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A cannot be swept; see ProjectedSOR.
        """
        check_taken(self, problem.A)
        work = NNCGWorkspace(problem, self.precision, self.omega)
        work.diagonal.check()
        return work

    def step(self, problem: LCP, work: NNCGWorkspace, x: DeviceArray) -> Step:
        """Sweep, then move along the last direction."""
        wp.copy(work.g, x)
        for forward in DIRECTIONS[self.direction]:
            work.sweep.run(x, forward=forward)
        work.advance(x)
        return Step("sweep", len(DIRECTIONS[self.direction]), failure=work.contraction.test(x))


class NNCGWorkspace(SweepWorkspace):
    """Workspace of the method.

    Attributes:
        g: stored field, x before the sweep, then the gradient.
        p: stored field, the direction.
    """

    def __init__(self, problem: LCP, precision: str, omega: float) -> None:
        super().__init__(problem, precision)
        self.sweep = sweep_for(problem, self.diagonal, omega)
        self.g, self.p = problem.layout.zeros(wp.float64), problem.layout.zeros(wp.float64)
        affine = problem.bounds.affine
        self._constant = problem.bounds.operands  # where bounds do not depend on x
        if affine is not None:
            sides = zip(affine.constant, affine.index, (-np.inf, np.inf), strict=True)
            lower, upper = (_where_constant(*side) for side in sides)
            self._constant = self._constant._replace(lower=lower, upper=upper)
        self._sums = RowReduction(rows_of(self.x), slots=2)

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Reset the direction; the operator may have changed."""
        super().start(warm=warm, tolerance=tolerance)
        self._sums.scalars.zero_()
        self.p.zero_()

    def advance(self, x: DeviceArray) -> None:
        """Move x after a sweep along p, and update p.

        g = x_before - x; beta = |g|^2 / |g_old|^2; x <- clip(x + beta p), p <- beta p - g, or both
        restart where beta > 1. Both squares stay on the device.
        """
        p, sums, unknown = self.problem, self._sums, self.problem.unknown
        sums.of(TAKEN, x=x, g=self.g, unknown=unknown)
        bounds = p.bounds.operands if p.bounds.affine is None else self._constant
        CARRY_ON.bind(
            sums.rows,
            bounds=bounds,
            x=x,
            g=self.g,
            unknown=unknown,
            along=self.p,
            squares=sums.scalars,
        ).launch()
        if p.bounds.affine is not None:
            p.bounds.follow(x)
            WITHIN.bind(
                sums.rows, bounds=p.bounds.operands, x=x, unknown=p.unknown, keep=True
            ).launch()
        wp.copy(sums.scalars, sums.scalars, dest_offset=1, src_offset=0, count=1)
        self.round_iterate()


def _where_constant(constant: DeviceArray, index: DeviceArray, none: float) -> DeviceArray:
    """Return a bound as a field that is `none` where it depends on x."""
    return wp.array(
        np.where(index.numpy() < 0, constant.numpy(), none),
        dtype=wp.float64,
        device=constant.device,
    )
