"""Projected Jacobi method: update all unknowns from the same iterate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step
from warp_lcp.problem.operator_protocol import version_of
from warp_lcp.settings import Positive, Settings
from warp_lcp.solvers.psor import SweepWorkspace
from warp_lcp.sweeps.spectrum import scaled_spectrum
from warp_lcp.sweeps.sweep_kernels import jacobi_kernel

STEPS = 20  # of Lanczos' method
# Part of 2 / lambda_max, the limit of convergence of Jacobi's method; Lanczos' method estimates
# lambda_max from below.
SHARE = 1.8


@dataclass(frozen=True, kw_only=True)
class ProjectedJacobi(Settings):
    """Projected Jacobi method: solve each scalar problem from the same x.

    [Book] 2.2.1, table 2.1 and eq. 2.63 with M = D / omega.

    x <- clip(x - omega D^-1 (A x + b), l, u). The method converges for symmetric positive definite
    A and 0 < omega < 2 / lambda_max(D^-1 A). The book's omega = 1 is too large for many matrices;
    the test of algorithm 4 then returns DIVERGED (see `Contraction`). It is about half as fast as
    projected Gauss-Seidel, but its result does not depend on the order of the unknowns, so that it
    is no slower on a GPU. Zero and negative diagonals are treated as in ProjectedSOR. It works with
    any operator, and with bounds affine in x, which are evaluated at the last x.

    Args:
        omega: damping > 0; min(1, 1.8 / lambda_max), estimated, if None. Without symmetry,
            lambda_max is that of A's symmetric part, which guarantees nothing; with a negative
            diagonal entry, 1.
        precision: "mixed" or "double" keep the iterate in float64, "single" rounds it to float32.
    """

    needs: ClassVar[str] = (
        "symmetric positive (semi-)definite A for a proof of convergence; A_ii <= 0 case by case"
    )
    affine_bounds: ClassVar[bool] = True

    omega: Positive | None = None
    precision: PrecisionName = "mixed"

    def init(self, problem: LCP) -> JacobiWorkspace:
        """Return a workspace.

        Raises:
            ValueError: a zero or negative diagonal entry with a right-hand side that no bound
                meets.
        """
        work = JacobiWorkspace(problem, self)
        work.diagonal.check()
        return work

    def step(self, problem: LCP, work: JacobiWorkspace, x: DeviceArray) -> Step:
        """Update all unknowns once; y is that of the residual."""
        r = work.residual
        inputs = [work.d, r.unit, r.y, problem.lower, problem.upper, problem.unknown, work.omega, x]
        wp.launch(jacobi_kernel(work.d.dtype), x.size, inputs, device=problem.device)
        work.round_iterate()
        return Step("sweep", 1, failure=work.contraction.test(x))


class JacobiWorkspace(SweepWorkspace):
    """Workspace of the method.

    Attributes:
        omega: the damping in use.
        d: A's diagonal / unit, stored field, as it was when the solve began.
    """

    d: DeviceArray

    def __init__(self, problem: LCP, settings: ProjectedJacobi) -> None:
        super().__init__(problem, settings.precision)
        self._omega, self._version = settings.omega, object()
        self.omega = settings.omega or 1.0

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Estimate the damping if the operator is new."""
        self.d, version = self.diagonal.field(), version_of(self.problem.A)
        if self._omega is None and version != self._version:
            self.omega = self._estimate()
            self._version = version  # last: the time limit may end the estimate before
        self.contraction.start(self.x)

    def _estimate(self) -> float:
        if (self.diagonal.values() < 0).any():
            return 1.0
        greatest = scaled_spectrum(self.problem, STEPS)[1]
        return min(1.0, SHARE / greatest) if greatest > 0 else 1.0
