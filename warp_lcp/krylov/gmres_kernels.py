# mypy: ignore-errors
"""Kernels of GMRES: the residual, weighted, and weighting alone."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start


@functools.cache
def kernels(real: Any) -> SimpleNamespace:
    """Return the kernels for fields of this type."""
    name, field = f"warp_lcp.gmres.{real.__name__}", wp.array(dtype=real)

    @wp.func_native(
        flat(
            """const auto *b = b_.data, *q = q_.data, *w = w_.data; auto* o = o_.data;
        if (w) { EACH { o[i] = sqrt(w[i])*(b[i] - q[i]); } } else { EACH { o[i] = b[i] - q[i]; } }"""
        )
    )
    def residual_span(b_: field, q_: field, w_: field, o_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(
        flat(
            """const auto* w = w_.data; auto* q = q_.data;
        if (inverse) { EACH { q[i] = w[i] > 0 ? q[i]/sqrt(w[i]) : 0; } } else { EACH { q[i] *= sqrt(w[i]); } }"""
        )
    )
    def weigh_span(w_: field, inverse: bool, q_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(flat("const auto* z = z_.data; auto* x = x_.data; EACH { x[i] += z[i]; }"))
    def increase_span(z_: field, x_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.kernel(enable_backward=False, module=name)
    def residual(b: field, q: field, w: field, out: field, n: int, chunk: int, stride: wp.int64):
        """Out = w^(1/2) (b - q); an empty w is 1."""
        t = wp.tid()
        residual_span(b, q, w, out, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def weigh(w: field, inverse: bool, q: field, n: int, chunk: int, stride: wp.int64):
        """Q = w^(1/2) q, or w^(-1/2) q."""
        t = wp.tid()
        weigh_span(w, inverse, q, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def increase(z: field, x: field, n: int, chunk: int, stride: wp.int64):
        """X += z."""
        t = wp.tid()
        increase_span(z, x, span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(residual=residual, weigh=weigh, increase=increase)
