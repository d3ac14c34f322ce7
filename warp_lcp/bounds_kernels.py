# mypy: ignore-errors
"""Kernels that turn bounds into bytes and back."""

import warp as wp

from warp_lcp.native import simd
from warp_lcp.vector_kernels import flat, span_end, span_start

LOWER_IS_FINITE = wp.constant(1)
UPPER_IS_FINITE = wp.constant(2)

f64, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.uint8)


@wp.func_native(
    flat(
        """const double inf = (double)INFINITY; const double *l = l_.data, *u = u_.data; unsigned char* code = code_.data; double other = 0;
    const unsigned char lower = l_value > -inf, upper = u_value < inf ? 2 : 0;
    if (l && u) { EACH {
        const bool a = l[i] == l_value, b = u[i] == u_value;
        other += ((a | (l[i] == -inf)) & (b | (u[i] == inf))) ? 0.0 : 1.0; code[i] = (a ? 1 : 0) | (b ? 2 : 0); }
    } else if (l) { EACH { const bool a = l[i] == l_value; other += (a | (l[i] == -inf)) ? 0.0 : 1.0; code[i] = (a ? 1 : 0) | upper; }
    } else { EACH { const bool b = u[i] == u_value; other += (b | (u[i] == inf)) ? 0.0 : 1.0; code[i] = lower | (b ? 2 : 0); } }
    return other;"""
    )
)
def encode_span(
    l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, start: wp.int64, end: wp.int64, stride: wp.int64
) -> wp.float64: ...


@wp.kernel(enable_backward=False, module="warp_lcp.bounds")
def encode_kernel(
    lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, n: int, chunk: int, stride: wp.int64, out: f64
):
    """Write which bounds are finite, and count, by threads, elements with a finite bound that is not the given number, or a NaN."""
    t = wp.tid()
    start = span_start(t, chunk)
    out[t] = encode_span(lower, lower_value, upper, upper_value, code, start, span_end(t, chunk, n), stride)


@wp.func_native(
    simd(
        """const double* v = field_.data + row*n; unsigned char* code = code_.data + p; double other = 0;
    SIMD for (long long k = 0; k < n; ++k) {
        const bool a = v[k] == value, none = v[k] == infinite; other += (a | none) ? 0.0 : 1.0; code[k] += (a & !none) ? bit : 0; }
    return other;"""
    )
)
def encode_row(
    field_: f64, row: wp.int64, value: wp.float64, infinite: wp.float64, bit: int, code_: u8, p: wp.int64, n: wp.int64
) -> wp.float64: ...


@wp.kernel(enable_backward=False, module="warp_lcp.bounds")
def encode_rows_kernel(
    field: f64, value: wp.float64, infinite: wp.float64, bit: int, code: u8, first: wp.int64, s1: wp.int64, s2: wp.int64, n: wp.int64,
    out: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """The same for one side and a field without ghost cells, a row a thread; s1 and s2 are elements from plane to plane, row to row."""
    k, j = wp.tid()
    row = wp.int64(k) * wp.int64(out.shape[1]) + wp.int64(j)
    out[k, j] = encode_row(field, row, value, infinite, bit, code, first + wp.int64(k) * s1 + wp.int64(j) * s2, n)


@wp.kernel(enable_backward=False, module="warp_lcp.bounds")
def decode_kernel(code: u8, bit: int, value: wp.float64, infinite: wp.float64, out: f64):
    """The field of bounds that a code stands for."""
    i = wp.tid()
    out[i] = infinite
    if (int(code[i]) & bit) != 0:
        out[i] = value
