"""Preconditioned conjugate gradients with scalars that stay on the device; one captured graph an iteration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_lcp.krylov.conjugate_gradient_kernels import PQ, RR, RZ, kernels, remember_kernel
from warp_lcp.vectors import Reduction, launch_spans


class Preconditioner(Protocol):
    """z = M r, M symmetric positive definite: reads its own field `r`, writes its own field `z`."""

    r: wp.array[Any]
    z: wp.array[Any]

    def apply(self) -> None:
        """Write z."""


class ConjugateGradient:
    """Solve A x = r for a symmetric positive (semi-)definite A.

    The right-hand side is the preconditioner's field `r`, which becomes the residual; the solution is `x`. An iteration is launched
    kernels only, captured once and replayed; the host reads one scalar after each, the residual's norm.

    Args:
        product: writes A p to q, called as product(p, q).
        preconditioner: M.
        capture: whether A and M are kernel launches only, so that an iteration may be captured.
    """

    def __init__(
        self, product: Callable[[wp.array[Any], wp.array[Any]], None], preconditioner: Preconditioner, *, capture: bool = True
    ) -> None:
        self._capture = capture
        self._product, self._preconditioner = product, preconditioner
        r = preconditioner.r
        self.device, self.x, self._p, self._q = r.device, wp.zeros_like(r), wp.zeros_like(r), wp.zeros_like(r)
        self._scalars = wp.zeros(4, dtype=wp.float64, device=r.device)
        self._reduction = Reduction(r.size, r.device, self._scalars)
        self._kernels = kernels(r.dtype)
        self._graph: Any = None

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Iterate from x = 0 until ||r|| <= tolerance.

        Returns:
            The iterations done and the norm of the carried residual, an estimate that rounding bounds from below.
        """
        self.x.zero_()
        self._p.zero_()
        self._scalars.zero_()
        norm, best = np.inf, np.inf
        for iteration in range(1, max_iterations + 1):
            self._iterate()
            norm = float(np.sqrt(self._scalars.numpy()[RR]))
            if norm <= tolerance or not np.isfinite(norm):
                return iteration, norm
            if norm >= 1e3 * best:  # the carried residual grows: A or M is not positive definite to this precision
                return iteration, norm
            best = min(best, norm)
        return max_iterations, norm

    def _iterate(self) -> None:
        """Replay an iteration; the first one runs as it is, so that every kernel is loaded before the capture."""
        if self._graph is None:
            self._launch()
            if not self._capture:
                return
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                self._launch()
            self._graph = capture.graph
            return
        wp.capture_launch(self._graph)

    def _launch(self) -> None:
        spans, partials, r, z = self._reduction.spans, self._reduction.partials, self._preconditioner.r, self._preconditioner.z
        self._preconditioner.apply()
        self._reduction.dot(r, z, RZ)
        launch_spans(self._kernels.direction, spans, [z, self._p, self._scalars], [], self.device)
        self._product(self._p, self._q)
        self._reduction.dot(self._p, self._q, PQ)
        launch_spans(self._kernels.update, spans, [self._p, self._q, self.x, r, self._scalars], [partials], self.device)
        self._reduction.add_up(RR)
        wp.launch(remember_kernel, 1, [self._scalars], device=self.device)
