# mypy: ignore-errors
"""Kernels that check a problem's data."""

import warp as wp

from warp_lcp.vector_kernels import CODED, flat, span_end, span_start

CHECK = flat(
    CODED
    + """
    double bad = 0, nan_l = 0, nan_u = 0, crossed = 0, no_l = 0, no_u = 0; const double* b = b_.data; const auto* m = m_.data;
    const double inf = (double)INFINITY;
    with_bounds([&](auto lower, auto upper) {
        EACH {
            const double l = lower(i), u = upper(i), one = m[i] == 1 ? 1.0 : 0.0, v = b[i] - b[i];
            bad += v == 0 ? 0.0 : one; nan_l += l == l ? 0.0 : one; nan_u += u == u ? 0.0 : one;
            crossed += l > u ? one : 0.0; no_l += l == inf ? one : 0.0; no_u += u == -inf ? one : 0.0; } });
    const double counts[6] = {bad, nan_l, nan_u, crossed, no_l, no_u};
    for (int c = 0; c < 6; ++c) out.data[c*threads + t] = counts[c];"""
)


@wp.func_native(CHECK)
def check_span(
    b_: wp.array(dtype=wp.float64),
    l_: wp.array(dtype=wp.float64),
    l_value: wp.float64,
    u_: wp.array(dtype=wp.float64),
    u_value: wp.float64,
    code_: wp.array(dtype=wp.uint8),
    m_: wp.array(dtype=wp.int8),
    start: wp.int64,
    end: wp.int64,
    stride: wp.int64,
    threads: int,
    t: int,
    out: wp.array(dtype=wp.float64),
): ...


@wp.kernel(enable_backward=False, module="warp_lcp.problem")
def check_kernel(
    b: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    lower_value: wp.float64,
    upper: wp.array(dtype=wp.float64),
    upper_value: wp.float64,
    code: wp.array(dtype=wp.uint8),
    unknown: wp.array(dtype=wp.int8),
    n: int,
    chunk: int,
    stride: wp.int64,
    threads: int,
    out: wp.array(dtype=wp.float64),
):
    """Count non-finite b, NaN bounds, crossed bounds, l = inf and u = -inf among the unknowns, by threads."""
    t = wp.tid()
    start = span_start(t, chunk)
    end = span_end(t, chunk, n)
    check_span(b, lower, lower_value, upper, upper_value, code, unknown, start, end, stride, threads, t, out)
