# mypy: ignore-errors
"""Legs of a multigrid cycle on a box of cells among those of other processes, by one CPU thread.

What is cheap to compute twice saves passes over memory: the first sweep from zero in ghost cells needs only their right-hand side, the
correction there only the coarser level's ghost cells. Then a sweep follows in the same pass that would have had to wait for an exchange.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.multigrid.cycle_kernels import RING, Aggregates, cycle_kernels
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_first, row_start


@wp.func
def row_at(A: StencilShape, k: int, j: int):
    """Element of the first cell of row (k, j); rows -1 and beyond the last one are ghosts."""
    return wp.int64(k + 1) * A.s1 + wp.int64(j + 1) * A.s2 + wp.int64(1)


@wp.func
def in_ring(A: StencilShape, k: int):
    """Elements from plane k of a field, from -1 on, to its place among three planes of it that are no ghosts."""
    return wp.int64((k + 1) % RING - k) * A.s1


@wp.func
def coarse_index(i: int, n: int, f: int, coarse: int):
    """Stored row or plane of the aggregate of cell i of n: ghosts belong to ghosts."""
    c = i // f + 1
    if i < 0:
        c = 0
    elif i >= n:
        c = coarse + 1
    return c


@functools.cache
def shared_cycle_kernels(variable: bool, d_type: Any, real: Any) -> SimpleNamespace:
    """Return `descend`, two sweeps from zero, and `ascend`, the correction and a sweep; types as of `cycle_kernels`."""
    rows_of = cycle_kernels(variable, d_type, real).parts
    first_sweep_to, sweep_between, correct_row = rows_of.first_sweep_to, rows_of.sweep_between, rows_of.correct_row
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.shared_cycle.{form}_{d_type.__name__}_{real.__name__}"
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    @wp.func_native("""for (int k = 0; k < nx; ++k) if (k < first || k >= first + n) t_.data[row + k] = 0;""")
    def clear_around(t_: field, row: wp.int64, first: int, n: int, nx: int): ...

    @wp.func
    def first_sweep_row_to(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, k: int, j: int, inner: bool, t: field, x: field, b: field,
        lower: field, upper: field, omega: real,
    ):  # fmt: skip
        """Sweep row (k, j) from zero into the ring; a row of this box with its two ghost cells, one of others without."""
        ring = in_ring(A, k)
        row = row_at(A, k, j)
        if inner:
            first = row_first(A, k, j, 0, A.nx)
            n = row_count(A, k, j, 0, A.nx)
            if A.spans:  # those of the plane that was here before may be wider
                clear_around(t, row + ring, first, n, A.nx)
            p = row + wp.int64(first)
            first_sweep_to(A, d, wx, wy, wz, t, p + ring, x, p, b, lower, upper, p, n, omega, False)
            p = row - wp.int64(1)
            first_sweep_to(A, d, wx, wy, wz, t, p + ring, x, p, b, lower, upper, p, 1, omega, False)
            p = row + wp.int64(A.nx)
            first_sweep_to(A, d, wx, wy, wz, t, p + ring, x, p, b, lower, upper, p, 1, omega, False)
        else:
            first_sweep_to(A, d, wx, wy, wz, t, row + ring, x, row, b, lower, upper, row, A.nx, omega, False)

    @wp.kernel(enable_backward=False, module=name)
    def descend(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, planes: int, rows: int, x: field, b: field, t: field, lower: field,
        upper: field, first: real, second: real,
    ):  # fmt: skip
        """Two sweeps from x = 0; b's ghost cells are filled."""
        for s in range(-1, planes + 1):
            if s >= 0 and s < planes:
                for j in range(-1, rows + 1):
                    first_sweep_row_to(A, d, wx, wy, wz, s, j, j >= 0 and j < rows, t, x, b, lower, upper, first)
            else:
                for j in range(rows):
                    first_sweep_row_to(A, d, wx, wy, wz, s, j, False, t, x, b, lower, upper, first)
            i = s - 1
            if i >= 0:
                ring = in_ring(A, i)
                down = in_ring(A, i - 1) - ring - A.s1
                up = in_ring(A, i + 1) - ring + A.s1
                for j in range(rows):
                    p = row_start(A, i, j, 0, A.nx)
                    n = row_count(A, i, j, 0, A.nx)
                    sweep_between(A, d, wx, wy, wz, x, p, t, p + ring, down, up, b, lower, upper, p, n, second, False)

    @wp.func
    def correct_row_of(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, C: StencilShape, G: Aggregates, planes: int, rows: int, k: int,
        j: int, inner: bool, x: field, coarse: field, lower: field, upper: field, scale: real,
    ):  # fmt: skip
        """Correct row (k, j); a row of this box with its two ghost cells, one of others without."""
        row = row_at(A, k, j)
        o = wp.int64(coarse_index(k, G.nz, G.fz, planes)) * C.s1 + wp.int64(coarse_index(j, G.ny, G.fy, rows)) * C.s2
        if inner:
            first = row_first(A, k, j, 0, A.nx)
            n = row_count(A, k, j, 0, A.nx)
            p = row + wp.int64(first)
            c = o + wp.int64(1 + first // G.fx)
            correct_row(A, d, wx, wy, wz, x, p, coarse, c, lower, upper, n, G.fx - 1, scale, False)
            correct_row(A, d, wx, wy, wz, x, row - wp.int64(1), coarse, o, lower, upper, 1, 0, scale, False)
            c = o + wp.int64(C.nx + 1)
            correct_row(A, d, wx, wy, wz, x, row + wp.int64(A.nx), coarse, c, lower, upper, 1, 0, scale, False)
        else:
            correct_row(A, d, wx, wy, wz, x, row, coarse, o + wp.int64(1), lower, upper, A.nx, G.fx - 1, scale, False)

    @wp.kernel(enable_backward=False, module=name)
    def ascend(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, C: StencilShape, G: Aggregates, planes: int, rows: int, x: field,
        b: field, t: field, lower: field, upper: field, coarse: field, omega: real, scale: real,
    ):  # fmt: skip
        """Correction, and a sweep from x into t; ghost cells of x and of the coarser level's correction are filled."""
        for s in range(-1, G.nz + 1):
            if s >= 0 and s < G.nz:
                for j in range(-1, G.ny + 1):
                    inner = j >= 0 and j < G.ny
                    correct_row_of(A, d, wx, wy, wz, C, G, planes, rows, s, j, inner, x, coarse, lower, upper, scale)
            else:
                for j in range(G.ny):
                    correct_row_of(A, d, wx, wy, wz, C, G, planes, rows, s, j, False, x, coarse, lower, upper, scale)
            i = s - 1
            if i >= 0:
                for j in range(G.ny):
                    p = row_start(A, i, j, 0, A.nx)
                    n = row_count(A, i, j, 0, A.nx)
                    sweep_between(A, d, wx, wy, wz, t, p, x, p, -A.s1, A.s1, b, lower, upper, p, n, omega, False)

    return SimpleNamespace(descend=descend, ascend=ascend)
