# mypy: ignore-errors
"""Row functions of a multigrid cycle for kernels that are no passes: small levels in one launch, and legs among ranks."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.multigrid.cycle_passes import HEADERS
from warp_lcp.native import C_TYPES
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_first, row_start
from warp_lcp.rows.row_pass import HEADERS as ROWS
from warp_lcp.rows.row_pass import text

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
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    def row(header: str, declared: str) -> str:
        """Source of a row function of the cycle's passes for levels whose fields are separate arguments."""
        types = f"typedef {C_TYPES[real]} S; typedef S T; constexpr int STENCIL = {ord(form[0])}; const double* known = nullptr;"
        at = " ".join(f"const auto* {w} = {w}_.data + p;" for w in ("d", "wx", "wy", "wz"))
        numbers = " ".join(f"const T {c} = (T)A.{c};" for c in ("unit", "cx", "cy", "cz"))
        strides = "const long long ym = -A.s2, yp = A.s2, zm = -A.s1, zp = A.s1;"
        parts = [text(ROWS / "native.h"), types, at, strides, numbers, text(ROWS / "stencil.h"), declared, text(HEADERS / header)]
        return "\n".join(["", *parts, ""])

    bounds = "const T *lower = l_.data + p, *upper = u_.data ? u_.data + p : nullptr;"
    fields = f"T* y = y_.data + to; const T *x = x_.data + start, *b = b_.data + p; {bounds}"

    @wp.func_native(row("sweep.h", f"{fields} const bool from_zero = false;"))
    def sweep_between(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, y_: field, to: wp.int64, x_: field, start: wp.int64,
        down: wp.int64, up: wp.int64, b_: field, l_: field, u_: field, p: wp.int64, n: int, omega: real, projected: bool,
    ): ...  # fmt: skip

    @wp.func_native(row("sweep.h", f"{fields} const bool from_zero = true; const long long down = 0, up = 0;"))
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

    aggregates = "const bool pairs = cells == 2; const int deep = one_plane ? 1 : 2, wide = one_row ? 1 : 2; const T* x = x_.data + p;"

    @wp.func_native(row("restrict.h", f"{aggregates} const T* b = b_.data + p; T* coarse = c_.data + c;"))
    def restrict_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, c_: field, c: wp.int64, x_: field, b_: field, p: wp.int64,
        n: int, cells: int, one_plane: bool, one_row: bool,
    ): ...  # fmt: skip

    @wp.func_native(row("correct.h", f"T* x = x_.data + p; const T* coarse = c_.data + c; {bounds}"))
    def correct_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, x_: field, p: wp.int64, c_: field, c: wp.int64, l_: field,
        u_: field, n: int, pairs: int, scale: real, projected: bool,
    ): ...  # fmt: skip

    coarse_fields = "T *coarse_lower = lc_.data + c, *coarse_upper = uc_.data ? uc_.data + c : nullptr;"

    @wp.func_native(row("coarse_bounds.h", f"{aggregates} {bounds} {coarse_fields}"))
    def bounds_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, x_: field, l_: field, u_: field, lc_: field, uc_: field,
        c: wp.int64, p: wp.int64, n: int, scale: real, cells: int, one_plane: bool, one_row: bool,
    ): ...  # fmt: skip

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
        relax=relax_kernel,
        rows=SimpleNamespace(sweep=sweep_row, first_sweep=first_sweep_row, restrict=restrict_row, bounds=bounds_row, correct=correct_row),
        parts=SimpleNamespace(first_sweep_to=first_sweep_to, sweep_between=sweep_between, correct_row=correct_row),
    )
