# mypy: ignore-errors
"""Kernels of the nonsmooth nonlinear conjugate gradient method."""

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start

f64, i8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8)


@wp.func_native(
    flat(
        """const double* x = x_.data; const auto* m = m_.data; double* g = g_.data; double s = 0;
    EACH { const double v = m[i] == 1 ? g[i] - x[i] : 0.0; g[i] = v; s += v*v; } return s;"""
    )
)
def gradient_span(x_: f64, m_: i8, g_: f64, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...


@wp.kernel(enable_backward=False, module="warp_lcp.nncg")
def gradient_kernel(x: f64, unknown: i8, g: f64, n: int, chunk: int, stride: wp.int64, out: f64):
    """G holds x before the sweep; it becomes the gradient, what the sweep took away."""
    t = wp.tid()
    out[t] = gradient_span(x, unknown, g, span_start(t, chunk), span_end(t, chunk, n), stride)


@wp.func_native(
    flat(
        """const double *g = g_.data, *l = l_.data, *u = u_.data; const auto* m = m_.data; double *x = x_.data, *p = p_.data;
    EACH { const double q = beta*p[i], v = x[i] + q, w = v < l[i] ? l[i] : v, c = w > u[i] ? u[i] : w;
        x[i] = m[i] == 1 ? c : x[i]; p[i] = m[i] == 1 ? q - keep*g[i] : 0.0; }"""
    )
)
def direction_span(
    g_: f64, l_: f64, u_: f64, m_: i8, beta: wp.float64, keep: wp.float64, x_: f64, p_: f64, start: wp.int64, end: wp.int64,
    stride: wp.int64,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.nncg")
def direction_kernel(scalars: f64, g: f64, lower: f64, upper: f64, unknown: i8, x: f64, p: f64, n: int, chunk: int, stride: wp.int64):
    """Restart where the gradient has grown, else x += beta p and p = beta p - g; scalars: gradient squared now, before (0: none)."""
    t = wp.tid()
    beta = wp.float64(0.0)
    keep = wp.float64(1.0)
    if scalars[1] > wp.float64(0.0):
        beta = scalars[0] / scalars[1]
        if beta > wp.float64(1.0):
            beta = wp.float64(0.0)
            keep = wp.float64(0.0)
    direction_span(g, lower, upper, unknown, beta, keep, x, p, span_start(t, chunk), span_end(t, chunk, n), stride)
