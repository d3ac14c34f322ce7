# mypy: ignore-errors
"""Kernels of the minimum-map Newton method on grids: residual, active set and right-hand side in one pass."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, C_TYPES, fetch, simd
from warp_lcp.operators.stencil_kernels import NEIGHBORS, StencilShape, row_count, row_start, stencil_head
from warp_lcp.solvers.projected_multigrid_kernels import AT_ROW, BETA, SIZE, STEP, RowSums
from warp_lcp.solvers.projected_multigrid_kernels import row_kernels as engine_kernels

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)

MARK = "1e30f"  # in place of a right-hand side, of order one: a held unknown that is not at its bound, below 0 for the lower one


@functools.cache
def row_kernels(variable: bool, d_type: Any, w_type: Any, free_type: Any, real: Any, *, rounded: bool = False) -> SimpleNamespace:
    """Return the kernels of a step.

    `assess` evaluates y = A x + b in float64, sums the natural residual, holds the unknowns that the minimum map does not call free, those
    with x - y / d outside their bounds, and writes g = -y / SIZE on the others. Rows with a held unknown off its bound are flagged;
    `hold` moves those onto their bounds, `right_side` makes g again where that has changed it. `advance` is the engine's step and
    `assess` by one CPU thread. Where x is `rounded` to float32, so are the bounds that unknowns are moved to.
    """
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.minimum_map_newton_grid.{form}_{d_type.__name__}_{w_type.__name__}_{free_type.__name__}_{real.__name__}"
    name += "_rounded" * rounded
    near = "(T)(float)" if rounded else ""
    d_array, w_array, free_array, field = (wp.array(dtype=t) for t in (d_type, w_type, free_type, real))
    update_row = engine_kernels(variable, d_type, w_type, free_type, real, rounded=rounded).update_row
    product = f"const T e = unit*(T)d[k], v = e*x[k] - {NEIGHBORS[variable]}; y[k - begin] = (e != 0 ? v : (T)0) + b[k];"

    @wp.func_native(
        simd(
            BLOCK
            + AT_ROW
            + stencil_head(variable, "double")
            + f"""typedef {C_TYPES[free_type]} F; typedef {C_TYPES[real]} S; F* free = free_.data + p;
        const T *x = x_.data + p, *over = x + s1, *b = b_.data + p; S* g = g_.data + p;
        const auto* m = m_.data + p; T s = 0; T energy = 0; int moved = 0, active = 0, away = 0; unsigned char hold[M];
        const bool free_all = !l_.data && !u_.data && !code_.data && l_value == -(T)INFINITY && u_value == (T)INFINITY;
        for (int begin = 0; begin < n; begin += M) {{
            const int end = n - begin < M ? n : begin + (int)M; T y[M];
            {fetch("begin", "end", over=8, b=8, g=4, d=1, m=1, free=1)}
            SIMD8 for (int k = begin; k < end; ++k) {{ {product} }}
            unsigned char changed = 0, count = 0, off = 0;
            if (free_all) {{
                SIMD8 for (int k = begin; k < end; ++k) {{
                    const T v = y[k - begin], r = m[k] == 1 ? v : (T)0; s += r*r; g[k] = d[k] != 0 ? -v*inverse : (T)0; }}
                SIMD for (int k = begin; k < end; ++k) {{
                    const F now = (F)d[k]; changed |= (unsigned char)(free[k] != now); free[k] = now; }}
                moved += changed;
                continue;
            }}
            with_bounds([&](auto lower, auto upper) {{
                SIMD8 for (int k = begin; k < end; ++k) {{
                    const T e = unit*(T)d[k], f = e != 0 ? e : (T)1, l = lower(k), u = upper(k), v = y[k - begin];
                    const T below = f*(x[k] - l), above = f*(x[k] - u); const bool low = below < v, high = above > v;
                    const T least = low ? below : v, r0 = above > least ? above : least, r = m[k] == 1 ? r0 : (T)0;
                    const bool held = classify & (m[k] == 1) & (low | high);
                    const bool there = x[k] == (low ? {near}l : {near}u);
                    const S at = ((e != 0) & !held) ? (S)(-v*inverse) : (S)0, mark = low ? -(S){MARK} : (S){MARK};
                    s += r*r; energy += m[k] == 1 ? x[k]*(v + b[k]) : (T)0;
                    hold[k - begin] = held ? (there ? 1 : 3) : 0; g[k] = (held & !there) ? mark : at; }} }});
            SIMD for (int k = begin; k < end; ++k) {{  // bytes only, where the diagonal is one
                const unsigned char h = hold[k - begin]; const F now = h ? (F)0 : (F)d[k];
                const unsigned char one = free[k] != now, two = h & m[k];
                changed |= one; count += two; off |= h; free[k] = now; }}
            moved += changed; active += count; away |= off & 2; }}
        if (moved) changed_.data[row] = 1;
        if (away) away_.data[row] = 1;
        const double all[4] = {{s, (double)moved, (double)active, energy}}; double* sums = out.data + t;
        for (int c = 0; c < 4; ++c) sums[c*threads] = more ? all[c] + sums[c*threads] : all[c];"""
        )
    )
    def assess_row(
        A: StencilShape, d_: d_array, wx_: w_array, wy_: w_array, wz_: w_array, x_: f64, b_: f64, l_: f64, l_value: wp.float64, u_: f64,
        u_value: wp.float64, code_: u8, m_: i8, free_: free_array, g_: field, inverse: wp.float64, classify: bool, p: wp.int64, n: int,
        t: int, threads: int, more: bool, changed_: u8, away_: u8, row: int, out: f64,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            AT_ROW
            + f"""typedef double T; double* x = x_.data + p; auto* g = g_.data + p;
        with_bounds([&](auto lower, auto upper) {{
            SIMD8 for (int k = 0; k < n; ++k) {{
                const double l = {near}lower(k), u = {near}upper(k); const bool low = g[k] <= -{MARK}, high = g[k] >= {MARK};
                x[k] = low ? l : (high ? u : x[k]); }} }});"""
        )
    )
    def hold_row(x_: f64, g_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, p: wp.int64, n: int): ...

    @wp.func_native(
        simd(
            BLOCK
            + stencil_head(variable, "double")
            + f"""const T *x = x_.data + p, *b = b_.data + p; auto* g = g_.data + p; const auto* free = free_.data + p;
        for (int begin = 0; begin < n; begin += M) {{
            const int end = n - begin < M ? n : begin + (int)M; T y[M];
            SIMD8 for (int k = begin; k < end; ++k) {{ {product} }}
            SIMD8 for (int k = begin; k < end; ++k) {{ const T v = y[k - begin]*inverse; g[k] = free[k] != 0 ? -v : (T)0; }} }}"""
        )
    )
    def right_side_row(
        A: StencilShape, d_: d_array, wx_: w_array, wy_: w_array, wz_: w_array, x_: f64, b_: f64, free_: free_array, g_: field,
        inverse: wp.float64, p: wp.int64, n: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def assess(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, grain: int, R: RowSums, x: f64, b: f64, lower: f64,
        lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, free: free_array, g: field, scalars: f64,
        classify: bool, out: f64, away: u8,
    ):  # fmt: skip
        slab, j, c = wp.tid()
        inverse = wp.float64(1.0) / scalars[SIZE]
        t = (slab * R.rows + j) * R.chunks + c
        for k in range(slab * R.planes, wp.min((slab + 1) * R.planes, R.all_planes)):
            n = row_count(A, k, j, c, grain)
            p = row_start(A, k, j, c, grain)
            assess_row(
                A, d, wx, wy, wz, x, b, lower, lower_value, upper, upper_value, code, unknown, free, g, inverse, classify, p, n, t,
                R.threads, k > slab * R.planes, R.changed, away, k * R.rows + j, out,
            )  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def advance(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, R: RowSums, x: f64, z: field, p: field, b: f64, lower: f64,
        lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, free: free_array, g: field, scalars: f64,
        classify: bool, out: f64, away: u8,
    ):  # fmt: skip
        """A plane is assessed when the one above it has moved: x is still in the cache."""
        inverse = wp.float64(1.0) / scalars[SIZE]
        beta = real(scalars[BETA])
        step = scalars[STEP]
        for s in range(R.all_planes + 1):
            if s < R.all_planes:
                for j in range(R.rows):
                    o = row_start(A, s, j, 0, A.nx)
                    n = row_count(A, s, j, 0, A.nx)
                    update_row(x, z, p, lower, lower_value, upper, upper_value, code, beta, step, o, n)
            k = s - 1
            if k >= 0:
                slab = k // R.planes
                for j in range(R.rows):
                    n = row_count(A, k, j, 0, A.nx)
                    o = row_start(A, k, j, 0, A.nx)
                    assess_row(
                        A, d, wx, wy, wz, x, b, lower, lower_value, upper, upper_value, code, unknown, free, g, inverse, classify, o, n,
                        slab * R.rows + j, R.threads, k > slab * R.planes, R.changed, away, k * R.rows + j, out,
                    )  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def hold(
        A: StencilShape, grain: int, R: RowSums, x: f64, g: field, lower: f64, lower_value: wp.float64, upper: f64,
        upper_value: wp.float64, code: u8, away: u8,
    ):  # fmt: skip
        """Move the marked unknowns of flagged rows onto their bounds."""
        k, j, c = wp.tid()
        if away[k * R.rows + j] != wp.uint8(0):
            o = row_start(A, k, j, c, grain)
            hold_row(x, g, lower, lower_value, upper, upper_value, code, o, row_count(A, k, j, c, grain))

    @wp.kernel(enable_backward=False, module=name)
    def right_side(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, grain: int, R: RowSums, periodic: wp.vec3i, x: f64, b: f64,
        free: free_array, g: field, scalars: f64, away: u8,
    ):  # fmt: skip
        """Write g in the flagged rows and those beside them."""
        k, j, c = wp.tid()
        found = away[k * R.rows + j]
        for a in range(4):
            z = k
            y = j
            if a < 2:
                z = k + 2 * a - 1
            else:
                y = j + 2 * a - 5
            if periodic[2] != 0:
                z = (z + R.all_planes) % R.all_planes
            if periodic[1] != 0:
                y = (y + R.rows) % R.rows
            if z >= 0 and z < R.all_planes and y >= 0 and y < R.rows:
                found = wp.max(found, away[z * R.rows + y])
        if found != wp.uint8(0):
            o = row_start(A, k, j, c, grain)
            right_side_row(A, d, wx, wy, wz, x, b, free, g, wp.float64(1.0) / scalars[SIZE], o, row_count(A, k, j, c, grain))

    return SimpleNamespace(assess=assess, advance=advance, hold=hold, right_side=right_side)
