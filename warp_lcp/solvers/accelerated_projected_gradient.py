"""Accelerated projected gradient method (proximal map, Nesterov's momentum)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import warp as wp

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step, WorkspaceBase
from warp_lcp.problem.operator_protocol import version_of
from warp_lcp.settings import Count, Positive, Settings
from warp_lcp.sweeps.spectrum import positive_diagonal, scaled_spectrum

KERNELS = KernelFile(Path(__file__).parent / "headers/gradient_projection.h")
PROGRESS = KERNELS["accelerated.progress"]
EXTRAPOLATE = KERNELS["accelerated.extrapolate"]
MARGIN = 1.05  # Lanczos' method estimates L from below
FAR = 1.5  # times L: a step of larger curvature is rejected
NOISE = 1e-20  # relative (squared) length of a step below which its curvature is rounding


@dataclass(frozen=True, kw_only=True)
class AcceleratedProjectedGradient(Settings):
    """Projected gradient method with Nesterov momentum.

    It iterates the proximal map x = prox_K(x - r (A x + b)) of the box K ([Book] 1.1.4).

    With the diagonal D of A as metric and L = lambda_max(D^-1/2 A D^-1/2): x+ = clip(z - D^-1 (A z
    + b) / L, l, u), where z = x + beta (x - x_old) with Nesterov's beta. The momentum is reset
    where (z - x+)' D (x+ - x) > 0. L comes from Lanczos' method and is raised where the curvature
    of a step exceeds it; where the curvature exceeds 1.5 L, the step is rejected. A step needs one
    product with A, since A z + b is extrapolated in the same way as z. The method converges for
    symmetric positive semidefinite A; the error of the energy falls as 1/k^2, and faster near the
    solution.

    Args:
        lipschitz: L > 0 in the metric D; estimated if None.
        estimate_steps: number of products with A for the estimate.
        precision: "mixed" or "double" keep the iterate in float64, "single" rounds it to float32.
    """

    needs: ClassVar[str] = "symmetric positive semidefinite A"

    lipschitz: Positive | None = None
    estimate_steps: Count = 20
    precision: PrecisionName = "mixed"

    def init(self, problem: LCP) -> AcceleratedWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is not symmetric, or a diagonal entry is negative.
        """
        if not problem.A.symmetric:
            raise ValueError(
                f"{type(problem.A).__name__} is not symmetric: A x + b is not a gradient"
            )
        positive_diagonal(problem)
        return AcceleratedWorkspace(problem, self)

    def step(self, problem: LCP, work: AcceleratedWorkspace, x: DeviceArray) -> Step:
        """Take one step with momentum."""
        work.advance(x)
        return Step("gradient")


@dataclass(frozen=True, slots=True)
class MomentumFields:
    """Stored fields that both kernels of a step use.

    Attributes:
        x: iterate.
        x_old: the iterate before.
        y: A x + b.
        z: the extrapolated iterate.
        y_z: A z + b.
        d: scale of each unknown.
        unknown: 1 where there is one.
    """

    x: DeviceArray
    x_old: DeviceArray
    y: DeviceArray
    z: DeviceArray
    y_z: DeviceArray
    d: DeviceArray
    unknown: DeviceArray


class AcceleratedWorkspace(WorkspaceBase):
    """Workspace of the accelerated projected gradient method.

    Attributes:
        lipschitz: the current L.
    """

    def __init__(self, problem: LCP, settings: AcceleratedProjectedGradient) -> None:
        super().__init__(problem, settings.precision)
        self.settings, zeros = settings, problem.layout.zeros
        self._x_old, self._y_old, self._z, self._y_z = (zeros(wp.float64) for _ in range(4))
        self.lipschitz = settings.lipschitz or 1.0
        self._version: object = object()
        self._d = zeros(wp.float64)
        self._sums = RowReduction(rows_of(self.x), len(PROGRESS.sums))

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Reset the momentum; estimate L again if the operator has changed."""
        self._momentum = 0.0  # Nesterov's t; 0 before the first step, when there is no z
        version = version_of(self.problem.A)
        if version != self._version:
            self._d.assign(positive_diagonal(self.problem))
            if self.settings.lipschitz is None:
                greatest = scaled_spectrum(self.problem, self.settings.estimate_steps)[1]
                # any L will do for a zero matrix
                self.lipschitz = MARGIN * greatest if greatest > 0 else 1.0
            self._version = version  # last: the time limit may end the estimate before

    def advance(self, x: DeviceArray) -> None:
        """Take one step; `residual.y` is A x + b at x.

        With beta of the last step: z = x + beta (x - x_old), y_z = y + beta (y - y_old), and then x
        <- clip(z - D^-1 y_z / L, l, u). The kernel stores the x and y before the step, to which a
        rejected step returns.
        """
        p, beta = self.problem, self._beta(x) if self._momentum > 0 else 0.0
        if self._momentum == 0:
            self._momentum = 1.0
        EXTRAPOLATE.bind(
            self._sums.rows,
            self._momenta(x),
            bounds=p.bounds.operands,
            y_old=self._y_old,
            beta=beta,
            lipschitz=self.lipschitz,
        ).launch()
        self.round_iterate()

    def _beta(self, x: DeviceArray) -> float:
        """Return Nesterov's beta for the next step; correct L by the last one.

        With s = x - z of the last step, its curvature is s'A s = s'(y - y_z), to be compared with L
        s'D s. A larger curvature raises L, and by far larger rejects the step. Both cases, and (z -
        x)' D (x - x_old) > 0, reset the momentum: beta = 0. Else t+ = (1 + sqrt(1 + 4 t^2)) / 2 and
        beta = (t - 1) / t+.
        """
        curvature, metric, turned, size = self._sums.of(PROGRESS, self._momenta(x))
        exceeded = metric > NOISE * size and curvature > self.lipschitz * metric
        if exceeded:
            rejected = curvature > FAR * self.lipschitz * metric
            self.lipschitz = MARGIN * float(curvature / metric)
            if rejected:
                wp.copy(x, self._x_old)
                wp.copy(self.residual.y, self._y_old)
        if exceeded or turned > 0:
            self._momentum = 1.0
            return 0.0
        t = self._momentum
        self._momentum = (1 + math.sqrt(1 + 4 * t * t)) / 2
        return (t - 1) / self._momentum

    def _momenta(self, x: DeviceArray) -> MomentumFields:
        """Return the fields that both kernels read."""
        return MomentumFields(
            x, self._x_old, self.residual.y, self._z, self._y_z, self._d, self.problem.unknown
        )
