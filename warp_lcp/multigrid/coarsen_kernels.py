# mypy: ignore-errors
"""Kernels that build coarser levels: the Galerkin product with piecewise-constant 2 x 2 x 2 aggregates, and bounds of corrections.

Piecewise-constant aggregation keeps the 7-point stencil on every level and copes with any mask: the weight between two aggregates is the
sum over the faces between them, an aggregate's diagonal the sum of its cells' diagonals less twice the faces inside it.
"""

import functools
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, C_TYPES, simd
from warp_lcp.operators.stencil_kernels import StencilShape, row_start

options = {"enable_backward": False, "module": "warp_lcp.coarsen"}

UNBOUNDED = 1e30  # stands for an infinite bound of a correction; corrections are of order one
ROUNDING = wp.constant(wp.float64(1e-6))  # a diagonal this much smaller than its cells' sum is a singular aggregate's rounding


@wp.func
def lower_weight(w: wp.array3d(dtype=Any), uniform: wp.float64, k: int, j: int, i: int):
    """Weight of a lower face."""
    c = uniform
    if w.shape[0] > 0:
        c = wp.float64(w[k, j, i])
    return c


@functools.cache
def coarsen_kernels(variable: bool, d_type: Any, real: Any) -> Any:
    """Return the kernel that makes one coarse row a thread on the CPU, one aggregate a thread on CUDA."""
    name = f"warp_lcp.coarsen.{'variable' if variable else 'uniform'}_{d_type.__name__}_{real.__name__}"
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    def weight(axis: str) -> str:
        return f"(T)w{axis}_.data[p + k]" if variable else f"(T)A.c{axis}"

    def along(axis: str) -> str:
        """Faces towards the row below along y or z: inside the aggregate for its upper rows, between aggregates for the lower."""
        return f"""if (has_{axis}) {{
                    const long long q = p + to_{axis}; T* sum = inside_{axis} ? inner : outer_{axis};
                    SIMD for (int k = 0; k < 2*m; ++k) {{
                        const T w = {weight(axis)}; sum[k] += (d_.data[p + k] != 0) & (d_.data[q + k] != 0) ? w : (T)0; }}
                }}"""

    @wp.func_native(
        simd(
            BLOCK
            + f"""typedef {C_TYPES[real]} T; const T unit = (T)A.unit;
        T total[2*M], inner[2*M], outer_y[2*M], outer_z[2*M], x[2*M + 1];
        for (int begin = 0; begin < n; begin += M) {{
            const int m = n - begin < M ? n - begin : (int)M;
            SIMD for (int k = 0; k < 2*m; ++k) {{ total[k] = 0; inner[k] = 0; outer_y[k] = 0; outer_z[k] = 0; x[k] = 0; }}
            for (int row = 0; row < 4; ++row) {{
                const bool upper_z = row >> 1, upper_y = row & 1;
                if ((upper_z && one_plane) || (upper_y && one_row)) continue;
                const long long p = p0 + 2*begin + (upper_z ? A.s1 : 0) + (upper_y ? A.s2 : 0);
                SIMD for (int k = 0; k < 2*m; ++k) total[k] += unit*(T)d_.data[p + k];
                SIMD for (int k = 0; k < 2*m; ++k) {{
                    const T w = {weight("x")}; x[k] += (d_.data[p + k] != 0) & (d_.data[p + k - 1] != 0) ? w : (T)0; }}
                if (begin == 0 && first && wrap_x != 0) {{
                    const int k = 0; x[0] += (d_.data[p] != 0) & (d_.data[p + wrap_x] != 0) ? {weight("x")} : (T)0; }}
                const bool inside_y = upper_y || wrap_y == A.s2, has_y = upper_y || wrap_y != 0;
                const bool inside_z = upper_z || wrap_z == A.s1, has_z = upper_z || wrap_z != 0;
                const long long to_y = upper_y ? -A.s2 : wrap_y, to_z = upper_z ? -A.s1 : wrap_z;
                {along("y")}
                {along("z")}
            }}
            const bool only = first && begin == 0 && wrap_x == 1;
            for (int k = 0; k < m; ++k) {{
                const T within = inner[2*k] + inner[2*k + 1] + x[2*k + 1] + (only ? x[0] : (T)0), all = total[2*k] + total[2*k + 1];
                const T v = all - 2*within; const long long o = c + begin + k;
                dc_.data[o] = v < (T)1e-6*all ? (T)0 : v; wxc_.data[o] = only ? (T)0 : x[2*k];
                wyc_.data[o] = outer_y[2*k] + outer_y[2*k + 1]; wzc_.data[o] = outer_z[2*k] + outer_z[2*k + 1]; }}
        }}"""
        )
    )
    def coarsen_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, p0: wp.int64, dc_: field, wxc_: field, wyc_: field, wzc_: field,
        c: wp.int64, n: int, first: bool, one_plane: bool, one_row: bool, wrap_x: wp.int64, wrap_y: wp.int64, wrap_z: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def coarsen(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, n: wp.vec3i, periodic: wp.vec3i, C: StencilShape, grain: int,
        dc: field, wxc: field, wyc: field, wzc: field,
    ):  # fmt: skip
        k, j, c = wp.tid()
        wrap_x = wp.int64(0)  # offset from a first cell, row or plane to the one below it: 0 where there is none
        wrap_y = -A.s2
        wrap_z = -A.s1
        if periodic[0] != 0 and c == 0:
            wrap_x = wp.int64(n[2] - 1)
        if j == 0:
            wrap_y = wp.int64(0)
            if periodic[1] != 0:
                wrap_y = wp.int64(n[1] - 1) * A.s2
        if k == 0:
            wrap_z = wp.int64(0)
            if periodic[2] != 0:
                wrap_z = wp.int64(n[0] - 1) * A.s1
        p = wp.int64(2 * k + 1) * A.s1 + wp.int64(2 * j + 1) * A.s2 + wp.int64(1 + 2 * c * grain)
        o = row_start(C, k, j, c, grain)
        m = wp.min(grain, C.nx - c * grain)
        coarsen_row(
            A, d, wx, wy, wz, p, dc, wxc, wyc, wzc, o, m, c == 0, 2 * k + 2 > n[0], 2 * j + 2 > n[1], wrap_x, wrap_y, wrap_z
        )  # fmt: skip

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
    matrix: wp.array2d(dtype=wp.float64),
):
    """Assemble the coarsest level and factor it in place, L D L', by one thread; a vanishing pivot pins its unknown at 0."""
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
        if pivot <= ROUNDING * matrix[c, c]:
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
            wp.overload(factor_kernel, [StencilShape, d, f, f, f, wp.vec3i, wp.vec3i, wp.array2d(dtype=wp.float64)])
        wp.overload(solve_coarsest_kernel, [wp.array2d(dtype=wp.float64), wp.vec3i, f, f])


_overload()
