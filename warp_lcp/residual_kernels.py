# mypy: ignore-errors
"""Kernels of the natural residual, in float64."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start


@functools.cache
def kernels(d_type: Any) -> SimpleNamespace:
    """Return the kernels for a diagonal of this type."""
    name = f"warp_lcp.residual.{d_type.__name__}"
    f64, i8, d_array = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=d_type)

    @wp.func_native(
        flat(
            """const double *x = x_.data, *y = y_.data, *l = l_.data, *u = u_.data; const auto* d = d_.data; const auto* m = m_.data;
        double s = 0;
        EACH {
            const double a = unit*(double)d[i], b = a < 0 ? -a : a, e = b == 0 ? 1.0 : b, v = x[i] - y[i]/e;
            const double w = v < l[i] ? l[i] : v, c = w > u[i] ? u[i] : w, r = m[i] == 1 ? e*(x[i] - c) : 0.0;
            s += r*r; }
        return s;"""
        )
    )
    def natural_span(
        x_: f64, y_: f64, d_: d_array, unit: wp.float64, l_: f64, u_: f64, m_: i8, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.float64: ...

    @wp.kernel(enable_backward=False, module=name)
    def natural(
        x: f64, y: f64, d: d_array, unit: wp.float64, lower: f64, upper: f64, unknown: i8, n: int, chunk: int, stride: wp.int64, out: f64
    ):
        t = wp.tid()
        out[t] = natural_span(x, y, d, unit, lower, upper, unknown, span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(natural=natural)


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def masked_square_kernel(
    b: wp.array(dtype=wp.float64),
    unknown: wp.array(dtype=wp.int8),
    n: int,
    chunk: int,
    stride: wp.int64,
    out: wp.array(dtype=wp.float64),
):
    """Partial sums of b.b over the unknowns."""
    t = wp.tid()
    s = wp.float64(0.0)
    i = span_start(t, chunk)
    end = span_end(t, chunk, n)
    while i < end:
        if unknown[i] == wp.int8(1):
            s += b[i] * b[i]
        i += stride
    out[t] = s


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def start_kernel(
    x: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    unknown: wp.array(dtype=wp.int8),
    keep: bool,
):
    """Clip(x, l, u), or clip(0, l, u), on the unknowns; 0 elsewhere."""
    i = wp.tid()
    v = wp.float64(0.0)
    if unknown[i] == wp.int8(1):
        if keep:
            v = x[i]
        v = wp.min(wp.max(v, lower[i]), upper[i])
    x[i] = v


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def add_kernel(b: wp.array(dtype=wp.float64), y: wp.array(dtype=wp.float64)):
    """Y += b."""
    i = wp.tid()
    y[i] = y[i] + b[i]
