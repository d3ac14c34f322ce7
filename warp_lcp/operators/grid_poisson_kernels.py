# mypy: ignore-errors
"""Kernels that turn cell types and face coefficients into the diagonal and the weights of a stencil."""

import functools
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES, simd
from warp_lcp.operators.stencil_kernels import StencilShape, row_start
from warp_lcp.vector_kernels import flat, span_end, span_start

AIR = 0
FLUID = 1
SOLID = 2

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))
_SOLID = wp.constant(wp.int8(SOLID))

options = {"enable_backward": False, "module": "warp_lcp.grid_poisson"}


@wp.func_native(simd("const signed char* c = cells.data + p; signed char* o = out.data + p; SIMD for (int k = 0; k < n; ++k) o[k] = c[k];"))
def copy_row(cells: wp.array(dtype=wp.int8), out: wp.array(dtype=wp.int8), p: wp.int64, n: int): ...


@wp.func_native(
    simd(
        """const signed char* c = cells.data + p; unsigned char* o = d.data + p;
    const unsigned char x = along_x, y = along_y, z = along_z;
    SIMD for (int k = 0; k < n; ++k) {
        const unsigned char v = x*(unsigned char)((c[k-1] != 2) + (c[k+1] != 2)) + y*(unsigned char)((c[k-s2] != 2) + (c[k+s2] != 2))
            + z*(unsigned char)((c[k-s1] != 2) + (c[k+s1] != 2));
        o[k] = c[k] == 1 ? v : (unsigned char)0; }"""
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


@wp.func
def joins(cells: wp.array3d(dtype=wp.int8), k: int, j: int, i: int, dk: int, dj: int, di: int):
    """Whether the face between a cell and its lower neighbor joins two FLUID cells."""
    return cells[k, j, i] == _FLUID and cells[k - dk, j - dj, i - di] == _FLUID


@wp.func
def coefficient(face: wp.array3d(dtype=Any), uniform: wp.float64, k: int, j: int, i: int):
    """Return a face's coefficient: from the array if there is one, else the uniform number."""
    c = uniform
    if face.shape[0] > 0:
        c = wp.float64(face[k, j, i])
    return c


@wp.kernel(**options)
def diagonal_kernel(
    cells: wp.array3d(dtype=wp.int8),
    face_x: wp.array3d(dtype=Any),
    face_y: wp.array3d(dtype=Any),
    face_z: wp.array3d(dtype=Any),
    uniform: wp.vec3d,
    shift: wp.array3d(dtype=Any),
    d: wp.array3d(dtype=Any),
):
    """Diagonal of general coefficients: their sum over a FLUID cell's open faces, plus the shift."""
    k, j, i = wp.tid()
    k += 1
    j += 1
    i += 1
    s = wp.float64(0.0)
    if cells[k, j, i] == _FLUID:
        if cells[k, j, i - 1] != _SOLID:
            s += coefficient(face_x, uniform[0], k, j, i)
        if cells[k, j, i + 1] != _SOLID:
            s += coefficient(face_x, uniform[0], k, j, i + 1)
        if cells[k, j - 1, i] != _SOLID:
            s += coefficient(face_y, uniform[1], k, j, i)
        if cells[k, j + 1, i] != _SOLID:
            s += coefficient(face_y, uniform[1], k, j + 1, i)
        if cells[k - 1, j, i] != _SOLID:
            s += coefficient(face_z, uniform[2], k, j, i)
        if cells[k + 1, j, i] != _SOLID:
            s += coefficient(face_z, uniform[2], k + 1, j, i)
        if shift.shape[0] > 0:
            s += wp.float64(shift[k, j, i])
    d[k, j, i] = d.dtype(s)


@wp.kernel(**options)
def weights_kernel(
    cells: wp.array3d(dtype=wp.int8), face: wp.array3d(dtype=Any), uniform: wp.float64, step: wp.vec3i, w: wp.array3d(dtype=Any)
):
    """Weight of a lower face: its coefficient where it joins two FLUID cells, else 0. The last layer of ghosts has lower faces too."""
    k, j, i = wp.tid()
    k += 1
    j += 1
    i += 1
    c = wp.float64(0.0)
    if joins(cells, k, j, i, step[0], step[1], step[2]):
        c = coefficient(face, uniform, k, j, i)
    w[k, j, i] = w.dtype(c)


for _T in (wp.float32, wp.float64):
    _A = wp.array3d(dtype=_T)
    wp.overload(diagonal_kernel, [wp.array3d(dtype=wp.int8), _A, _A, _A, wp.vec3d, _A, _A])
    wp.overload(weights_kernel, [wp.array3d(dtype=wp.int8), _A, wp.float64, wp.vec3i, _A])


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
