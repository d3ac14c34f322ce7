# mypy: ignore-errors
"""Kernels of the accelerated projected gradient method."""

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start

f64, i8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8)


@wp.func_native(
    flat(
        """const double *x = x_.data, *xo = xo_.data, *y = y_.data, *z = z_.data, *yz = yz_.data, *d = d_.data; const auto* m = m_.data;
    double curvature = 0, metric = 0, turned = 0, size = 0;
    EACH { const double one = m[i] == 1 ? 1.0 : 0.0, s = one*(x[i] - z[i]);
        curvature += s*(y[i] - yz[i]); metric += d[i]*s*s; turned -= d[i]*s*(x[i] - xo[i]); size += one*d[i]*x[i]*x[i]; }
    return wp::vec4d(curvature, metric, turned, size);"""
    )
)
def progress_span(
    x_: f64, xo_: f64, y_: f64, z_: f64, yz_: f64, d_: f64, m_: i8, start: wp.int64, end: wp.int64, stride: wp.int64
) -> wp.vec4d: ...


@wp.kernel(enable_backward=False, module="warp_lcp.accelerated_projected_gradient")
def progress_kernel(
    x: f64, x_old: f64, y: f64, z: f64, y_z: f64, d: f64, unknown: i8, n: int, chunk: int, stride: wp.int64, threads: int, out: f64
):
    """Partial sums of s.(y - y_z), s.D s, -s.D (x - x_old) and x.D x with s = x - z."""
    t = wp.tid()
    v = progress_span(x, x_old, y, z, y_z, d, unknown, span_start(t, chunk), span_end(t, chunk, n), stride)
    for c in range(4):
        out[c * threads + t] = v[c]


@wp.func_native(
    flat(
        """const double *y = y_.data, *d = d_.data, *l = l_.data, *u = u_.data; const auto* m = m_.data;
    double *x = x_.data, *xo = xo_.data, *yo = yo_.data, *z = z_.data, *yz = yz_.data;
    EACH { const double a = x[i] + beta*(x[i] - xo[i]), b = y[i] + beta*(y[i] - yo[i]), v = a - b/(lipschitz*d[i]);
        const double w = v < l[i] ? l[i] : v, c = w > u[i] ? u[i] : w;
        xo[i] = x[i]; yo[i] = y[i]; z[i] = a; yz[i] = b; x[i] = m[i] == 1 ? c : x[i]; }"""
    )
)
def advance_span(
    y_: f64, d_: f64, l_: f64, u_: f64, m_: i8, beta: wp.float64, lipschitz: wp.float64, x_: f64, xo_: f64, yo_: f64, z_: f64, yz_: f64,
    start: wp.int64, end: wp.int64, stride: wp.int64,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.accelerated_projected_gradient")
def advance_kernel(
    y: f64, d: f64, lower: f64, upper: f64, unknown: i8, beta: wp.float64, lipschitz: wp.float64, x: f64, x_old: f64, y_old: f64, z: f64,
    y_z: f64, n: int, chunk: int, stride: wp.int64,
):  # fmt: skip
    """Extrapolate x and y to z and y_z, and take the projected gradient step from there."""
    t = wp.tid()
    start = span_start(t, chunk)
    advance_span(y, d, lower, upper, unknown, beta, lipschitz, x, x_old, y_old, z, y_z, start, span_end(t, chunk, n), stride)
