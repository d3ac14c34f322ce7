# mypy: ignore-errors
"""Kernels that turn cell types and face coefficients into the diagonal and the weights of a stencil."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES, simd
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_start
from warp_lcp.vector_kernels import flat, span_end, span_start

AIR = 0
FLUID = 1
SOLID = 2

options = {"enable_backward": False, "module": "warp_lcp.grid_poisson"}


@wp.func_native(simd("const signed char* c = cells.data + p; signed char* o = out.data + p; SIMD for (int k = 0; k < n; ++k) o[k] = c[k];"))
def copy_row(cells: wp.array(dtype=wp.int8), out: wp.array(dtype=wp.int8), p: wp.int64, n: int): ...


@wp.func_native(
    simd(
        """const signed char* c = cells.data + p; unsigned char* o = d.data + p;
    const unsigned char x = along_x, y = along_y, z = along_z;
    auto open = [&](long long k, unsigned char axis) -> unsigned char { return c[k] != 2 ? axis : (unsigned char)0; };
    auto count = [&](int k) {
        const unsigned char v = open(k - 1, x) + open(k + 1, x) + open(k - s2, y) + open(k + s2, y) + open(k - s1, z) + open(k + s1, z);
        o[k] = c[k] == 1 ? v : (unsigned char)0; };
    const int whole = n/64*64;
    SIMD64 for (int k = 0; k < whole; ++k) count(k);
    SIMD for (int k = whole; k < n; ++k) count(k);"""
    )
)
def count_faces_row(
    cells: wp.array(dtype=wp.int8),
    d: wp.array(dtype=wp.uint8),
    p: wp.int64,
    s1: wp.int64,
    s2: wp.int64,
    n: int,
    along_x: int,
    along_y: int,
    along_z: int,
): ...


@wp.kernel(**options)
def copy_cells_kernel(A: StencilShape, cells: wp.array(dtype=wp.int8), out: wp.array(dtype=wp.int8), grain: int):
    """Interior cells are copied; ghost cells keep what they are, SOLID."""
    k, j, c = wp.tid()
    copy_row(cells, out, row_start(A, k, j, c, grain), wp.min(grain, A.nx - c * grain))


@wp.kernel(**options)
def count_faces_kernel(A: StencilShape, cells: wp.array(dtype=wp.int8), axes: wp.vec3i, d: wp.array(dtype=wp.uint8), grain: int):
    """Diagonal of unit coefficients: the number of open faces of a FLUID cell along the axes that count."""
    k, j, c = wp.tid()
    n = wp.min(grain, A.nx - c * grain)
    count_faces_row(cells, d, row_start(A, k, j, c, grain), A.s1, A.s2, n, axes[0], axes[1], axes[2])


@functools.cache
def coefficient_kernels(arrays: tuple[bool, bool, bool], shifted: bool, real: Any) -> SimpleNamespace:
    """Return `diagonal` and `weights` for coefficients that are arrays along these axes and numbers along the others.

    The diagonal is the sum of the coefficients over a FLUID cell's open faces, plus the shift. The weight of a lower face is its
    coefficient where it joins two FLUID cells, else 0; the ghost cells above the last ones have lower faces too.
    """
    name = f"warp_lcp.grid_poisson.{''.join('na'[a] for a in arrays)}_{shifted}_{real.__name__}"
    field, i8, T = wp.array(dtype=real), wp.array(dtype=wp.int8), C_TYPES[real]
    axes = "xyz"
    steps = dict(zip(axes, ("1", "s2", "s1"), strict=True))
    head = "const signed char* c = cells.data + p; const long long s1 = A.s1, s2 = A.s2;"
    head += "".join(f"const {T}* f{a} = face_{a}.data + p; const {T} n{a} = ({T})uniform_{a};" for a in axes)

    def face(axis: str, at: str) -> str:
        return f"f{axis}[{at}]" if arrays[axes.index(axis)] else f"n{axis}"

    total = " + ".join(
        f"(c[k-{steps[a]}] != 2 ? {face(a, 'k')} : ({T})0) + (c[k+{steps[a]}] != 2 ? {face(a, f'k+{steps[a]}')} : ({T})0)" for a in axes
    )
    extra = " + shift.data[p + k]" if shifted else ""
    joined = "".join(f"w{a}.data[p + k] = ((c[k] == 1) & (c[k-{steps[a]}] == 1)) ? {face(a, 'k')} : ({T})0;" for a in axes)

    @wp.func_native(
        simd(
            head
            + f"""{T}* o = d.data + p;
        SIMD for (int k = 0; k < n; ++k) {{ const {T} v = {total}{extra}; o[k] = c[k] == 1 ? v : ({T})0; }}"""
        )
    )
    def diagonal_row(
        A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, uniform_x: wp.float64, uniform_y: wp.float64,
        uniform_z: wp.float64, shift: field, d: field, p: wp.int64, n: int,
    ): ...  # fmt: skip

    @wp.func_native(simd(head + f"SIMD for (int k = 0; k < n; ++k) {{ {joined} }}"))
    def weights_row(
        A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, uniform_x: wp.float64, uniform_y: wp.float64,
        uniform_z: wp.float64, wx: field, wy: field, wz: field, p: wp.int64, n: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def diagonal(
        A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, uniform: wp.vec3d, shift: field, d: field, grain: int
    ):
        k, j, c = wp.tid()
        p = row_start(A, k, j, c, grain)
        n = row_count(A, k, j, c, grain)
        diagonal_row(A, cells, face_x, face_y, face_z, uniform[0], uniform[1], uniform[2], shift, d, p, n)

    @wp.kernel(enable_backward=False, module=name)
    def weights(
        A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, uniform: wp.vec3d, wx: field, wy: field, wz: field,
        grain: int,
    ):  # fmt: skip
        k, j, c = wp.tid()
        p = row_start(A, k, j, c, grain)
        n = row_count(A, k, j, c, grain)
        weights_row(A, cells, face_x, face_y, face_z, uniform[0], uniform[1], uniform[2], wx, wy, wz, p, n)

    return SimpleNamespace(diagonal=diagonal, weights=weights)


@functools.cache
def mask_diagonal_kernel(d_type: Any, out_type: Any) -> Any:
    """Return the kernel that copies the diagonal on the free set and writes 0 elsewhere."""
    name = f"warp_lcp.grid_poisson.mask_{d_type.__name__}_{out_type.__name__}"
    d_array, out_array, u8 = wp.array(dtype=d_type), wp.array(dtype=out_type), wp.array(dtype=wp.uint8)
    target = C_TYPES[out_type]

    @wp.func_native(flat(f"EACH {{ out.data[i] = free.data[i] != 0 ? ({target})d.data[i] : ({target})0; }}"))
    def mask_span(d: d_array, free: u8, out: out_array, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.kernel(enable_backward=False, module=name)
    def mask_diagonal(d: d_array, free: u8, out: out_array, n: int, chunk: int, stride: wp.int64):
        t = wp.tid()
        mask_span(d, free, out, span_start(t, chunk), span_end(t, chunk, n), stride)

    return mask_diagonal


@wp.kernel(**options)
def mask_and_shift_kernel(
    d: wp.array(dtype=Any), unit: wp.float64, free: wp.array(dtype=wp.uint8), shift: wp.array(dtype=Any), out: wp.array(dtype=Any)
):
    """Diagonal plus shift on the free set, 0 elsewhere."""
    i = wp.tid()
    v = wp.float64(0.0)
    if free[i] != wp.uint8(0):
        v = unit * wp.float64(d[i]) + wp.float64(shift[i])
    out[i] = out.dtype(v)


_U8 = wp.array(dtype=wp.uint8)
for _D in (wp.uint8, wp.float32, wp.float64):
    for _T in (wp.float32, wp.float64):
        wp.overload(mask_and_shift_kernel, [wp.array(dtype=_D), wp.float64, _U8, wp.array(dtype=_T), wp.array(dtype=_T)])
