# mypy: ignore-errors
"""Kernels of a sparse matrix in compressed rows: products, sweeps, coloring. Native loops over rows, since rows are short."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES, simd
from warp_lcp.vector_kernels import span_end, span_start

ROWS = """
#ifdef __CUDA_ARCH__
for (long long i = start; i < end; i += stride)
#else
for (long long i = start; i < end; ++i)
#endif
"""
ENTRIES = """
#ifndef __CUDA_ARCH__
#pragma clang loop vectorize(disable)
#endif
for (int k = ptr[i]; k < ptr[i + 1]; ++k)
"""  # rows are too short for vectors

INDICES = wp.array(dtype=wp.int32)


def by_rows(source: str) -> str:
    """Return the body of a native function over a span of rows: `ROWS {...}` visits rows i, `ENTRIES {...}` entries k of row i."""
    return simd(source.replace("ROWS", ROWS).replace("ENTRIES", ENTRIES))


PRODUCT = """typedef {T} T; const int *ptr = ptr_.data, *col = col_.data; const auto* a = a_.data; const T* x = x_.data;
const T* b = b_.data; T* y = y_.data;
if (plus) {{ ROWS {{ T s = b[i]; ENTRIES s += (T)a[k]*x[col[k]]; y[i] = s; }} }}
else {{ ROWS {{ T s = 0; ENTRIES s += (T)a[k]*x[col[k]]; y[i] = s; }} }}"""

RELAX = """typedef {T} T; const int *ptr = ptr_.data, *col = col_.data, *rows = rows_.data; const auto *a = a_.data, *d = d_.data;
const T *b = b_.data, *l = l_.data, *u = u_.data; T* x = x_.data;
auto row = [&](long long i) {{
    if (d[i] == 0) return;
    T s = b[i]; ENTRIES s += (T)a[k]*x[col[k]];
    const T v = x[i] - (T)omega*s/(T)d[i], w = v < l[i] ? l[i] : v;
    x[i] = w > u[i] ? u[i] : w; }};
if (rows) {{
#ifdef __CUDA_ARCH__
    for (long long r = start; r < end; r += stride) row(rows[first + r]);
#else
    for (long long r = start; r < end; ++r) row(rows[first + r]);
#endif
}} else if (forward) {{ for (long long r = start; r < end; ++r) row(r);
}} else {{ for (long long r = end - 1; r >= start; --r) row(r); }}"""


@functools.cache
def kernels(a_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels for entries of type a_type and fields of type real."""
    name = f"warp_lcp.sparse.{a_type.__name__}_{real.__name__}"
    values, field, T = wp.array(dtype=a_type), wp.array(dtype=real), C_TYPES[real]

    @wp.func_native(by_rows(PRODUCT.format(T=T)))
    def product_span(
        ptr_: INDICES, col_: INDICES, a_: values, x_: field, b_: field, plus: bool, y_: field, start: wp.int64, end: wp.int64,
        stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(by_rows(RELAX.format(T=T)))
    def relax_span(
        ptr_: INDICES, col_: INDICES, a_: values, d_: values, rows_: INDICES, first: int, b_: field, l_: field, u_: field,
        omega: wp.float64, forward: bool, x_: field, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def product(ptr: INDICES, col: INDICES, a: values, x: field, b: field, plus: bool, y: field, n: int, chunk: int, stride: wp.int64):
        """Y = A x, or A x + b if plus."""
        t = wp.tid()
        product_span(ptr, col, a, x, b, plus, y, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def relax(
        ptr: INDICES, col: INDICES, a: values, d: values, b: field, lower: field, upper: field, omega: wp.float64, forward: bool,
        rows: INDICES, x: field, n: int,
    ):  # fmt: skip
        """One sweep in row order by one thread: each row sees the rows before it."""
        relax_span(ptr, col, a, d, rows, 0, b, lower, upper, omega, forward, x, wp.int64(0), wp.int64(n), wp.int64(1))

    @wp.kernel(enable_backward=False, module=name)
    def relax_color(
        ptr: INDICES, col: INDICES, a: values, d: values, b: field, lower: field, upper: field, omega: wp.float64, rows: INDICES,
        first: int, x: field, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        """Relax the n rows of one color, which do not see each other, from place `first` of `rows`."""
        t = wp.tid()
        relax_span(
            ptr, col, a, d, rows, first, b, lower, upper, omega, True, x, span_start(t, chunk), span_end(t, chunk, n), stride
        )  # fmt: skip

    return SimpleNamespace(product=product, relax=relax, relax_color=relax_color)


@functools.cache
def gather_kernel(a_type: Any) -> Any:
    """Return the kernel that takes entries in another order."""
    values = wp.array(dtype=a_type)

    @wp.kernel(enable_backward=False, module=f"warp_lcp.sparse.gather_{a_type.__name__}")
    def gather(source: values, order: INDICES, out: values):
        k = wp.tid()
        i = order[k]
        v = values.dtype(0)
        if i >= 0:
            v = source[i]
        out[k] = v

    return gather


@wp.kernel(enable_backward=False, module="warp_lcp.sparse.color")
def color_kernel(ptr: INDICES, col: INDICES, taken: INDICES, color: INDICES, n: int):
    """Greedy coloring in row order by one thread: the least color that no neighbor has. `taken[c]` is the last row that saw c, plus one."""
    for i in range(n):
        for k in range(ptr[i], ptr[i + 1]):
            j = col[k]
            if j < i:
                taken[color[j]] = i + 1
        c = int(0)
        while taken[c] == i + 1:
            c += 1
        color[i] = c
