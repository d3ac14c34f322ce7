# mypy: ignore-errors
"""Kernels of the algebraic hierarchy: masking, products of sparse matrices into known patterns, sweeps, transfers, the coarsest level."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES
from warp_lcp.operators.sparse_kernels import INDICES, by_rows
from warp_lcp.vector_kernels import span_end, span_start

I64, U16, U8, F64 = wp.array(dtype=wp.int64), wp.array(dtype=wp.uint16), wp.array(dtype=wp.uint8), wp.array(dtype=wp.float64)
MATRIX = wp.array2d(dtype=wp.float64)

FILL = """typedef {T} T; const int *ptr = ptr_.data, *col = col_.data, *order = order_.data; const auto *a = a_.data, *d = d_.data;
const unsigned char* f = f_.data; const double* shift = shift_.data; T *m = m_.data, *inverse = inverse_.data, *s = s_.data, *w = w_.data;
ROWS {{
    const bool free = f[i]; const double extra = free && shift ? shift[i] : 0.0; double sum = 0, mid = 0;
    ENTRIES {{
        const int j = col[k], from = order ? order[k] : k;
        double v = (free && f[j] && from >= 0) ? (double)a[from] : 0.0;
        if (j == i) {{ v += extra; mid = v; }}
        m[k] = (T)v; sum += v < 0 ? -v : v; }}
    const double own = (double)d[i] < 0 ? -(double)d[i] : (double)d[i];
    inverse[i] = sum > 0 ? (T)(1.0/sum) : (T)0;
    if (s) s[i] = free ? (extra > 0 ? (T)(own/(own + extra)) : (T)1) : (T)0;
    if (w) w[i] = mid > 0 ? (T)(1.0/mid) : (mid < 0 ? (T)(-1.0/mid) : (T)(free ? 1 : 0)); }}"""

SCALE = """const int* ptr = ptr_.data; const auto *p = p_.data, *s = s_.data; auto* o = o_.data;
ROWS { const auto f = s[i]; ENTRIES o[k] = f*p[k]; }"""

MULTIPLY = """typedef {T} T; const int *ptr = ptr_.data, *col = col_.data, *right = right_ptr_.data, *out_ptr = out_ptr_.data;
const T *a = a_.data, *b = b_.data; const unsigned short* place = place_.data;
ROWS {{
    T* o = o_.data + out_ptr[i]; const int n = out_ptr[i + 1] - out_ptr[i]; long long c = start_.data[i];
    for (int q = 0; q < n; ++q) o[q] = 0;
    ENTRIES {{
        const T v = a[k]; const int begin = right[col[k]], length = right[col[k] + 1] - begin;
        if (v != 0) for (int q = 0; q < length; ++q) o[place[c + q]] += v*b[begin + q];
        c += length; }} }}"""

PLACES = """
const int *ptr = ptr_.data, *col = col_.data, *right = right_ptr_.data, *right_col = right_col_.data, *out = out_ptr_.data;
const int* out_col = out_col_.data; int* at = at_.data; unsigned short* place = place_.data; long long c = 0;
for (int i = 0; i < n; ++i) {
    for (int q = out[i]; q < out[i + 1]; ++q) at[out_col[q]] = q - out[i];
    for (int k = ptr[i]; k < ptr[i + 1]; ++k)
        for (int q = right[col[k]]; q < right[col[k] + 1]; ++q) place[c++] = (unsigned short)at[right_col[q]]; }
"""

INVERSE = """typedef {T} T; const int* ptr = ptr_.data; const T* a = a_.data;
ROWS {{ T s = 0; ENTRIES s += a[k] < 0 ? -a[k] : a[k]; inverse_.data[i] = s > 0 ? (T)1/s : (T)0; }}"""

SWEEP = """typedef {T} T; const int *ptr = ptr_.data, *col = col_.data; const T *a = a_.data, *x = x_.data, *b = b_.data;
const T *e = inverse_.data, w = omega; T* y = y_.data;
if (from_zero) {{ ROWS y[i] = w*e[i]*b[i]; }}
else {{ ROWS {{ T s = b[i]; ENTRIES s -= a[k]*x[col[k]]; y[i] = x[i] + w*e[i]*s; }} }}"""

RESIDUAL = """typedef {T} T; const int *ptr = ptr_.data, *col = col_.data; const T *a = a_.data, *x = x_.data, *b = b_.data; T* y = y_.data;
ROWS {{ T s = b[i]; ENTRIES s -= a[k]*x[col[k]]; y[i] = s; }}"""

TRANSFER = """typedef {T} T; const int *ptr = ptr_.data, *col = col_.data; const T *a = a_.data, *x = x_.data; T* y = y_.data;
ROWS {{ T s = add ? y[i] : (T)0; ENTRIES s += a[k]*x[col[k]]; y[i] = s; }}"""


@functools.cache
def fill_kernel(a_type: Any, real: Any) -> Any:
    """Return the kernel that writes P A P + P D P into a pattern with a whole diagonal, and what follows from its rows.

    `inverse` is 1 / sum |m_ij|, `s` the scale a_ii / (a_ii + D_i) of the prolongation's rows (0 off the free set), `w` is 1 / |m_ii|.
    """
    name = f"warp_lcp.algebraic.fill_{a_type.__name__}_{real.__name__}"
    values, field = wp.array(dtype=a_type), wp.array(dtype=real)

    @wp.func_native(by_rows(FILL.format(T=C_TYPES[real])))
    def fill_span(
        ptr_: INDICES, col_: INDICES, order_: INDICES, a_: values, d_: values, f_: U8, shift_: F64, m_: field, inverse_: field, s_: field,
        w_: field, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def fill(
        ptr: INDICES, col: INDICES, order: INDICES, a: values, d: values, free: U8, shift: F64, m: field, inverse: field, s: field,
        w: field, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        t = wp.tid()
        fill_span(ptr, col, order, a, d, free, shift, m, inverse, s, w, span_start(t, chunk), span_end(t, chunk, n), stride)

    return fill


@functools.cache
def kernels(real: Any) -> SimpleNamespace:
    """Return the kernels of levels of this type."""
    name, field, T = f"warp_lcp.algebraic.{real.__name__}", wp.array(dtype=real), C_TYPES[real]

    @wp.func_native(by_rows(SCALE))
    def scale_span(ptr_: INDICES, p_: field, s_: field, o_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(by_rows(MULTIPLY.format(T=T)))
    def multiply_span(
        ptr_: INDICES, col_: INDICES, a_: field, right_ptr_: INDICES, b_: field, out_ptr_: INDICES, start_: I64, place_: U16, o_: field,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(by_rows(INVERSE.format(T=T)))
    def inverse_span(ptr_: INDICES, a_: field, inverse_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(by_rows(SWEEP.format(T=T)))
    def sweep_span(
        ptr_: INDICES, col_: INDICES, a_: field, inverse_: field, x_: field, b_: field, omega: real, from_zero: bool, y_: field,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(by_rows(RESIDUAL.format(T=T)))
    def residual_span(
        ptr_: INDICES, col_: INDICES, a_: field, x_: field, b_: field, y_: field, start: wp.int64, end: wp.int64, stride: wp.int64
    ): ...

    @wp.func_native(by_rows(TRANSFER.format(T=T)))
    def transfer_span(
        ptr_: INDICES, col_: INDICES, a_: field, x_: field, add: bool, y_: field, start: wp.int64, end: wp.int64, stride: wp.int64
    ): ...

    @wp.kernel(enable_backward=False, module=name)
    def scale(ptr: INDICES, p: field, s: field, out: field, n: int, chunk: int, stride: wp.int64):
        """Rows of P times s."""
        t = wp.tid()
        scale_span(ptr, p, s, out, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def multiply(
        ptr: INDICES, col: INDICES, a: field, right_ptr: INDICES, b: field, out_ptr: INDICES, first: I64, place: U16, out: field, n: int,
        chunk: int, stride: wp.int64,
    ):  # fmt: skip
        """A B into a known pattern: `place` says where in its row each product of an entry of A and one of B is added."""
        t = wp.tid()
        multiply_span(ptr, col, a, right_ptr, b, out_ptr, first, place, out, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def inverse(ptr: INDICES, a: field, out: field, n: int, chunk: int, stride: wp.int64):
        """One over the sum of the magnitudes of each row; 0 for rows of zeros."""
        t = wp.tid()
        inverse_span(ptr, a, out, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def sweep(
        ptr: INDICES, col: INDICES, a: field, inv: field, x: field, b: field, omega: real, from_zero: bool, y: field, n: int, chunk: int,
        stride: wp.int64,
    ):  # fmt: skip
        """Y = x + omega inv (b - A x), x taken for 0 if from_zero."""
        t = wp.tid()
        sweep_span(ptr, col, a, inv, x, b, omega, from_zero, y, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def residual(ptr: INDICES, col: INDICES, a: field, x: field, b: field, y: field, n: int, chunk: int, stride: wp.int64):
        """Y = b - A x."""
        t = wp.tid()
        residual_span(ptr, col, a, x, b, y, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def transfer(ptr: INDICES, col: INDICES, a: field, x: field, add: bool, y: field, n: int, chunk: int, stride: wp.int64):
        """Y = A x, or y + A x if add, with a rectangular A."""
        t = wp.tid()
        transfer_span(ptr, col, a, x, add, y, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def gather(source: field, order: INDICES, out: field):
        """Entries in another order."""
        k = wp.tid()
        out[k] = source[order[k]]

    @wp.kernel(enable_backward=False, module=name)
    def densify(ptr: INDICES, col: INDICES, a: field, out: MATRIX):
        """A row a thread as a dense one."""
        i = wp.tid()
        for j in range(out.shape[1]):
            out[i, j] = wp.float64(0.0)
        for k in range(ptr[i], ptr[i + 1]):
            out[i, col[k]] = wp.float64(a[k])

    @wp.kernel(enable_backward=False, module=name)
    def solve(inv: MATRIX, b: field, x: field):
        """X = inv b."""
        i = wp.tid()
        s = wp.float64(0.0)
        for j in range(inv.shape[1]):
            s += inv[i, j] * wp.float64(b[j])
        x[i] = real(s)

    return SimpleNamespace(
        scale=scale, multiply=multiply, inverse=inverse, sweep=sweep, residual=residual, transfer=transfer, gather=gather, densify=densify,
        solve=solve,
    )  # fmt: skip


@wp.func_native(PLACES)
def places(
    ptr_: INDICES, col_: INDICES, right_ptr_: INDICES, right_col_: INDICES, out_ptr_: INDICES, out_col_: INDICES, at_: INDICES,
    place_: U16, n: int,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.algebraic")
def places_kernel(
    ptr: INDICES, col: INDICES, right_ptr: INDICES, right_col: INDICES, out_ptr: INDICES, out_col: INDICES, at: INDICES, place: U16, n: int
):
    """Where in its row of the product each product of two entries belongs; by one thread, once a pattern. `at` is memory for a row."""
    places(ptr, col, right_ptr, right_col, out_ptr, out_col, at, place, n)


@wp.kernel(enable_backward=False, module="warp_lcp.algebraic")
def factor_kernel(matrix: MATRIX, rounding: wp.float64):
    """L U in place without pivoting, by one thread.

    A pivot whose magnitude is below `rounding` times its diagonal is what rounding left of a singular component, or a row of zeros: its
    unknown is taken out, and its pivot is 0.
    """
    n = matrix.shape[0]
    for c in range(n):
        least = rounding * wp.abs(matrix[c, c])
        pivot = matrix[c, c]
        for s in range(c):
            pivot -= matrix[c, s] * matrix[s, c]
        if wp.abs(pivot) <= least:
            pivot = wp.float64(0.0)
        matrix[c, c] = pivot
        for r in range(c + 1, n):
            lower = matrix[r, c]
            upper = matrix[c, r]
            for s in range(c):
                lower -= matrix[r, s] * matrix[s, c]
                upper -= matrix[c, s] * matrix[s, r]
            if pivot != wp.float64(0.0):
                matrix[r, c] = lower / pivot
                matrix[c, r] = upper
            else:
                matrix[r, c] = wp.float64(0.0)
                matrix[c, r] = wp.float64(0.0)


@wp.kernel(enable_backward=False, module="warp_lcp.algebraic")
def invert_kernel(factors: MATRIX, inverse: MATRIX):
    """Column c of the inverse from the factors, a column a thread; rows and columns of unknowns that were taken out are 0."""
    c = wp.tid()
    n = factors.shape[0]
    for r in range(n):
        v = wp.float64(0.0)
        if r == c:
            v = wp.float64(1.0)
        for s in range(c, r):
            v -= factors[r, s] * inverse[s, c]
        if factors[r, r] == wp.float64(0.0):
            v = wp.float64(0.0)
        inverse[r, c] = v
    for q in range(n):
        r = n - 1 - q
        if factors[r, r] != wp.float64(0.0):
            v = inverse[r, c]
            for s in range(r + 1, n):
                v -= factors[r, s] * inverse[s, c]
            inverse[r, c] = v / factors[r, r]
