# mypy: ignore-errors
"""Kernels that correct a preconditioner of A for A + U W U'."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, C_TYPES, simd
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_start
from warp_lcp.solvers.projected_multigrid_kernels import BETA, CARRY, GZ, SIZE, STEP, ZAP, ZAZ, rescale

I32, F64 = wp.array(dtype=wp.int32), wp.array(dtype=wp.float64)


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def split_kernel(S: F64, E: F64, columns: I32, sums: F64, m: int, force: F64, kept: F64):
    """From Z'r: kept = E^-1 Z'r, and S'^-1 Z'r as factors of all columns; S and E are the inverses."""
    i = wp.tid()
    f = wp.float64(0.0)
    e = wp.float64(0.0)
    for j in range(m):
        f += S[j * m + i] * sums[j]
        e += E[i * m + j] * sums[j]
    force[columns[i]] = f
    kept[i] = e


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def join_kernel(S: F64, columns: I32, u: F64, m: int, kept: F64, t: F64):
    """From U'z: t = S^-1 U'z less what `split_kernel` kept; S is the inverse."""
    i = wp.tid()
    a = -kept[i]
    for j in range(m):
        a += S[i * m + j] * u[columns[j]]
    t[i] = a


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def copy_kernel(a: F64, b: F64):
    """B = a."""
    i = wp.tid()
    b[i] = a[i]


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def add_products_kernel(W: F64, uz: F64, up: F64, n: int, scalars: F64):
    """Make z'Kz and z'Kp of K = A + U W U' from those of A."""
    zz = wp.float64(0.0)
    zp = wp.float64(0.0)
    for i in range(n):
        for j in range(n):
            w = W[i * n + j]
            zz += uz[i] * w * uz[j]
            zp += uz[i] * w * up[j]
    scalars[ZAZ] += zz
    scalars[ZAP] += zp


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def plan_bounded_step_kernel(scalars: F64):
    """Take a projected cycle's correction z, or as much of it as lowers the energy most; half of z keeps to the bounds as z does."""
    share = wp.float64(1.0)
    curvature = scalars[ZAZ]
    if curvature > scalars[GZ]:
        share = wp.max(scalars[GZ] / curvature, wp.float64(0.0))
    scalars[BETA] = wp.float64(0.0)
    scalars[STEP] = share * scalars[SIZE]
    scalars[CARRY] = wp.float64(0.0)
    rescale(scalars)


@functools.cache
def kernels(value_type: Any, d_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels for columns, a diagonal and corrections of these types.

    `spread` adds U f to a right-hand side on the unknowns, d != 0. `reduce` makes U'Z on them, `squares` the diagonal of U'U and then the
    rows of each block, `dots` Z'r.
    `subtract` takes the sum of t_s Z_s off z there. Z's fields are in m slots.
    """
    name = f"warp_lcp.low_rank_correction.{value_type.__name__}_{d_type.__name__}_{real.__name__}"
    values, d_array, field, T = wp.array(dtype=value_type), wp.array(dtype=d_type), wp.array(dtype=real), C_TYPES[real]

    @wp.func_native(
        """for (int e = t; e < count; e += threads) {
            const int row = rows.data[e];
            if ((e > 0 && rows.data[e - 1] == row) || d_.data[row] == 0) continue;
            double s = 0;
            for (int n = e; n < count && rows.data[n] == row; ++n)
                for (int q = 0; q < width; ++q) s += (double)u_.data[(long long)n*width + q]*f.data[blocks.data[n]*width + q];
            b.data[row] += sign*s; }
        """
    )
    def spread_entries(
        rows: I32, blocks: I32, u_: values, count: int, width: int, d_: d_array, f: F64, sign: wp.float64, b: field, t: int, threads: int
    ): ...

    @wp.func_native(
        """const auto* z = Z.data + slot*size;
        for (int q = 0; q < rank; ++q) G.data[q*m + slot] = 0;
        for (int e = 0; e < count; ++e) {
            const int row = rows.data[e];
            const double v = d_.data[row] != 0 ? (double)z[row] : 0.0;
            for (int q = 0; q < width; ++q) G.data[(blocks.data[e]*width + q)*m + slot] += (double)u_.data[(long long)e*width + q]*v; }
        """
    )
    def reduce_slot(
        rows: I32, blocks: I32, u_: values, count: int, width: int, rank: int, d_: d_array, Z: field, size: wp.int64, slot: int, m: int,
        G: F64,
    ): ...  # fmt: skip

    @wp.func_native(
        """for (int q = 0; q < rank + rank/width; ++q) out.data[q] = 0;
        for (int e = 0; e < count; ++e) {
            if (d_.data[rows.data[e]] == 0) continue;
            out.data[rank + blocks.data[e]] += 1;
            for (int q = 0; q < width; ++q) {
                const double u = (double)u_.data[(long long)e*width + q];
                out.data[blocks.data[e]*width + q] += u*u; } }
        """
    )
    def square_entries(rows: I32, blocks: I32, u_: values, count: int, width: int, rank: int, d_: d_array, out: F64): ...

    @wp.func_native(
        simd(
            f"""const {T}* r = r_.data + p;
        for (int s = 0; s < m; ++s) {{
            const {T}* v = Z_.data + s*size + p; {T} sum = 0;
            SIMD for (int k = 0; k < n; ++k) sum += v[k]*r[k];
            out.data[s*threads + t] = (double)sum; }}"""
        )
    )
    def dots_row(Z_: field, r_: field, m: int, size: wp.int64, p: wp.int64, n: int, t: int, threads: int, out: F64): ...

    @wp.func_native(
        simd(
            BLOCK
            + f"""const auto* d = d_.data + p; {T}* z = z_.data + p;
        for (int begin = 0; begin < n; begin += M) {{
            const int end = n - begin < M ? n : begin + (int)M; {T} s[M];
            SIMD for (int k = begin; k < end; ++k) s[k - begin] = 0;
            for (int slot = 0; slot < m; ++slot) {{
                const {T} t = ({T})t_.data[slot]; const {T}* v = Z_.data + slot*size + p;
                SIMD for (int k = begin; k < end; ++k) s[k - begin] += t*v[k]; }}
            SIMD for (int k = begin; k < end; ++k) {{ const {T} v = z[k] - s[k - begin]; z[k] = d[k] != 0 ? v : z[k]; }} }}"""
        )
    )
    def subtract_row(d_: d_array, Z_: field, t_: F64, z_: field, m: int, size: wp.int64, p: wp.int64, n: int): ...

    @wp.kernel(enable_backward=False, module=name)
    def spread(rows: I32, blocks: I32, u: values, count: I32, width: int, d: d_array, f: F64, sign: wp.float64, b: field, threads: int):
        spread_entries(rows, blocks, u, count[0], width, d, f, sign, b, wp.tid(), threads)

    @wp.kernel(enable_backward=False, module=name)
    def reduce(rows: I32, blocks: I32, u: values, count: I32, width: int, rank: int, d: d_array, Z: field, size: wp.int64, m: int, G: F64):
        reduce_slot(rows, blocks, u, count[0], width, rank, d, Z, size, wp.tid(), m, G)

    @wp.kernel(enable_backward=False, module=name)
    def squares(rows: I32, blocks: I32, u: values, count: I32, width: int, rank: int, d: d_array, out: F64):
        square_entries(rows, blocks, u, count[0], width, rank, d, out)

    @wp.kernel(enable_backward=False, module=name)
    def dots(A: StencilShape, planes: int, rows: int, grain: int, Z: field, r: field, m: int, size: wp.int64, threads: int, out: F64):
        k, j, c = wp.tid()
        chunks = threads / (planes * rows)
        t = (k * rows + j) * chunks + c
        dots_row(Z, r, m, size, row_start(A, k, j, c, grain), row_count(A, k, j, c, grain), t, threads, out)

    @wp.kernel(enable_backward=False, module=name)
    def subtract(A: StencilShape, d: d_array, grain: int, Z: field, t: F64, z: field, m: int, size: wp.int64):
        k, j, c = wp.tid()
        subtract_row(d, Z, t, z, m, size, row_start(A, k, j, c, grain), row_count(A, k, j, c, grain))

    return SimpleNamespace(spread=spread, reduce=reduce, squares=squares, dots=dots, subtract=subtract)
