# mypy: ignore-errors
"""Kernels of the natural residual, in float64."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.vector_kernels import CODED, flat, span_end, span_start

f64 = wp.array(dtype=wp.float64)
i8, u8 = wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)

# r = d (x - clip(x - y/d, l, u)) = max(d (x - u), min(d (x - l), y)): no division, and a NaN in y stays one;
# 0 x makes NaN of an x that is not finite where its column of A is empty, so that y says nothing of it
NATURAL = """const double a_ = unit*(double)d[i], b_ = a_ < 0 ? -a_ : a_, e = b_ == 0 ? 1.0 : b_;
            const double below = e*(x[i] - lower(i)), above = e*(x[i] - upper(i));
            const double least = below < y[i] ? below : y[i], r0 = above > least ? above : least, r = m[i] == 1 ? r0 + 0.0*x[i] : 0.0;"""


@functools.cache
def kernels(d_type: Any) -> SimpleNamespace:
    """Return the kernels for a diagonal of this type."""
    name = f"warp_lcp.residual.{d_type.__name__}"
    d_array = wp.array(dtype=d_type)

    @wp.func_native(
        flat(
            CODED
            + f"""const double *x = x_.data, *y = y_.data; const auto* d = d_.data; const auto* m = m_.data; double s = 0;
        with_bounds([&](auto lower, auto upper) {{ EACH {{ {NATURAL} s += r*r; }} }});
        return s;"""
        )
    )
    def natural_span(
        x_: f64, y_: f64, d_: d_array, unit: wp.float64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, m_: i8,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ) -> wp.float64: ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def natural(
        x: f64, y: f64, d: d_array, unit: wp.float64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64,
        code: u8, unknown: i8, n: int, chunk: int, stride: wp.int64, out: f64,
    ):  # fmt: skip
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        out[t] = natural_span(x, y, d, unit, lower, lower_value, upper, upper_value, code, unknown, start, end, stride)

    return SimpleNamespace(natural=natural)


@wp.func_native(
    flat("double s = 0; const double* b = b_.data; const auto* m = m_.data; EACH { s += m[i] == 1 ? b[i]*b[i] : 0.0; } return s;")
)
def masked_square_span(b_: f64, m_: i8, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def masked_square_kernel(b: f64, unknown: i8, n: int, chunk: int, stride: wp.int64, out: f64):
    """Partial sums of b.b over the unknowns."""
    t = wp.tid()
    out[t] = masked_square_span(b, unknown, span_start(t, chunk), span_end(t, chunk, n), stride)


@wp.func_native(
    flat(
        CODED
        + """double* x = x_.data; const auto* m = m_.data;
    with_bounds([&](auto lower, auto upper) {
        EACH { const double v = keep ? x[i] : 0.0, l = lower(i), u = upper(i), w = v < l ? l : v, c = w > u ? u : w;
            x[i] = m[i] == 1 ? c : 0.0; } });"""
    )
)
def start_span(
    x_: f64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, m_: i8, keep: bool, start: wp.int64,
    end: wp.int64, stride: wp.int64,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def start_kernel(
    x: f64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, keep: bool, n: int,
    chunk: int, stride: wp.int64,
):  # fmt: skip
    """clip(x, l, u), or clip(0, l, u), on the unknowns; 0 elsewhere."""
    t = wp.tid()
    start = span_start(t, chunk)
    start_span(x, lower, lower_value, upper, upper_value, code, unknown, keep, start, span_end(t, chunk, n), stride)


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def add_kernel(b: f64, y: f64):
    """Y += b."""
    i = wp.tid()
    y[i] = y[i] + b[i]


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def settle_isolated_kernel(d: wp.array(dtype=Any), b: f64, lower: f64, upper: f64, unknown: wp.array(dtype=wp.int8), x: f64):
    """Unknowns with an empty row: y = b, so x is the bound that b's sign asks for."""
    i = wp.tid()
    if unknown[i] == wp.int8(1):
        if d[i] == d.dtype(0):
            bound = lower[i]
            if b[i] < wp.float64(0.0):
                bound = upper[i]
            if b[i] != wp.float64(0.0) and wp.abs(bound) < wp.float64(1.0e300):
                x[i] = bound


for _T in (wp.uint8, wp.float32, wp.float64):
    wp.overload(settle_isolated_kernel, [wp.array(dtype=_T), f64, f64, f64, i8, f64])
