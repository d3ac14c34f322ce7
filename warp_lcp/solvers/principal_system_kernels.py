# mypy: ignore-errors
"""Kernels of the principal systems: masks, shifts, diagonal preconditioners, weighted norms."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES
from warp_lcp.vector_kernels import flat, span_end, span_start

F64, U8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.uint8)


@wp.kernel(enable_backward=False, module="warp_lcp.principal_system")
def mask_kernel(
    free: wp.array(dtype=wp.uint8), shift: wp.array(dtype=wp.float64), p: wp.array(dtype=wp.float64), q: wp.array(dtype=wp.float64)
):
    """Q += D p on the free set, 0 off it; an empty shift is 0."""
    i = wp.tid()
    v = wp.float64(0.0)
    if free[i] != wp.uint8(0):
        v = q[i]
        if shift.shape[0] > 0:
            v += shift[i] * p[i]
    q[i] = v


@wp.kernel(enable_backward=False, module="warp_lcp.principal_system")
def divide_kernel(r: wp.array(dtype=wp.float64), d: wp.array(dtype=wp.float64), z: wp.array(dtype=wp.float64)):
    """Z = r / d, r where d is 0."""
    i = wp.tid()
    v = r[i]
    if d[i] != wp.float64(0.0):
        v = r[i] / d[i]
    z[i] = v


@functools.cache
def shift_kernel(d_type: Any, real: Any) -> Any:
    """Return the kernel that writes a masked, shifted diagonal of type real, and its reciprocal.

    out = unit d + D on the free set, 0 elsewhere; weight = 1 / |out|, 1 where that is 0, 0 off the free set. An empty D is 0.
    """
    d_array, field, T = wp.array(dtype=d_type), wp.array(dtype=real), C_TYPES[real]

    @wp.func_native(
        flat(
            f"""const auto *d = d_.data; const unsigned char* f = f_.data; const double* s = s_.data; {T} *o = o_.data, *w = w_.data;
        if (s) {{ EACH {{ o[i] = f[i] ? ({T})(unit*(double)d[i] + s[i]) : ({T})0; }} }}
        else {{ EACH {{ o[i] = f[i] ? ({T})(unit*(double)d[i]) : ({T})0; }} }}
        EACH {{ const {T} a = o[i] < 0 ? -o[i] : o[i]; w[i] = a > 0 ? ({T})1/a : ({T})(f[i] != 0); }}"""
        )
    )
    def shift_span(
        d_: d_array, unit: wp.float64, f_: U8, s_: F64, o_: field, w_: field, start: wp.int64, end: wp.int64, stride: wp.int64
    ): ...

    @wp.kernel(enable_backward=False, module=f"warp_lcp.principal_system.shift_{d_type.__name__}_{real.__name__}")
    def shift(d: d_array, unit: wp.float64, free: U8, shift: F64, out: field, weight: field, n: int, chunk: int, stride: wp.int64):
        t = wp.tid()
        shift_span(d, unit, free, shift, out, weight, span_start(t, chunk), span_end(t, chunk, n), stride)

    return shift


@functools.cache
def kernels(real: Any) -> SimpleNamespace:
    """Return the kernels for fields of this type."""
    name, field = f"warp_lcp.principal_system.{real.__name__}", wp.array(dtype=real)

    @wp.func_native(flat("const auto *r = r_.data, *w = w_.data; double s = 0; EACH { s += (double)w[i]*r[i]*r[i]; } return s;"))
    def weighted_square_span(r_: field, w_: field, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...

    @wp.func_native(
        flat(
            """const auto* s = s_.data; const unsigned char* f = f_.data; auto* q = q_.data;
        EACH { q[i] = f[i] ? q[i] + s[i] : 0; }"""
        )
    )
    def add_free_span(s_: field, f_: U8, q_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.kernel(enable_backward=False, module=name)
    def weighted_square(r: field, w: field, n: int, chunk: int, stride: wp.int64, out: F64):
        """Partial sums of w r^2."""
        t = wp.tid()
        out[t] = weighted_square_span(r, w, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def add_free(s: field, free: U8, q: field, n: int, chunk: int, stride: wp.int64):
        """Q += s on the free set, 0 off it."""
        t = wp.tid()
        add_free_span(s, free, q, span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(weighted_square=weighted_square, add_free=add_free)
