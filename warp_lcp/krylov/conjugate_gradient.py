"""Preconditioned conjugate gradients with scalars that stay on the device; one captured graph an iteration."""

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_lcp.vectors import Reduction, flat, launch_spans, span_end, span_start

RZ = wp.constant(0)  # slots of the device scalars
PQ = wp.constant(1)
RR = wp.constant(2)
RZ_OLD = wp.constant(3)


@functools.cache
def kernels(real: Any) -> SimpleNamespace:
    """Return the vector updates for fields of this type."""
    name = f"warp_lcp.conjugate_gradient.{real.__name__}"
    field, f64 = wp.array(dtype=real), wp.array(dtype=wp.float64)

    @wp.func_native(flat("const auto *z = z_.data; auto *p = p_.data; EACH { p[i] = z[i] + beta*p[i]; }"))
    def direction_span(z_: field, p_: field, beta: real, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(
        flat(
            """const auto *p = p_.data, *q = q_.data; auto *x = x_.data, *r = r_.data; double s = 0;
        EACH { const auto v = r[i] - alpha*q[i]; x[i] += alpha*p[i]; r[i] = v; s += (double)v*v; }
        return s;"""
        )
    )
    def update_span(
        p_: field, q_: field, x_: field, r_: field, alpha: real, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.float64: ...

    @wp.kernel(enable_backward=False, module=name)
    def direction(z: field, p: field, scalars: f64, n: int, chunk: int, stride: wp.int64):
        t = wp.tid()
        beta = wp.float64(0.0)
        if scalars[RZ_OLD] > wp.float64(0.0):
            beta = scalars[RZ] / scalars[RZ_OLD]
        direction_span(z, p, real(beta), span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def update(p: field, q: field, x: field, r: field, scalars: f64, n: int, chunk: int, stride: wp.int64, partials: f64):
        t = wp.tid()
        alpha = wp.float64(0.0)
        if scalars[PQ] > wp.float64(0.0):
            alpha = scalars[RZ] / scalars[PQ]
        partials[t] = update_span(p, q, x, r, real(alpha), span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(direction=direction, update=update)


@wp.kernel(enable_backward=False, module="warp_lcp.conjugate_gradient")
def remember_kernel(scalars: wp.array(dtype=wp.float64)):
    """The old r.z, for beta."""
    scalars[RZ_OLD] = scalars[RZ]


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
