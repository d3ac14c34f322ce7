# mypy: ignore-errors
"""Vector updates of conjugate gradients; their scalars stay on the device."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start

RZ = wp.constant(0)  # slots of the device scalars
PQ = wp.constant(1)
RR = wp.constant(2)
RZ_OLD = wp.constant(3)
TOLERANCE = wp.constant(4)
BEST = wp.constant(5)  # the least norm so far
ITERATIONS = wp.constant(6)  # done, and the most allowed
LIMIT = wp.constant(7)
SLOTS = 8

GROWTH = wp.constant(wp.float64(1e3))  # of the carried residual over its least: A or M is not positive definite to this precision


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

    @wp.func_native(
        flat(
            """const auto *p = p_.data, *q = q_.data, *w = w_.data; auto *x = x_.data, *r = r_.data; double s = 0;
        EACH { const auto v = r[i] - alpha*q[i]; x[i] += alpha*p[i]; r[i] = v; s += (double)w[i]*v*v; }
        return s;"""
        )
    )
    def update_weighted_span(
        p_: field, q_: field, x_: field, r_: field, w_: field, alpha: real, start: wp.int64, end: wp.int64, stride: wp.int64
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

    @wp.kernel(enable_backward=False, module=name)
    def update_weighted(
        p: field, q: field, x: field, r: field, scalars: f64, w: field, n: int, chunk: int, stride: wp.int64, partials: f64
    ):
        t = wp.tid()
        alpha = wp.float64(0.0)
        if scalars[PQ] > wp.float64(0.0):
            alpha = scalars[RZ] / scalars[PQ]
        partials[t] = update_weighted_span(p, q, x, r, w, real(alpha), span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(direction=direction, update=update, update_weighted=update_weighted)


@wp.kernel(enable_backward=False, module="warp_lcp.conjugate_gradient")
def begin_kernel(scalars: wp.array(dtype=wp.float64), going: wp.array(dtype=int), tolerance: wp.float64, limit: int):
    """Before the first iteration: no old direction, no norm yet."""
    scalars[RZ_OLD] = wp.float64(0.0)
    scalars[RR] = wp.float64(wp.inf)
    scalars[BEST] = wp.float64(wp.inf)
    scalars[TOLERANCE] = tolerance
    scalars[ITERATIONS] = wp.float64(0.0)
    scalars[LIMIT] = wp.float64(limit)
    going[0] = wp.where(limit > 0, 1, 0)


@wp.kernel(enable_backward=False, module="warp_lcp.conjugate_gradient")
def end_kernel(scalars: wp.array(dtype=wp.float64), going: wp.array(dtype=int)):
    """After an iteration: remember r.z for beta, and decide whether to go on."""
    scalars[RZ_OLD] = scalars[RZ]
    scalars[ITERATIONS] += wp.float64(1.0)
    norm = wp.sqrt(scalars[RR])
    enough = norm <= scalars[TOLERANCE] or norm >= GROWTH * scalars[BEST] or scalars[ITERATIONS] >= scalars[LIMIT]
    going[0] = wp.where(enough or not wp.isfinite(norm), 0, 1)
    scalars[BEST] = wp.min(scalars[BEST], norm)
