# mypy: ignore-errors
"""Kernels of the minimum-map Newton method: active set, right-hand side, gaps to the bounds, projected correction."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.multigrid.coarsen_kernels import UNBOUNDED
from warp_lcp.vector_kernels import flat, span_end, span_start

BIG = wp.constant(wp.float64(UNBOUNDED))


@functools.cache
def kernels(d_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels for a diagonal of type d_type and corrections of type real."""
    name = f"warp_lcp.minimum_map_newton.{d_type.__name__}_{real.__name__}"
    f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    @wp.func_native(
        flat(
            """const double *y = y_.data, *l = l_.data, *u = u_.data; const auto* d = d_.data; const auto* m = m_.data;
        double* x = x_.data; unsigned char* f = f_.data; double moved = 0, active = 0;
        EACH {
            const double a = unit*(double)d[i], b = a < 0 ? -a : a, e = b == 0 ? 1.0 : b, v = x[i] - y[i]/e;
            const bool low = v < l[i], high = v > u[i], inside = m[i] == 1, held = inside & (low | high);
            const unsigned char now = inside & !held;
            x[i] = held ? (low ? l[i] : u[i]) : x[i];
            moved += now != f[i] ? 1.0 : 0.0; active += held ? 1.0 : 0.0; f[i] = now; }
        return wp::vec2d(moved, active);"""
        )
    )
    def classify_span(
        x_: f64, y_: f64, d_: d_array, unit: wp.float64, l_: f64, u_: f64, m_: i8, f_: u8, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.vec2d: ...

    @wp.func_native(
        flat(
            """const double *y = y_.data; const unsigned char* f = f_.data; double s = 0;
        EACH { const double v = f[i] ? y[i] : 0.0; s += v*v; } return s;"""
        )
    )
    def free_square_span(y_: f64, f_: u8, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...

    @wp.func_native(
        flat("const double *y = y_.data; const unsigned char* f = f_.data; auto* r = r_.data; EACH { r[i] = f[i] ? -y[i]*scale : 0.0; }")
    )
    def right_side_span(y_: f64, f_: u8, r_: field, scale: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(
        flat(
            """const double *x = x_.data, *l = l_.data, *u = u_.data; const auto* m = m_.data; auto *lo = lo_.data, *hi = hi_.data;
        EACH {
            const double a = (l[i] - x[i])*scale, b = (u[i] - x[i])*scale;
            lo[i] = m[i] == 1 ? (a < -big ? -big : (a > 0 ? 0.0 : a)) : 0.0;
            hi[i] = m[i] == 1 ? (b > big ? big : (b < 0 ? 0.0 : b)) : 0.0; }"""
        )
    )
    def gaps_span(
        x_: f64, l_: f64, u_: f64, m_: i8, lo_: field, hi_: field, scale: wp.float64, big: wp.float64, start: wp.int64, end: wp.int64,
        stride: wp.int64,
    ): ...  # fmt: skip

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
    def classify(
        x: f64, y: f64, d: d_array, unit: wp.float64, lower: f64, upper: f64, unknown: i8, free: u8, n: int, chunk: int, stride: wp.int64,
        threads: int, sums: f64,
    ):  # fmt: skip
        t = wp.tid()
        v = classify_span(x, y, d, unit, lower, upper, unknown, free, span_start(t, chunk), span_end(t, chunk, n), stride)
        sums[t] = v[0]
        sums[threads + t] = v[1]

    @wp.kernel(enable_backward=False, module=name)
    def free_square(y: f64, free: u8, n: int, chunk: int, stride: wp.int64, out: f64):
        t = wp.tid()
        out[t] = free_square_span(y, free, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def right_side(y: f64, free: u8, scale: wp.float64, r: field, n: int, chunk: int, stride: wp.int64):
        t = wp.tid()
        right_side_span(y, free, r, scale, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def gaps(x: f64, lower: f64, upper: f64, unknown: i8, scale: wp.float64, lo: field, hi: field, n: int, chunk: int, stride: wp.int64):
        t = wp.tid()
        gaps_span(x, lower, upper, unknown, lo, hi, scale, BIG, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def correct(x: f64, e: field, lower: f64, upper: f64, scale: wp.float64, out: f64, n: int, chunk: int, stride: wp.int64):
        t = wp.tid()
        correct_span(x, e, lower, upper, out, scale, span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(classify=classify, free_square=free_square, right_side=right_side, gaps=gaps, correct=correct)


@wp.func_native(flat("EACH { free.data[i] = unknown.data[i] == 1; }"))
def all_free_span(unknown: wp.array(dtype=wp.int8), free: wp.array(dtype=wp.uint8), start: wp.int64, end: wp.int64, stride: wp.int64): ...


@wp.kernel(enable_backward=False, module="warp_lcp.minimum_map_newton")
def all_free_kernel(unknown: wp.array(dtype=wp.int8), free: wp.array(dtype=wp.uint8), n: int, chunk: int, stride: wp.int64):
    """Every unknown is free."""
    t = wp.tid()
    all_free_span(unknown, free, span_start(t, chunk), span_end(t, chunk, n), stride)
