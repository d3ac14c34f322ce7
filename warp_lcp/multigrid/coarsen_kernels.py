# mypy: ignore-errors
"""Kernels that build coarser levels: the Galerkin product with piecewise-constant 2 x 2 x 2 aggregates, and bounds of corrections.

Piecewise-constant aggregation keeps the 7-point stencil on every level and copes with any mask: the weight between two aggregates is the
sum over the faces between them, an aggregate's diagonal the sum of its cells' diagonals less twice the faces inside it.
"""

from typing import Any

import warp as wp

from warp_lcp.operators.stencil_kernels import StencilShape

options = {"enable_backward": False, "module": "warp_lcp.coarsen"}

UNBOUNDED = 1e30  # stands for an infinite bound of a correction; corrections are of order one
_UNBOUNDED = wp.constant(UNBOUNDED)
ROUNDING = wp.constant(wp.float64(1e-6))  # a diagonal this much smaller than its cells' sum is a singular aggregate's rounding


@wp.func
def lower_weight(w: wp.array3d(dtype=Any), uniform: wp.float64, k: int, j: int, i: int):
    """Weight of a lower face."""
    c = uniform
    if w.shape[0] > 0:
        c = wp.float64(w[k, j, i])
    return c


@wp.kernel(**options)
def coarsen_kernel(
    A: StencilShape,
    d: wp.array3d(dtype=Any),
    wx: wp.array3d(dtype=Any),
    wy: wp.array3d(dtype=Any),
    wz: wp.array3d(dtype=Any),
    n: wp.vec3i,
    periodic: wp.vec3i,
    dc: wp.array3d(dtype=Any),
    wxc: wp.array3d(dtype=Any),
    wyc: wp.array3d(dtype=Any),
    wzc: wp.array3d(dtype=Any),
):
    """Diagonal and lower weights of one aggregate; n = (nz, ny, nx) of the finer level, periodic = along x, y, z."""
    kc, jc, ic = wp.tid()
    total = wp.float64(0.0)
    inner = wp.float64(0.0)
    sx = wp.float64(0.0)
    sy = wp.float64(0.0)
    sz = wp.float64(0.0)
    for a in range(2):
        for b in range(2):
            for c in range(2):
                k = 2 * kc + 1 + a
                j = 2 * jc + 1 + b
                i = 2 * ic + 1 + c
                if k <= n[0] and j <= n[1] and i <= n[2]:
                    if d[k, j, i] != d.dtype(0):
                        total += A.unit * wp.float64(d[k, j, i])
                        im = i - 1
                        if i == 1 and periodic[0] != 0:
                            im = n[2]
                        if im > 0 and d[k, j, im] != d.dtype(0):
                            w = lower_weight(wx, A.cx, k, j, i)
                            if (im - 1) // 2 == ic:
                                inner += w
                            else:
                                sx += w
                        jm = j - 1
                        if j == 1 and periodic[1] != 0:
                            jm = n[1]
                        if jm > 0 and d[k, jm, i] != d.dtype(0):
                            w = lower_weight(wy, A.cy, k, j, i)
                            if (jm - 1) // 2 == jc:
                                inner += w
                            else:
                                sy += w
                        km = k - 1
                        if k == 1 and periodic[2] != 0:
                            km = n[0]
                        if km > 0 and d[km, j, i] != d.dtype(0):
                            w = lower_weight(wz, A.cz, k, j, i)
                            if (km - 1) // 2 == kc:
                                inner += w
                            else:
                                sz += w
    value = total - wp.float64(2.0) * inner
    if value < ROUNDING * total:
        value = wp.float64(0.0)
    dc[kc + 1, jc + 1, ic + 1] = dc.dtype(value)
    wxc[kc + 1, jc + 1, ic + 1] = wxc.dtype(sx)
    wyc[kc + 1, jc + 1, ic + 1] = wyc.dtype(sy)
    wzc[kc + 1, jc + 1, ic + 1] = wzc.dtype(sz)


@wp.kernel(**options)
def bounds_kernel(
    d: wp.array3d(dtype=Any),
    x: wp.array3d(dtype=Any),
    lower: wp.array3d(dtype=Any),
    upper: wp.array3d(dtype=Any),
    n: wp.vec3i,
    scale: Any,
    lower_c: wp.array3d(dtype=Any),
    upper_c: wp.array3d(dtype=Any),
):
    """Bounds of a coarse correction: the tightest of its cells' gaps, divided by the over-correction; 0 is always allowed."""
    kc, jc, ic = wp.tid()
    zero = lower.dtype(0)
    lo = lower.dtype(-_UNBOUNDED)
    hi = lower.dtype(_UNBOUNDED)
    for a in range(2):
        for b in range(2):
            for c in range(2):
                k = 2 * kc + 1 + a
                j = 2 * jc + 1 + b
                i = 2 * ic + 1 + c
                if k <= n[0] and j <= n[1] and i <= n[2]:
                    if d[k, j, i] != d.dtype(0):
                        lo = wp.max(lo, wp.min((lower[k, j, i] - x[k, j, i]) / scale, zero))
                        hi = wp.min(hi, wp.max((upper[k, j, i] - x[k, j, i]) / scale, zero))
    lower_c[kc + 1, jc + 1, ic + 1] = lo
    upper_c[kc + 1, jc + 1, ic + 1] = hi


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
            wp.overload(coarsen_kernel, [StencilShape, d, f, f, f, wp.vec3i, wp.vec3i, f, f, f, f])
            wp.overload(bounds_kernel, [d, f, f, f, wp.vec3i, real, f, f])
            wp.overload(factor_kernel, [StencilShape, d, f, f, f, wp.vec3i, wp.vec3i, wp.array2d(dtype=wp.float64)])
        wp.overload(solve_coarsest_kernel, [wp.array2d(dtype=wp.float64), wp.vec3i, f, f])


_overload()
