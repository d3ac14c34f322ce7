# mypy: ignore-errors
"""Kernels that build coarser levels: the Galerkin product with piecewise-constant 2 x 2 x 2 aggregates, and bounds of corrections.

Piecewise-constant aggregation keeps the 7-point stencil on every level and copes with any mask: the weight between two aggregates is the
sum over the faces between them, an aggregate's diagonal the sum of its cells' diagonals less twice the faces inside it.
"""

import functools
from typing import Any

import warp as wp

from warp_lcp.multigrid.cycle_kernels import Aggregates, first_cell, one_plane, one_row
from warp_lcp.native import BLOCK, C_TYPES, simd
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_first, row_start

options = {"enable_backward": False, "module": "warp_lcp.coarsen"}

UNBOUNDED = 1e30  # stands for an infinite bound of a correction; corrections are of order one


@wp.func
def lower_weight(w: wp.array3d(dtype=Any), uniform: wp.float64, k: int, j: int, i: int):
    """Weight of a lower face."""
    c = uniform
    if w.shape[0] > 0:
        c = wp.float64(w[k, j, i])
    return c


@wp.struct
class Wraps:
    """Offsets from a row of the finer level to the rows around it; 0 where there is none. Wrapped ones on periodic axes."""

    below_x: wp.int64  # of the first cell
    above_x: wp.int64  # of the last cell
    below_y: wp.int64
    above_y: wp.int64
    below_z: wp.int64
    above_z: wp.int64


@wp.func
def below(first: bool, periodic: int, step: wp.int64, n: int):
    """Offset to the row or plane below."""
    o = -step
    if first:
        o = wp.int64(0)
        if periodic != 0:
            o = wp.int64(n - 1) * step
    return o


@wp.func
def above(last: bool, periodic: int, step: wp.int64, n: int):
    """Offset to the row or plane above."""
    o = step
    if last:
        o = wp.int64(0)
        if periodic != 0:
            o = wp.int64(1 - n) * step
    return o


@functools.cache
def coarsen_kernels(variable: bool, d_type: Any, real: Any) -> Any:
    """Return the kernel that makes one coarse row a thread on the CPU, one aggregate a thread on CUDA.

    A cell's excess is its diagonal less its faces to other unknowns: what AIR, held unknowns and the shift contribute. An aggregate's
    diagonal is the sum of its cells' excesses plus its outer faces, a sum of positive numbers: taking inner faces off the diagonals would
    cancel. Weights along axes that are not aggregated are not too stiff, so they are multiplied by `stiffen`, the over-correction that the
    prolongation applies to all; the excess, whose held neighbors are one cell and not one aggregate away, by `held`.
    """
    name = f"warp_lcp.coarsen.{'variable' if variable else 'uniform'}_{d_type.__name__}_{real.__name__}"
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    # equal weights: faces are counted in bytes and scaled at the end
    counts = d_type is wp.uint8
    buffer, diagonal = ("unsigned char", "d_.data[p + k]") if counts else (C_TYPES[real], "(T)A.unit*(T)d_.data[p + k]")
    least = "1e-6" if real is wp.float32 else "1e-14"  # of a diagonal: an excess below it is what rounding left
    kept = "v" if counts else f"v > (B){least}*({diagonal}) ? v : (B)0"

    def weight(axis: str, shift: str) -> str:
        """Weight of a face stored `shift` after the cell."""
        if variable:
            return f"(B)w{axis}_.data[p + k + {shift}]"
        return f"(B)(A.c{axis} > 0)" if counts else f"(B)A.c{axis}"

    def faces(axis: str, side: str, shift: str) -> str:
        """Weights of a row's faces to the row at offset `at`: off the excess, and onto the outer faces."""
        return f"""{{ const long long at = {side}_{axis}; const bool outer = outer_{side}_{axis};
                    if (at != 0) {{
                        const auto* here = d_.data + p; const auto* there = here + at; B* sum = outer ? {side[0]}{axis} : none;
                        SIMD for (int k = 0; k < fx*m; ++k) {{
                            const B w = {weight(axis, shift)}, f = ((here[k] != 0) & (there[k] != 0)) ? w : (B)0; e[k] -= f; sum[k] += f; }}
                    }} }}"""

    @wp.func_native(
        simd(
            BLOCK
            + f"""typedef {C_TYPES[real]} T; typedef {buffer} B; const int last_cell = A.nx - 1 - fx*start;
        B excess[2*M], bx[2*M], ax[2*M], by[2*M], ay[2*M], bz[2*M], az[2*M], e[2*M], none[2*M];
        for (int begin = 0; begin < n; begin += M) {{
            const int m = n - begin < M ? n - begin : (int)M;
            SIMD for (int k = 0; k < fx*m; ++k) {{
                excess[k] = 0; bx[k] = 0; ax[k] = 0; by[k] = 0; ay[k] = 0; bz[k] = 0; az[k] = 0; none[k] = 0; }}
            for (int row = 0; row < 4; ++row) {{
                const bool upper_z = row >> 1, upper_y = row & 1;
                if ((upper_z && one_plane) || (upper_y && one_row)) continue;
                const long long p = p0 + fx*begin + (upper_z ? A.s1 : 0) + (upper_y ? A.s2 : 0);
                const long long below_y = upper_y ? -A.s2 : W.below_y, below_z = upper_z ? -A.s1 : W.below_z;
                const long long above_y = upper_y || one_row ? W.above_y : A.s2, above_z = upper_z || one_plane ? W.above_z : A.s1;
                const bool whole_y = !one_row && W.below_y == A.s2, whole_z = !one_plane && W.below_z == A.s1;  // periodic, two rows
                const bool outer_below_y = !upper_y && !whole_y, outer_above_y = (upper_y || one_row) && !whole_y;
                const bool outer_below_z = !upper_z && !whole_z, outer_above_z = (upper_z || one_plane) && !whole_z;
                const auto* d = d_.data + p;
                SIMD for (int k = 0; k < fx*m; ++k) {{
                    const B w = {weight("x", "0")}, v = {weight("x", "1")};
                    const B f = ((d[k] != 0) & (d[k-1] != 0)) ? w : (B)0, g = ((d[k] != 0) & (d[k+1] != 0)) ? v : (B)0;
                    e[k] = (B)({diagonal}) - f - g; bx[k] += f; ax[k] += g; }}
                if (start + begin == 0 && W.below_x != 0) {{
                    const int k = 0;
                    const B f = ((d[k] != 0) & (d[k + W.below_x] != 0)) ? {weight("x", "0")} : (B)0; e[k] -= f; bx[k] += f; }}
                const int z = last_cell - fx*begin;
                if (z < fx*m && W.above_x != 0) {{
                    const int k = z;
                    const B f = ((d[k] != 0) & (d[k + W.above_x] != 0)) ? {weight("x", "1")} : (B)0; e[k] -= f; ax[k] += f; }}
                {faces("y", "below", "0")}
                {faces("y", "above", "A.s2")}
                {faces("z", "below", "0")}
                {faces("z", "above", "A.s1")}
                SIMD for (int k = 0; k < fx*m; ++k) {{ const B v = e[k]; excess[k] += {kept}; }}
            }}
            const T scale = {"(T)A.unit" if counts else "(T)1"}, se = scale*(fx*fy*fz == 8 ? held : stiffen);
            const bool whole_x = fx == 2 && W.below_x == 1;  // a periodic row of two cells is one aggregate
            const T sx = whole_x ? (T)0 : fx == 2 ? scale : scale*stiffen;
            const T sy = fy == 2 ? scale : scale*stiffen, sz = fz == 2 ? scale : scale*stiffen;
            T* dc = dc_.data + c + begin; T* wxc = wxc_.data + c + begin; T* wyc = wyc_.data + c + begin; T* wzc = wzc_.data + c + begin;
            if (fx == 2) {{
                SIMD for (int k = 0; k < m; ++k) {{
                    const int a = 2*k, b = a + 1;
                    const T x = sx*(T)bx[a], y = sy*((T)by[a] + (T)by[b]), z = sz*((T)bz[a] + (T)bz[b]);
                    wxc[k] = x; wyc[k] = y; wzc[k] = z;
                    const T above = sx*(T)ax[b] + sy*((T)ay[a] + (T)ay[b]) + sz*((T)az[a] + (T)az[b]);
                    dc[k] = se*((T)excess[a] + (T)excess[b]) + x + y + z + above; }}
                const int odd = last_cell - 2*begin;  // the last cell of an odd row is an aggregate: its upper face is an outer one
                if (odd < 2*m && odd % 2 == 0) dc[odd / 2] += sx*(T)ax[odd];
            }} else {{
                SIMD for (int k = 0; k < m; ++k) {{
                    const T x = sx*(T)bx[k], y = sy*(T)by[k], z = sz*(T)bz[k];
                    wxc[k] = x; wyc[k] = y; wzc[k] = z;
                    dc[k] = se*(T)excess[k] + x + y + z + sx*(T)ax[k] + sy*(T)ay[k] + sz*(T)az[k]; }}
            }}
        }}"""
        )
    )
    def coarsen_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, p0: wp.int64, dc_: field, wxc_: field, wyc_: field, wzc_: field,
        c: wp.int64, n: int, start: int, fx: int, fy: int, fz: int, one_plane: bool, one_row: bool, W: Wraps, stiffen: real, held: real,
    ): ...  # fmt: skip

    @wp.func
    def coarsen_chunk(
        k: int, j: int, c: int, A: StencilShape, d: d_array, wx: field, wy: field, wz: field, n: wp.vec3i, periodic: wp.vec3i,
        C: StencilShape, G: Aggregates, grain: int, stiffen: real, held: real, dc: field, wxc: field, wyc: field, wzc: field,
    ):  # fmt: skip
        plane = one_plane(G, k)
        row = one_row(G, j)
        last_k = G.fz * k
        if not plane:
            last_k += 1
        last_j = G.fy * j
        if not row:
            last_j += 1
        W = Wraps()
        W.below_x = below(True, periodic[0], wp.int64(1), n[2])
        W.above_x = above(True, periodic[0], wp.int64(1), n[2])
        W.below_y = below(j == 0, periodic[1], A.s2, n[1])
        W.above_y = above(last_j == n[1] - 1, periodic[1], A.s2, n[1])
        W.below_z = below(k == 0, periodic[2], A.s1, n[0])
        W.above_z = above(last_k == n[0] - 1, periodic[2], A.s1, n[0])
        m = row_count(C, k, j, c, grain)
        p = first_cell(A, C, G, k, j, c, grain)
        o = row_start(C, k, j, c, grain)
        coarsen_row(
            A, d, wx, wy, wz, p, dc, wxc, wyc, wzc, o, m, row_first(C, k, j, c, grain), G.fx, G.fy, G.fz, plane, row, W, stiffen, held
        )

    @wp.kernel(enable_backward=False, module=name)
    def coarsen(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, n: wp.vec3i, periodic: wp.vec3i, C: StencilShape, G: Aggregates,
        grain: int, stiffen: real, held: real, dc: field, wxc: field, wyc: field, wzc: field,
    ):  # fmt: skip
        k, j, c = wp.tid()
        coarsen_chunk(k, j, c, A, d, wx, wy, wz, n, periodic, C, G, grain, stiffen, held, dc, wxc, wyc, wzc)

    coarsen.chunk = coarsen_chunk
    return coarsen


@wp.kernel(**options)
def factor_kernel(
    A: StencilShape,
    d: wp.array3d(dtype=Any),
    wx: wp.array3d(dtype=Any),
    wy: wp.array3d(dtype=Any),
    wz: wp.array3d(dtype=Any),
    n: wp.vec3i,
    periodic: wp.vec3i,
    rounding: wp.float64,
    matrix: wp.array2d(dtype=wp.float64),
):
    """Assemble the coarsest level and factor it in place, L D L', by one thread.

    A pivot below `rounding` times its diagonal is a singular component's rounding: its unknown is pinned at 0.
    """
    m = n[0] * n[1] * n[2]
    for r in range(m):
        for c in range(r + 1):
            matrix[r, c] = wp.float64(0.0)
    for r in range(m):
        k = r // (n[1] * n[2]) + 1
        j = (r // n[2]) % n[1] + 1
        i = r % n[2] + 1
        if d[k, j, i] != d.dtype(0):
            matrix[r, r] += A.unit * wp.float64(d[k, j, i])
            for axis in range(3):
                q = int(-1)
                w = wp.float64(0.0)
                if axis == 0:
                    w = lower_weight(wx, A.cx, k, j, i)
                    if i > 1:
                        q = r - 1
                    elif periodic[0] != 0:
                        q = r + n[2] - 1
                if axis == 1:
                    w = lower_weight(wy, A.cy, k, j, i)
                    if j > 1:
                        q = r - n[2]
                    elif periodic[1] != 0:
                        q = r + (n[1] - 1) * n[2]
                if axis == 2:
                    w = lower_weight(wz, A.cz, k, j, i)
                    if k > 1:
                        q = r - n[1] * n[2]
                    elif periodic[2] != 0:
                        q = r + (n[0] - 1) * n[1] * n[2]
                if q >= 0:
                    if d[q // (n[1] * n[2]) + 1, (q // n[2]) % n[1] + 1, q % n[2] + 1] != d.dtype(0):
                        matrix[wp.max(r, q), wp.min(r, q)] -= w
    for c in range(m):
        pivot = matrix[c, c]
        for s in range(c):
            pivot -= matrix[c, s] * matrix[c, s] * matrix[s, s]
        if pivot <= rounding * matrix[c, c]:
            pivot = wp.float64(0.0)
        matrix[c, c] = pivot
        for r in range(c + 1, m):
            v = matrix[r, c]
            for s in range(c):
                v -= matrix[r, s] * matrix[c, s] * matrix[s, s]
            if pivot > wp.float64(0.0):
                matrix[r, c] = v / pivot
            else:
                matrix[r, c] = wp.float64(0.0)


@wp.kernel(**options)
def invert_kernel(matrix: wp.array2d(dtype=wp.float64), inverse: wp.array2d(dtype=wp.float64)):
    """Column c of the inverse from the factors, a column a thread; stored as a row, the inverse is symmetric."""
    c = wp.tid()
    m = matrix.shape[0]
    for r in range(m):
        v = wp.float64(0.0)
        if r == c:
            v = wp.float64(1.0)
        for s in range(c, r):
            v -= matrix[r, s] * inverse[c, s]
        if r < c:
            v = wp.float64(0.0)
        inverse[c, r] = v
    for r in range(m):
        if matrix[r, r] > wp.float64(0.0):
            inverse[c, r] = inverse[c, r] / matrix[r, r]
        else:
            inverse[c, r] = wp.float64(0.0)
    for q in range(m):
        r = m - 1 - q
        v = inverse[c, r]
        for s in range(r + 1, m):
            v -= matrix[s, r] * inverse[c, s]
        if matrix[r, r] > wp.float64(0.0):
            inverse[c, r] = v
        else:
            inverse[c, r] = wp.float64(0.0)


@wp.kernel(**options)
def solve_coarsest_kernel(inverse: wp.array2d(dtype=wp.float64), n: wp.vec3i, b: wp.array3d(dtype=Any), x: wp.array3d(dtype=Any)):
    """X = inverse b, a row a thread."""
    r = wp.tid()
    m = n[0] * n[1] * n[2]
    v = wp.float64(0.0)
    for s in range(m):
        v += inverse[r, s] * wp.float64(b[s // (n[1] * n[2]) + 1, (s // n[2]) % n[1] + 1, s % n[2] + 1])
    x[r // (n[1] * n[2]) + 1, (r // n[2]) % n[1] + 1, r % n[2] + 1] = x.dtype(v)


def _overload() -> None:
    for real in (wp.float32, wp.float64):
        f = wp.array3d(dtype=real)
        for d_type in (wp.uint8, real):
            d = wp.array3d(dtype=d_type)
            wp.overload(factor_kernel, [StencilShape, d, f, f, f, wp.vec3i, wp.vec3i, wp.float64, wp.array2d(dtype=wp.float64)])
        wp.overload(solve_coarsest_kernel, [wp.array2d(dtype=wp.float64), wp.vec3i, f, f])


_overload()
