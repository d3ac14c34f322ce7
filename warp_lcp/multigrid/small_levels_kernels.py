# mypy: ignore-errors
"""Kernels that run all small levels of a hierarchy in one block of threads: a cycle's stages one after another, and their rebuilding.

On a GPU a level of 16^3 cells takes less time than its launches. Here a launch is one block, whose threads share the cells of each stage
and meet at a barrier after it. On the CPU the same kernels run with one thread, a row at a time. The row functions are those of the
kernels that launch each stage by itself.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.multigrid.coarsen_kernels import coarsen_kernels
from warp_lcp.multigrid.cycle_kernels import Aggregates, coarse_start, cycle_kernels, first_cell, one_plane, one_row
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_start

CUDA_THREADS = 1024  # of the block: latency is all there is to hide, and a block of a GPU holds no more

SWEEP = wp.constant(0)
RESTRICT = wp.constant(1)
CORRECT = wp.constant(2)
SOLVE = wp.constant(3)
WRAP = wp.constant(4)


@wp.struct
class Stage:
    """One step of a cycle.

    SWEEP t from x, or x from t if `back`; RESTRICT the residual (and the bounds) to the next level; CORRECT x by the next level's; SOLVE
    the coarsest level; WRAP x, or t if `back`: fill its ghost cells along periodic axes.
    """

    op: int
    level: int
    back: bool
    from_zero: bool
    omega: wp.float64


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
"""
)
def meet(): ...


# row r of inverse b; threads read the columns of the symmetric inverse side by side, several loads under way at a time
PRODUCT = """
const double* column = inverse_.data + r; double v = 0;
for (int k = 1; k <= n[0]; ++k)
    for (int j = 1; j <= n[1]; ++j) {
        const auto* b = b_.data + k*A.s1 + j*A.s2 + 1;
#if defined(__CUDA_ARCH__)
#pragma unroll 4
#endif
        for (int i = 0; i < n[2]; ++i) v += column[i*m]*(double)b[i];
        column += n[2]*m; }
return v;
"""


@functools.cache
def small_levels_kernels(variable: bool, d_type: Any, real: Any) -> SimpleNamespace:
    """Return the struct `SmallLevel` and the kernels `cycle` and `rebuild` for levels stored in this form.

    Every thread of the block passes every barrier: loops around one have bounds that are the same for all threads.
    """
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.small_levels.{form}_{d_type.__name__}_{real.__name__}"
    d_array, field, square = wp.array(dtype=d_type), wp.array(dtype=real), wp.array2d(dtype=wp.float64)
    rows = cycle_kernels(variable, d_type, real).rows
    sweep_row, first_sweep_row, restrict_row, bounds_row, correct_row = (
        rows.sweep, rows.first_sweep, rows.restrict, rows.bounds, rows.correct
    )  # fmt: skip
    coarsen_chunk = coarsen_kernels(variable, d_type, real).chunk

    @wp.struct
    class SmallLevel:
        """A level: its sizes, its fields, and how the cells of the level before it make up its own."""

        n: wp.vec3i  # cells along z, y, x
        periodic: wp.vec3i  # x, y, z
        grain: int  # cells that a thread takes at a time
        chunks: int  # of a row
        A: StencilShape
        G: Aggregates
        d: d_array
        wx: field
        wy: field
        wz: field
        x: field
        b: field
        t: field
        lower: field
        upper: field

    level_array = wp.array(dtype=SmallLevel)

    @wp.func
    def sweep(levels: level_array, S: Stage, t: int, threads: int, projected: bool):
        L = levels[S.level]
        omega = real(S.omega)
        y = L.t
        x = L.x
        if S.back:
            y = L.x
            x = L.t
        for q in range(t, L.n[0] * L.n[1] * L.chunks, threads):
            j = (q // L.chunks) % L.n[1]
            k = q // (L.chunks * L.n[1])
            p = row_start(L.A, k, j, q % L.chunks, L.grain)
            n = row_count(L.A, k, j, q % L.chunks, L.grain)
            if S.from_zero:
                first_sweep_row(L.A, L.d, L.wx, L.wy, L.wz, y, x, L.b, L.lower, L.upper, p, n, omega, projected)
            else:
                sweep_row(L.A, L.d, L.wx, L.wy, L.wz, y, x, L.b, L.lower, L.upper, p, n, omega, projected)

    @wp.func
    def restrict(levels: level_array, l: int, t: int, threads: int, projected: bool, scale: real):
        """The residual and, for projected cycles, the bounds."""
        L = levels[l]
        C = levels[l + 1]
        for q in range(t, C.n[0] * C.n[1] * C.chunks, threads):
            c = q % C.chunks
            j = (q // C.chunks) % C.n[1]
            k = q // (C.chunks * C.n[1])
            n = row_count(C.A, k, j, c, C.grain)
            p = first_cell(L.A, C.A, C.G, k, j, c, C.grain)
            o = row_start(C.A, k, j, c, C.grain)
            plane = one_plane(C.G, k)
            row = one_row(C.G, j)
            restrict_row(L.A, L.d, L.wx, L.wy, L.wz, C.b, o, L.x, L.b, p, n, C.G.fx, plane, row)
            if projected:
                bounds_row(
                    L.A, L.d, L.wx, L.wy, L.wz, L.x, L.lower, L.upper, C.lower, C.upper, o, p, n, scale, C.G.fx, plane, row
                )  # fmt: skip

    @wp.func
    def correct(levels: level_array, l: int, t: int, threads: int, projected: bool, scale: real):
        L = levels[l]
        C = levels[l + 1]
        grain = C.G.fx * C.grain
        for q in range(t, L.n[0] * L.n[1] * C.chunks, threads):
            c = q % C.chunks
            j = (q // C.chunks) % L.n[1]
            k = q // (C.chunks * L.n[1])
            n = row_count(L.A, k, j, c, grain)
            p = row_start(L.A, k, j, c, grain)
            o = coarse_start(L.A, C.A, C.G, k, j, c, grain)
            correct_row(L.A, L.d, L.wx, L.wy, L.wz, L.x, p, C.x, o, L.lower, L.upper, n, C.G.fx - 1, scale, projected)

    @wp.func
    def element(L: SmallLevel, r: int):
        """Element of a stored field that holds cell r."""
        k = r // (L.n[1] * L.n[2])
        j = (r // L.n[2]) % L.n[1]
        return (k + 1) * int(L.A.s1) + (j + 1) * int(L.A.s2) + r % L.n[2] + 1

    @wp.func_native(PRODUCT)
    def product(inverse_: square, b_: field, A: StencilShape, n: wp.vec3i, r: int, m: int) -> wp.float64: ...

    @wp.func
    def solve(levels: level_array, l: int, t: int, threads: int, inverse: square):
        """X = inverse b."""
        L = levels[l]
        m = L.n[0] * L.n[1] * L.n[2]
        for r in range(t, m, threads):
            L.x[element(L, r)] = real(product(inverse, L.b, L.A, L.n, r, m))

    @wp.func
    def wrap(L: SmallLevel, f: field, t: int, threads: int):
        """Fill the ghost cells that a stencil reaches: they come from inner cells only, so all axes go at once."""
        s1 = int(L.A.s1)
        s2 = int(L.A.s2)
        if L.periodic[0] != 0:
            for q in range(t, L.n[0] * L.n[1], threads):
                p = (q // L.n[1] + 1) * s1 + (q % L.n[1] + 1) * s2
                f[p] = f[p + L.n[2]]
                f[p + L.n[2] + 1] = f[p + 1]
        if L.periodic[1] != 0:
            for q in range(t, L.n[0] * L.n[2], threads):
                p = (q // L.n[2] + 1) * s1 + q % L.n[2] + 1
                f[p] = f[p + L.n[1] * s2]
                f[p + (L.n[1] + 1) * s2] = f[p + s2]
        if L.periodic[2] != 0:
            for q in range(t, L.n[1] * L.n[2], threads):
                p = (q // L.n[2] + 1) * s2 + q % L.n[2] + 1
                f[p] = f[p + L.n[0] * s1]
                f[p + (L.n[0] + 1) * s1] = f[p + s1]

    @wp.kernel(enable_backward=False, module=name, launch_bounds=CUDA_THREADS)
    def cycle(levels: level_array, stages: wp.array(dtype=Stage), count: int, threads: int, scale: real, projected: bool, inverse: square):
        """Run the stages, a barrier after each."""
        t = wp.tid()
        for s in range(count):
            S = stages[s]
            if S.op == SWEEP:
                sweep(levels, S, t, threads, projected)
            elif S.op == RESTRICT:
                restrict(levels, S.level, t, threads, projected, scale)
            elif S.op == CORRECT:
                correct(levels, S.level, t, threads, projected, scale)
            elif S.op == SOLVE:
                solve(levels, S.level, t, threads, inverse)
            else:
                L = levels[S.level]
                f = L.x
                if S.back:
                    f = L.t
                wrap(L, f, t, threads)
            meet()

    @wp.func
    def below(L: SmallLevel, r: int, axis: int):
        """Cell before cell r along an axis; -1 where there is none."""
        step = int(1)
        if axis == 1:
            step = L.n[2]
        elif axis == 2:
            step = L.n[1] * L.n[2]
        n = L.n[2 - axis]
        q = int(-1)
        if (r // step) % n > 0:
            q = r - step
        elif L.periodic[axis] != 0:
            q = r + (n - 1) * step
        return q

    if variable:

        @wp.func
        def face(L: SmallLevel, axis: int, o: int):
            w = L.wx[o]
            if axis == 1:
                w = L.wy[o]
            elif axis == 2:
                w = L.wz[o]
            return wp.float64(w)

    else:

        @wp.func
        def face(L: SmallLevel, axis: int, o: int):
            w = L.A.cx
            if axis == 1:
                w = L.A.cy
            elif axis == 2:
                w = L.A.cz
            return w

    @wp.func
    def entry(L: SmallLevel, r: int, c: int):
        """Element (r, c) of the level's matrix."""
        a = element(L, r)
        b = element(L, c)
        v = wp.float64(0.0)
        if L.d[a] != d_type(0):
            if L.d[b] != d_type(0):
                if r == c:
                    v = L.A.unit * wp.float64(L.d[a])
                for axis in range(3):
                    if below(L, r, axis) == c:
                        v -= face(L, axis, a)
                    if below(L, c, axis) == r:  # too: a periodic axis of two cells has two faces between them
                        v -= face(L, axis, b)
        return v

    if variable:

        @wp.func
        def coarsen(levels: level_array, count: int, t: int, threads: int, stiffen: real, held: real):
            for l in range(count - 1):
                L = levels[l]
                C = levels[l + 1]
                for q in range(t, C.n[0] * C.n[1] * C.chunks, threads):
                    j = (q // C.chunks) % C.n[1]
                    k = q // (C.chunks * C.n[1])
                    coarsen_chunk(
                        k, j, q % C.chunks, L.A, L.d, L.wx, L.wy, L.wz, L.n, L.periodic, C.A, C.G, C.grain, stiffen, held, C.d, C.wx,
                        C.wy, C.wz
                    )  # fmt: skip
                meet()
                wrap(C, C.wx, t, threads)
                wrap(C, C.wy, t, threads)
                wrap(C, C.wz, t, threads)
                meet()

    else:

        @wp.func
        def coarsen(levels: level_array, count: int, t: int, threads: int, stiffen: real, held: real):
            """A level without arrays of weights is the finest, and alone here."""

    @wp.func
    def eliminate(L: SmallLevel, c: int, rounding: wp.float64, t: int, threads: int, old: square, new: square):
        """One step of Gauss-Jordan from `old` to `new`, so that no thread reads what another has written since the last barrier."""
        m = old.shape[0]
        pivot = old[c, c]
        pinned = pivot <= rounding * L.A.unit * wp.float64(L.d[element(L, c)])
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
        meet()

    @wp.kernel(enable_backward=False, module=name, launch_bounds=CUDA_THREADS)
    def rebuild(
        levels: level_array, count: int, threads: int, stiffen: real, held: real, rounding: wp.float64, other: square, inverse: square
    ):
        """Coarsen from the first level down and invert the last one.

        A pivot below `rounding` times its diagonal is a singular component's rounding: its unknown is pinned at 0. Positive
        semi-definite matrices need no other order of the pivots.
        """
        t = wp.tid()
        coarsen(levels, count, t, threads, stiffen, held)
        last = levels[count - 1]
        m = inverse.shape[0]
        for q in range(t, m * m, threads):
            if m % 2 == 0:  # after m steps to and fro the result is to lie in `inverse`
                inverse[q // m, q % m] = entry(last, q // m, q % m)
            else:
                other[q // m, q % m] = entry(last, q // m, q % m)
        meet()
        for c in range(m):
            if (m - c) % 2 == 0:
                eliminate(last, c, rounding, t, threads, inverse, other)
            else:
                eliminate(last, c, rounding, t, threads, other, inverse)

    return SimpleNamespace(SmallLevel=SmallLevel, cycle=cycle, rebuild=rebuild)
