# mypy: ignore-errors
"""Kernels of the minimum-map Newton method: active set, right-hand side, gaps to the bounds, projected correction."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.multigrid.coarsen_kernels import UNBOUNDED
from warp_lcp.vector_kernels import CODED, flat, span_end, span_start

BIG = wp.constant(wp.float64(UNBOUNDED))


@functools.cache
def kernels(d_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels for a diagonal of type d_type and corrections of type real."""
    name = f"warp_lcp.minimum_map_newton.{d_type.__name__}_{real.__name__}"
    f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    @wp.func_native(
        flat(
            CODED
            + """const double* y = y_.data; const auto* d = d_.data; const auto* m = m_.data; auto* r = r_.data;
        double* x = x_.data; unsigned char* f = f_.data; double moved = 0, active = 0, shifted = 0, s = 0;
        with_bounds([&](auto lower, auto upper) { EACH {
            const double a = unit*(double)d[i], b = a < 0 ? -a : a, e = b == 0 ? 1.0 : b, v = x[i] - y[i]/e, l = lower(i), u = upper(i);
            const bool low = v < l, high = v > u, inside = m[i] == 1, held = inside & (low | high);
            const unsigned char now = inside & !held;
            const double at = held ? (low ? l : u) : x[i], g = now ? y[i] : 0.0;
            shifted += at != x[i] ? 1.0 : 0.0; x[i] = at; r[i] = -g*scale; s += g*g;
            moved += now != f[i] ? 1.0 : 0.0; active += held ? 1.0 : 0.0; f[i] = now; } });
        return wp::vec4d(moved, active, shifted, s);"""
        )
    )
    def classify_span(
        x_: f64, y_: f64, d_: d_array, unit: wp.float64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, m_: i8,
        f_: u8, r_: field, scale: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ) -> wp.vec4d: ...  # fmt: skip

    @wp.func_native(
        flat(
            """const double* y = y_.data; const unsigned char* f = f_.data; auto* r = r_.data; double s = 0;
        EACH { const double g = f[i] ? y[i] : 0.0; r[i] = -g*scale; s += g*g; } return s;"""
        )
    )
    def right_side_span(y_: f64, f_: u8, r_: field, scale: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...

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
            CODED
            + """const double* b = b_.data; const auto* e = e_.data; double *o = o_.data, *k = k_.data;
        const bool keep = k_.data != nullptr;
        with_bounds([&](auto lower, auto upper) {
            auto moved = [&](double from, double by, double l, double u) {
                const double v = from + scale*by, w = v < l ? l : v; return by == 0 ? from : (w > u ? u : w); };
            if (keep) { EACH { const double from = b[i]; k[i] = from; o[i] = moved(from, (double)e[i], lower(i), upper(i)); } }
            else { EACH { o[i] = moved(b[i], (double)e[i], lower(i), upper(i)); } } });"""
        )
    )
    def correct_span(
        b_: f64, e_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, o_: f64, k_: f64, scale: wp.float64,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def classify(
        x: f64, y: f64, d: d_array, unit: wp.float64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8,
        unknown: i8, free: u8, r: field, scale: wp.float64, n: int, chunk: int, stride: wp.int64, threads: int, sums: f64,
    ):  # fmt: skip
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        v = classify_span(
            x, y, d, unit, lower, lower_value, upper, upper_value, code, unknown, free, r, scale, start, end, stride
        )  # fmt: skip
        for k in range(4):
            sums[k * threads + t] = v[k]

    @wp.kernel(enable_backward=False, module=name)
    def right_side(y: f64, free: u8, r: field, scale: wp.float64, n: int, chunk: int, stride: wp.int64, out: f64):
        t = wp.tid()
        out[t] = right_side_span(y, free, r, scale, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def gaps(x: f64, lower: f64, upper: f64, unknown: i8, scale: wp.float64, lo: field, hi: field, n: int, chunk: int, stride: wp.int64):
        t = wp.tid()
        gaps_span(x, lower, upper, unknown, lo, hi, scale, BIG, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def correct(
        base: f64, e: field, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, out: f64, kept: f64,
        scale: wp.float64, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        """Out = base + scale e within the bounds where e is not 0; base is copied to `kept` unless that is empty."""
        t = wp.tid()
        start = span_start(t, chunk)
        correct_span(base, e, lower, lower_value, upper, upper_value, code, out, kept, scale, start, span_end(t, chunk, n), stride)

    return SimpleNamespace(classify=classify, right_side=right_side, gaps=gaps, correct=correct)


@wp.func_native(flat("EACH { free.data[i] = unknown.data[i] == 1; }"))
def all_free_span(unknown: wp.array(dtype=wp.int8), free: wp.array(dtype=wp.uint8), start: wp.int64, end: wp.int64, stride: wp.int64): ...


@wp.kernel(enable_backward=False, module="warp_lcp.minimum_map_newton")
def all_free_kernel(unknown: wp.array(dtype=wp.int8), free: wp.array(dtype=wp.uint8), n: int, chunk: int, stride: wp.int64):
    """Every unknown is free."""
    t = wp.tid()
    all_free_span(unknown, free, span_start(t, chunk), span_end(t, chunk, n), stride)
