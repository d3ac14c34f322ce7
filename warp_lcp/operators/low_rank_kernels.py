# mypy: ignore-errors
"""Kernels of sums and of operators of low rank, whose columns are stored by their non-zero rows in blocks."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import simd

I32, F64, U8 = wp.array(dtype=wp.int32), wp.array(dtype=wp.float64), wp.array(dtype=wp.uint8)


@functools.cache
def kernels(value_type: Any, field_type: Any) -> SimpleNamespace:
    """Return `gather` (U'x) and `scatter` (out = base + U f on U's rows) for columns and fields of these types.

    Entry e has `width` values, in row rows[e] and the columns from width * blocks[e] on; entries of a row follow each other.
    """
    name = f"warp_lcp.low_rank.{value_type.__name__}_{field_type.__name__}"
    values, field = wp.array(dtype=value_type), wp.array(dtype=field_type)

    @wp.func_native(
        simd(
            """double* s = out.data;
        for (int q = 0; q < rank; ++q) s[(long long)q*threads + t] = 0;
        for (int e = t; e < count; e += threads) {
            const double v = x.data[rows.data[e]];
            const auto* u = values_.data + (long long)e*width;
            const long long first = (long long)blocks.data[e]*width;
            for (int q = 0; q < width; ++q) s[(first + q)*threads + t] += (double)u[q]*v; }"""
        )
    )
    def gather_entries(
        rows: I32, blocks: I32, values_: values, count: int, width: int, rank: int, x: field, t: int, threads: int, out: F64
    ): ...

    @wp.func_native(
        simd(
            """for (int e = t; e < count; e += threads) {
            const int row = rows.data[e];
            if (e > 0 && rows.data[e - 1] == row) continue;  // the first entry of a row writes for all of them
            if (mask.data && mask.data[row] == 0) continue;
            double s = 0;
            for (int n = e; n < count && rows.data[n] == row; ++n) {
                const auto* u = values_.data + (long long)n*width;
                const double* f = factors.data + (long long)blocks.data[n]*width;
                for (int q = 0; q < width; ++q) s += (double)u[q]*f[q]; }
            out.data[row] = base.data[row] + s; }"""
        )
    )
    def scatter_entries(
        rows: I32, blocks: I32, values_: values, count: int, width: int, factors: F64, mask: U8, base: field, out: field, t: int,
        threads: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def gather(rows: I32, blocks: I32, u: values, count: I32, width: int, rank: int, x: field, threads: int, out: F64):
        gather_entries(rows, blocks, u, count[0], width, rank, x, wp.tid(), threads, out)

    @wp.kernel(enable_backward=False, module=name)
    def scatter(rows: I32, blocks: I32, u: values, count: I32, width: int, factors: F64, mask: U8, base: field, out: field, threads: int):
        scatter_entries(rows, blocks, u, count[0], width, factors, mask, base, out, wp.tid(), threads)

    return SimpleNamespace(gather=gather, scatter=scatter)


@functools.cache
def diagonal_kernel(value_type: Any) -> Any:
    """Return the kernel that adds the diagonal of U W U' to a field."""
    values = wp.array(dtype=value_type)

    @wp.func_native(
        """for (int e = t; e < count; e += threads) {
        const int row = rows.data[e];
        if (e > 0 && rows.data[e - 1] == row) continue;
        double s = 0;
        for (int n = e; n < count && rows.data[n] == row; ++n)
            for (int m = e; m < count && rows.data[m] == row; ++m)
                for (int p = 0; p < width; ++p)
                    for (int q = 0; q < width; ++q)
                        s += (double)values_.data[(long long)n*width + p]*(double)values_.data[(long long)m*width + q]
                            *weights.data[((long long)blocks.data[n]*width + p)*rank + (long long)blocks.data[m]*width + q];
        out.data[row] += s; }
    """
    )
    def diagonal_entries(
        rows: I32, blocks: I32, values_: values, count: int, width: int, rank: int, weights: F64, out: F64, t: int, threads: int
    ): ...

    @wp.kernel(enable_backward=False, module=f"warp_lcp.low_rank.diagonal_{value_type.__name__}")
    def diagonal(rows: I32, blocks: I32, u: values, count: I32, width: int, rank: int, weights: F64, out: F64, threads: int):
        diagonal_entries(rows, blocks, u, count[0], width, rank, weights, out, wp.tid(), threads)

    return diagonal


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank")
def weigh_kernel(weights: wp.array2d(dtype=wp.float64), c: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    """Out = W c, c's first entries."""
    i = wp.tid()
    s = wp.float64(0.0)
    for j in range(weights.shape[1]):
        s += weights[i, j] * c[j]
    out[i] = s


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank")
def add_kernel(x: wp.array(dtype=Any), y: wp.array(dtype=Any)):
    """Y += x."""
    i = wp.tid()
    y[i] = y[i] + x[i]


for _T in (wp.float32, wp.float64):
    wp.overload(add_kernel, [wp.array(dtype=_T), wp.array(dtype=_T)])
