# mypy: ignore-errors
"""Kernels that assemble the coarsest level's matrix and factor or invert it.

A pivot below `rounding` times its diagonal is rounding error of a singular component: its unknown
is fixed at 0. Positive semi-definite matrices need no pivoting.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.layout import RowLayout, stencil_struct
from warp_lcp.kernels.persistent_kernel import CUDA_THREADS, sync_block
from warp_lcp.kernels.types import DataType

square = wp.array2d(dtype=wp.float64)
# Threshold relative to the coarsest level's diagonal: rounding error of a singular component's last
# pivot, with a margin.
PINNED = {wp.float32: 3e-5, wp.float64: 1e-13}


@wp.func
def none_changed(changed: wp.array2d(dtype=wp.uint8)):
    """Return whether no row has changed."""
    found = int(0)
    for k in range(changed.shape[0]):
        for j in range(changed.shape[1]):
            if changed[k, j] != wp.uint8(0):
                found = 1
    return found == 0


@wp.func
def element(L: RowLayout, r: int):
    """Return the element of a stored field for cell r."""
    return (
        L.base
        + wp.int64(r // (L.rows * L.nx)) * L.s1
        + wp.int64((r // L.nx) % L.rows) * L.s2
        + wp.int64(r % L.nx)
    )


@wp.func
def beside(L: RowLayout, periodic: wp.vec3i, r: int, axis: int, way: int):
    """Return the cell before (way = -1) or after (1) cell r along an axis.

    -1 where there is none.
    """
    step = int(1)
    n = L.nx
    if axis == 1:
        step = L.nx
        n = L.rows
    elif axis == 2:
        step = L.nx * L.rows
        n = L.planes
    i = (r // step) % n + way
    q = int(-1)
    if i >= 0 and i < n:
        q = r + way * step
    elif periodic[axis] != 0:
        q = r - way * (n - 1) * step
    return q


@functools.cache
def coarsest_kernels(variable: bool, d_type: DataType, real: DataType) -> SimpleNamespace:
    """Return the kernels `factor` and `invert`, each in a module of its own.

    `factor` computes L D L' by one thread, `invert` works by one block. Each takes long to compile.

    The matrix has a_rr = unit d_r and a_rq = -w for each face of weight w between two unknowns. All
    arithmetic is in float64.
    """
    name = f"{'variable' if variable else 'uniform'}_{d_type.__name__}_{real.__name__}"
    Stencil = stencil_struct(d_type, real if variable else wp.float32)

    @wp.func
    def weight(S: Stencil, axis: int, at: wp.int64):
        """Return the weight of a cell's lower face."""
        w = S.cx
        if axis == 1:
            w = S.cy
        elif axis == 2:
            w = S.cz
        if S.wx:
            if axis == 0:
                w = wp.float64(S.wx[at])
            elif axis == 1:
                w = wp.float64(S.wy[at])
            else:
                w = wp.float64(S.wz[at])
        return w

    @wp.func
    def assemble(S: Stencil, L: RowLayout, periodic: wp.vec3i, r: int, matrix: square):
        """Assemble row r of the dense matrix: a_rr = unit d_r, a_rq = -w for each face.

        w is the weight of the face between the unknowns r and q. A periodic axis of two cells has
        two faces between them, whose weights add up.
        """
        for c in range(matrix.shape[0]):
            matrix[r, c] = wp.float64(0.0)
        at = element(L, r)
        if S.d[at] != d_type(0):
            matrix[r, r] = S.unit * wp.float64(S.d[at])
            axes = int(3)  # no constant: Warp would unroll the loop
            for axis in range(axes):
                below = beside(L, periodic, r, axis, -1)
                if below >= 0:
                    if S.d[element(L, below)] != d_type(0):
                        matrix[r, below] -= weight(S, axis, at)
                above = beside(L, periodic, r, axis, 1)
                if above >= 0:
                    o = element(L, above)
                    if S.d[o] != d_type(0):
                        matrix[r, above] -= weight(S, axis, o)

    @forward_kernel(module=f"warp_lcp.coarsest.factor_{name}")
    def factor(
        S: Stencil,
        L: RowLayout,
        periodic: wp.vec3i,
        rounding: wp.float64,
        changed: wp.array2d(dtype=wp.uint8),
        matrix: square,
    ):
        """Assemble and factor the matrix in place, if any row of cells has changed.

        Column by column, in the lower triangle, with s < c:

            d_c = a_cc - sum_s l_cs^2 d_s
            l_rc = (a_rc - sum_s l_rs l_cs d_s) / d_c

        The diagonal holds D.
        """
        if none_changed(changed):
            return
        m = matrix.shape[0]
        for r in range(m):
            assemble(S, L, periodic, r, matrix)
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

    @wp.func
    def eliminate(least: wp.float64, c: int, t: int, threads: int, old: square, new: square):
        """Make step c of Gauss-Jordan elimination from `old` to `new`.

        With the pivot p = a_cc:

            a_cc <- 1 / p,   a_cj <- a_cj / p,   a_ic <- -a_ic / p,   a_ij <- a_ij - a_ic a_cj / p

        After all steps the matrix is the inverse. Row and column of a pinned unknown become 0. With
        two arrays no thread reads what another has written since the last barrier.
        """
        m = old.shape[0]
        pivot = old[c, c]
        pinned = pivot <= least
        reciprocal = wp.float64(1.0) / pivot  # not used where it is infinite
        for q in range(t, m * m, threads):
            i = q // m
            j = q % m
            v = old[i, j]
            if pinned:
                if i == c or j == c:
                    v = wp.float64(0.0)
            elif i == c and j == c:
                v = reciprocal
            elif i == c:
                v = v * reciprocal
            elif j == c:
                v = -v * reciprocal
            else:
                v -= old[i, c] * (old[c, j] * reciprocal)
            new[i, j] = v
        sync_block()

    @forward_kernel(module=f"warp_lcp.coarsest.invert_{name}", launch_bounds=CUDA_THREADS)
    def invert(
        S: Stencil,
        L: RowLayout,
        periodic: wp.vec3i,
        rounding: wp.float64,
        threads: int,
        other: square,
        inverse: square,
    ):
        """Assemble the dense matrix A and compute A^-1; row by row, threads share the rows.

        Every thread of the block reaches every barrier.
        """
        t = wp.tid()
        m = inverse.shape[0]
        for r in range(t, m, threads):
            if m % 2 == 0:  # after m steps back and forth the result must be in `inverse`
                assemble(S, L, periodic, r, inverse)
            else:
                assemble(S, L, periodic, r, other)
        sync_block()
        for c in range(m):
            least = rounding * S.unit * wp.float64(S.d[element(L, c)])
            if (m - c) % 2 == 0:
                eliminate(least, c, t, threads, inverse, other)
            else:
                eliminate(least, c, t, threads, other, inverse)

    return SimpleNamespace(factor=factor, invert=invert)
