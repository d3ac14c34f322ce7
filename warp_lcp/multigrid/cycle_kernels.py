# mypy: ignore-errors
"""Kernels of a multigrid cycle on 7-point stencils: sweeps, residual and restriction in one, correction. Native rows, one source.

A thread takes a grain of a row: the whole row on the CPU, a cell (of the coarser grid, for transfers) on CUDA.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, C_TYPES, simd
from warp_lcp.operators.stencil_kernels import NEIGHBORS, StencilShape, row_count, row_first, row_start, stencil_head

RING = wp.constant(3)  # planes that a leg keeps in t: it sweeps a plane out of the ring once the next one is in


@wp.struct
class Aggregates:
    """Cells of the finer level along each axis of an aggregate, 1 or 2, and that level's counts."""

    fx: int
    fy: int
    fz: int
    ny: int
    nz: int


@wp.func
def first_cell(A: StencilShape, C: StencilShape, G: Aggregates, k: int, j: int, c: int, grain: int):
    """Element of the finer level A at which chunk c of row (k, j) of the coarser level C begins."""
    return wp.int64(G.fz * k + 1) * A.s1 + wp.int64(G.fy * j + 1) * A.s2 + wp.int64(1 + G.fx * row_first(C, k, j, c, grain))


@wp.func
def coarse_start(A: StencilShape, C: StencilShape, G: Aggregates, k: int, j: int, c: int, grain: int):
    """Element of the coarser level C that holds the first cell of chunk c of row (k, j) of the finer level A."""
    o = wp.int64(k // G.fz + 1) * C.s1 + wp.int64(j // G.fy + 1) * C.s2
    return o + wp.int64(1 + row_first(A, k, j, c, grain) // G.fx)


@wp.func
def one_plane(G: Aggregates, k: int):
    """Whether an aggregate of plane k has one layer of cells along z."""
    return G.fz == 1 or 2 * k + 2 > G.nz


@wp.func
def one_row(G: Aggregates, j: int):
    """Whether an aggregate of row j has one layer of cells along y."""
    return G.fy == 1 or 2 * j + 2 > G.ny


@functools.cache
def cycle_kernels(variable: bool, d_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels of a level whose diagonal has type d_type, all else type `real`."""
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.cycle.{form}_{d_type.__name__}_{real.__name__}"
    apart = f"{name}.apart"  # single passes, which CUDA and ranks need: one CPU takes them together
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)
    head, neighbors = stencil_head(variable, C_TYPES[real]), NEIGHBORS[variable]
    around = neighbors.replace("x[k-s1]", "x[k+down]").replace("x[k+s1]", "x[k+up]")

    def sweep(update: str) -> str:
        """Source of a sweep whose new value is `update`, plain or clipped. It reads x and writes y, which may lie in a ring of planes."""
        value = f"const T e = unit*(T)d[k], u = {update}, v = e != 0 ? u : (T)0;"
        return simd(
            head
            + f"""T* y = y_.data + to; const T* x = x_.data + start; const T* b = b_.data + p;
        if (projected) {{
            const T* lo = l_.data + p; const T* hi = u_.data + p;
            if (u_.data) SIMD for (int k = 0; k < n; ++k) {{
                {value} const T w = v < lo[k] ? lo[k] : v; y[k] = w > hi[k] ? hi[k] : w; }}
            else SIMD for (int k = 0; k < n; ++k) {{ {value} y[k] = v < lo[k] ? lo[k] : v; }}
        }} else {{
            SIMD for (int k = 0; k < n; ++k) {{ {value} y[k] = v; }}
        }}"""
        )

    @wp.func_native(sweep(f"x[k] + omega*((b[k] + {around}) / (e != 0 ? e : (T)1) - x[k])"))
    def sweep_between(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, y_: field, to: wp.int64, x_: field, start: wp.int64,
        down: wp.int64, up: wp.int64, b_: field, l_: field, u_: field, p: wp.int64, n: int, omega: real, projected: bool,
    ): ...  # fmt: skip

    @wp.func_native(sweep("omega*b[k] / (e != 0 ? e : (T)1)"))
    def first_sweep_to(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, y_: field, to: wp.int64, x_: field, start: wp.int64,
        b_: field, l_: field, u_: field, p: wp.int64, n: int, omega: real, projected: bool,
    ): ...  # fmt: skip

    @wp.func
    def sweep_row(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, y: field, x: field, b: field, lower: field, upper: field,
        p: wp.int64, n: int, omega: real, projected: bool,
    ):  # fmt: skip
        sweep_between(A, d, wx, wy, wz, y, p, x, p, -A.s1, A.s1, b, lower, upper, p, n, omega, projected)

    @wp.func
    def first_sweep_row(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, y: field, x: field, b: field, lower: field, upper: field,
        p: wp.int64, n: int, omega: real, projected: bool,
    ):  # fmt: skip
        first_sweep_to(A, d, wx, wy, wz, y, p, x, p, b, lower, upper, p, n, omega, projected)

    @wp.func_native(
        simd(
            f"""{C_TYPES[real]}* t = t_.data + row;
        for (int k = 0; k < first; ++k) t[k] = 0;
        for (int k = first + n; k < nx; ++k) t[k] = 0;"""
        )
    )
    def clear_around(t_: field, row: wp.int64, first: int, n: int, nx: int): ...

    @wp.func
    def sweep_plane_into_ring(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, rows: int, k: int, from_zero: bool, t: field, x: field, b: field,
        lower: field, upper: field, omega: real, projected: bool,
    ):  # fmt: skip
        """Sweep plane k of x into its place in the ring, the first planes of t."""
        ring = wp.int64(k % RING - k) * A.s1
        for j in range(rows):
            p = row_start(A, k, j, 0, A.nx)
            n = row_count(A, k, j, 0, A.nx)
            if A.spans:  # those of the plane that was here before may be wider
                first = row_first(A, k, j, 0, A.nx)
                clear_around(t, p + ring - wp.int64(first), first, n, A.nx)
            if from_zero:
                first_sweep_to(A, d, wx, wy, wz, t, p + ring, x, p, b, lower, upper, p, n, omega, projected)
            else:
                sweep_between(A, d, wx, wy, wz, t, p + ring, x, p, -A.s1, A.s1, b, lower, upper, p, n, omega, projected)

    @wp.func
    def sweep_plane_out_of_ring(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, planes: int, rows: int, k: int, x: field, t: field, b: field,
        lower: field, upper: field, omega: real, projected: bool,
    ):  # fmt: skip
        """Sweep plane k in the ring into x. The ghost plane below the ring stands below the first plane and above the last one."""
        slot = k % RING
        down = -A.s1
        if slot == 0 and k > 0:
            down = wp.int64(RING - 1) * A.s1
        up = A.s1
        if k == planes - 1:
            up = wp.int64(-1 - slot) * A.s1
        elif slot == RING - 1:
            up = wp.int64(1 - RING) * A.s1
        ring = wp.int64(slot - k) * A.s1
        for j in range(rows):
            p = row_start(A, k, j, 0, A.nx)
            n = row_count(A, k, j, 0, A.nx)
            sweep_between(A, d, wx, wy, wz, x, p, t, p + ring, down, up, b, lower, upper, p, n, omega, projected)

    @wp.func_native(
        simd(
            BLOCK
            + f"""typedef {C_TYPES[real]} T; const long long p0 = p; T* coarse = c_.data + c; T r[2*M];
        for (int begin = 0; begin < n; begin += M) {{
            const int m = n - begin < M ? n - begin : (int)M;
            SIMD for (int k = 0; k < fx*m; ++k) r[k] = 0;
            for (int row = 0; row < 4; ++row) {{
                if (((row >> 1) && one_plane) || ((row & 1) && one_row)) continue;
                const long long p = p0 + fx*begin + (row >> 1)*A.s1 + (row & 1)*A.s2;
                {head.replace(f"typedef {C_TYPES[real]} T;", "")}
                const T* x = x_.data + p; const T* b = b_.data + p;
                SIMD for (int k = 0; k < fx*m; ++k) {{
                    const T e = unit*(T)d[k], v = b[k] - e*x[k] + {neighbors}; r[k] += e != 0 ? v : (T)0; }}
            }}
            if (fx == 1) {{ SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = r[k]; }}
            else {{ SIMD for (int k = 0; k < m; ++k) coarse[begin + k] = r[2*k] + r[2*k+1]; }}
        }}"""
        )
    )
    def restrict_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, c_: field, c: wp.int64, x_: field, b_: field, p: wp.int64,
        n: int, fx: int, one_plane: bool, one_row: bool,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            BLOCK
            + head
            + """T* x = x_.data + p; const T* xc = c_.data + c;
        if (projected) {
            T e[2*M];  // the correction of each cell, so that what follows reads all fields in steps of one
            for (int begin = 0; begin < n; begin += 2*M) {
                const int m = n - begin < 2*M ? n - begin : (int)(2*M); const T* coarse = xc + (begin >> shift);
                if (shift == 0) { SIMD for (int k = 0; k < m; ++k) e[k] = scale*coarse[k]; }
                else {
                    SIMD for (int k = 0; k < m / 2; ++k) { const T v = scale*coarse[k]; e[2*k] = v; e[2*k+1] = v; }
                    if (m % 2) e[m-1] = scale*coarse[m/2]; }
                const auto* at = d + begin; T* to = x + begin; const T* lo = l_.data + p + begin; const T* hi = u_.data + p + begin;
                if (u_.data) SIMD for (int k = 0; k < m; ++k) {
                    const T v = at[k] != 0 ? to[k] + e[k] : (T)0, w = v < lo[k] ? lo[k] : v; to[k] = w > hi[k] ? hi[k] : w; }
                else SIMD for (int k = 0; k < m; ++k) {
                    const T v = at[k] != 0 ? to[k] + e[k] : (T)0; to[k] = v < lo[k] ? lo[k] : v; } }
        } else if (shift == 0) {
            SIMD for (int k = 0; k < n; ++k) x[k] += d[k] != 0 ? scale*xc[k] : (T)0;
        } else {
            SIMD for (int k = 0; k < n / 2; ++k) {
                const T v = scale*xc[k]; x[2*k] += d[2*k] != 0 ? v : (T)0; x[2*k+1] += d[2*k+1] != 0 ? v : (T)0; }
            if (n % 2) x[n-1] += d[n-1] != 0 ? scale*xc[n/2] : (T)0;
        }"""
        )
    )
    def correct_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, x_: field, p: wp.int64, c_: field, c: wp.int64, l_: field,
        u_: field, n: int, shift: int, scale: real, projected: bool,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            BLOCK
            + f"""typedef {C_TYPES[real]} T; T* lower = lc_.data + c; T* upper = uc_.data + c; T lo[2*M], hi[2*M]; const T big = (T)1e30;
        for (int begin = 0; begin < n; begin += M) {{
            const int m = n - begin < M ? n - begin : (int)M;
            SIMD for (int k = 0; k < fx*m; ++k) {{ lo[k] = -big; hi[k] = big; }}
            for (int row = 0; row < 4; ++row) {{
                if (((row >> 1) && one_plane) || ((row & 1) && one_row)) continue;
                const long long q = p + fx*begin + (row >> 1)*A.s1 + (row & 1)*A.s2;
                const auto* d = d_.data + q; const T* x = x_.data + q; const T* l = l_.data + q;
                const T* u = u_.data ? u_.data + q : l;
                SIMD for (int k = 0; k < fx*m; ++k) {{
                    const T a0 = (l[k] - x[k])*inverse, b0 = (u[k] - x[k])*inverse, a1 = a0 > 0 ? (T)0 : a0, b1 = b0 < 0 ? (T)0 : b0;
                    const T a = d[k] != 0 ? a1 : -big, b = d[k] != 0 ? b1 : big;
                    lo[k] = a > lo[k] ? a : lo[k]; hi[k] = b < hi[k] ? b : hi[k]; }}
            }}
            if (fx == 1) {{ SIMD for (int k = 0; k < m; ++k) lower[begin + k] = lo[k]; }}
            else {{ SIMD for (int k = 0; k < m; ++k) lower[begin + k] = lo[2*k] > lo[2*k+1] ? lo[2*k] : lo[2*k+1]; }}
            if (!uc_.data) continue;
            if (fx == 1) {{ SIMD for (int k = 0; k < m; ++k) upper[begin + k] = hi[k]; }}
            else {{ SIMD for (int k = 0; k < m; ++k) upper[begin + k] = hi[2*k] < hi[2*k+1] ? hi[2*k] : hi[2*k+1]; }}
        }}"""
        )
    )
    def bounds_row(
        A: StencilShape, d_: d_array, x_: field, l_: field, u_: field, lc_: field, uc_: field, c: wp.int64, p: wp.int64, n: int,
        inverse: real, fx: int, one_plane: bool, one_row: bool,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def bounds_kernel(
        A: StencilShape, d: d_array, grain: int, C: StencilShape, G: Aggregates, x: field, lower: field, upper: field, scale: real,
        lower_c: field, upper_c: field,
    ):  # fmt: skip
        """Bounds of a coarse correction: the tightest of its cells' gaps, divided by the over-correction; 0 is always allowed."""
        k, j, c = wp.tid()
        n = row_count(C, k, j, c, grain)
        p = first_cell(A, C, G, k, j, c, grain)
        o = row_start(C, k, j, c, grain)
        bounds_row(A, d, x, lower, upper, lower_c, upper_c, o, p, n, real(1.0) / scale, G.fx, one_plane(G, k), one_row(G, j))

    @wp.kernel(enable_backward=False, module=apart)
    def restrict_kernel(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, grain: int, C: StencilShape, G: Aggregates, x: field, b: field,
        coarse: field,
    ):  # fmt: skip
        k, j, c = wp.tid()
        n = row_count(C, k, j, c, grain)
        p = first_cell(A, C, G, k, j, c, grain)
        restrict_row(A, d, wx, wy, wz, coarse, row_start(C, k, j, c, grain), x, b, p, n, G.fx, one_plane(G, k), one_row(G, j))

    @wp.kernel(enable_backward=False, module=apart)
    def correct_kernel(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, grain: int, C: StencilShape, G: Aggregates, x: field,
        coarse: field, lower: field, upper: field, scale: real, projected: bool,
    ):  # fmt: skip
        k, j, c = wp.tid()
        n = row_count(A, k, j, c, G.fx * grain)
        p = row_start(A, k, j, c, G.fx * grain)
        o = coarse_start(A, C, G, k, j, c, G.fx * grain)
        correct_row(A, d, wx, wy, wz, x, p, coarse, o, lower, upper, n, G.fx - 1, scale, projected)

    @wp.kernel(enable_backward=False, module=name)
    def descend_kernel(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, C: StencilShape, G: Aggregates, planes: int, rows: int,
        from_zero: bool, x: field, b: field, t: field, lower: field, upper: field, coarse: field, first: real, second: real,
        projected: bool,
    ):  # fmt: skip
        """Two sweeps, residual and restriction by one CPU thread, each a plane behind the one before: the leg streams memory once."""
        k = int(0)
        for s in range(G.nz + 1):
            if s < G.nz:
                sweep_plane_into_ring(A, d, wx, wy, wz, G.ny, s, from_zero, t, x, b, lower, upper, first, projected)
            i = s - 1
            if i >= 0:
                sweep_plane_out_of_ring(A, d, wx, wy, wz, G.nz, G.ny, i, x, t, b, lower, upper, second, projected)
            while k < planes and (G.fz * (k + 1) <= i or i == G.nz - 1):
                for j in range(rows):
                    p = first_cell(A, C, G, k, j, 0, C.nx)
                    o = row_start(C, k, j, 0, C.nx)
                    n = row_count(C, k, j, 0, C.nx)
                    restrict_row(A, d, wx, wy, wz, coarse, o, x, b, p, n, G.fx, one_plane(G, k), one_row(G, j))
                k += 1

    @wp.kernel(enable_backward=False, module=name)
    def relax_kernel(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, planes: int, rows: int, pairs: int, from_zero: bool, x: field,
        b: field, t: field, lower: field, upper: field, first: real, second: real,
    ):  # fmt: skip
        """Pairs of projected sweeps, each followed by its reverse, by one CPU thread: a small level in one launch."""
        for s in range(4 * pairs):
            omega = first
            if s % 4 == 1 or s % 4 == 2:
                omega = second
            for i in range(planes * rows):
                k = i // rows
                j = i - k * rows
                p = row_start(A, k, j, 0, A.nx)
                n = row_count(A, k, j, 0, A.nx)
                if s == 0 and from_zero:
                    first_sweep_row(A, d, wx, wy, wz, t, x, b, lower, upper, p, n, omega, True)
                elif s % 2 == 0:
                    sweep_row(A, d, wx, wy, wz, t, x, b, lower, upper, p, n, omega, True)
                else:
                    sweep_row(A, d, wx, wy, wz, x, t, b, lower, upper, p, n, omega, True)

    return SimpleNamespace(
        restrict=restrict_kernel,
        correct=correct_kernel,
        bounds=bounds_kernel,
        descend=descend_kernel,
        relax=relax_kernel,
        rows=SimpleNamespace(sweep=sweep_row, first_sweep=first_sweep_row, restrict=restrict_row, bounds=bounds_row, correct=correct_row),
        parts=SimpleNamespace(
            first_sweep_to=first_sweep_to, sweep_between=sweep_between, clear_around=clear_around, correct_row=correct_row
        ),
    )
