# mypy: ignore-errors
"""Kernels of subspace minimization: the free set by x, the right-hand side, the projected step."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)


@wp.func_native(
    flat(
        """const double *x = x_.data, *l = l_.data, *u = u_.data; const auto* m = m_.data; unsigned char* f = f_.data;
    double moved = 0, held = 0;
    EACH { const bool inside = m[i] == 1, now = inside & (x[i] > l[i]) & (x[i] < u[i]);
        moved += now != (f[i] != 0) ? 1.0 : 0.0; held += inside & !now ? 1.0 : 0.0; f[i] = now; }
    return wp::vec2d(moved, held);"""
    )
)
def classify_span(x_: f64, l_: f64, u_: f64, m_: i8, f_: u8, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.vec2d: ...


@wp.kernel(enable_backward=False, module="warp_lcp.subspace_minimization")
def classify_kernel(x: f64, lower: f64, upper: f64, unknown: i8, free: u8, n: int, chunk: int, stride: wp.int64, threads: int, sums: f64):
    """Free is what lies between its bounds ([Book] eq. 2.92); counts of unknowns that moved, and of those that are held."""
    t = wp.tid()
    v = classify_span(x, lower, upper, unknown, free, span_start(t, chunk), span_end(t, chunk, n), stride)
    sums[t] = v[0]
    sums[threads + t] = v[1]


@wp.func_native(
    flat("const double* y = y_.data; const unsigned char* f = f_.data; double s = 0; EACH { s += f[i] ? y[i]*y[i] : 0.0; } return s;")
)
def free_square_span(y_: f64, f_: u8, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...


@wp.kernel(enable_backward=False, module="warp_lcp.subspace_minimization")
def free_square_kernel(y: f64, free: u8, n: int, chunk: int, stride: wp.int64, out: f64):
    """Partial sums of y.y over the free set."""
    t = wp.tid()
    out[t] = free_square_span(y, free, span_start(t, chunk), span_end(t, chunk, n), stride)


@wp.kernel(enable_backward=False, module="warp_lcp.subspace_minimization")
def follow_kernel(old_lower: f64, old_upper: f64, lower: f64, upper: f64, x: f64):
    """Move x with bounds that have moved: what was at one stays at it, the rest is projected."""
    i = wp.tid()
    value = wp.clamp(x[i], lower[i], upper[i])
    if old_lower[i] != lower[i] and x[i] <= old_lower[i]:
        value = lower[i]
    if old_upper[i] != upper[i] and x[i] >= old_upper[i]:
        value = upper[i]
    x[i] = value


@functools.cache
def kernels(real: Any) -> SimpleNamespace:
    """Return the kernels for corrections of type real."""
    name = f"warp_lcp.subspace_minimization.{real.__name__}"
    field = wp.array(dtype=real)

    @wp.func_native(
        flat("const double *y = y_.data; const unsigned char* f = f_.data; auto* r = r_.data; EACH { r[i] = f[i] ? -y[i]*scale : 0.0; }")
    )
    def right_side_span(y_: f64, f_: u8, r_: field, scale: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(
        flat(
            """const double *x = x_.data, *l = l_.data, *u = u_.data; const auto* e = e_.data; double* o = o_.data;
        EACH { const double v = x[i] + scale*(double)e[i], w = v < l[i] ? l[i] : v; o[i] = e[i] == 0 ? x[i] : (w > u[i] ? u[i] : w); }"""
        )
    )
    def correct_span(
        x_: f64, e_: field, l_: f64, u_: f64, o_: f64, scale: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64
    ): ...

    @wp.kernel(enable_backward=False, module=name)
    def right_side(y: f64, free: u8, scale: wp.float64, r: field, n: int, chunk: int, stride: wp.int64):
        """R = -scale y on the free set, 0 off it."""
        t = wp.tid()
        right_side_span(y, free, r, scale, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def correct(x: f64, e: field, lower: f64, upper: f64, scale: wp.float64, out: f64, n: int, chunk: int, stride: wp.int64):
        """Out = clip(x + scale e)."""
        t = wp.tid()
        correct_span(x, e, lower, upper, out, scale, span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(right_side=right_side, correct=correct)
