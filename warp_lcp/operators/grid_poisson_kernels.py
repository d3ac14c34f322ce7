# mypy: ignore-errors
"""Kernels that turn cell types and face coefficients into the diagonal and the weights of a stencil."""

from typing import Any

import warp as wp

AIR = 0
FLUID = 1
SOLID = 2

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))
_SOLID = wp.constant(wp.int8(SOLID))

options = {"enable_backward": False, "module": "warp_lcp.grid_poisson"}


@wp.kernel(**options)
def copy_cells_kernel(cells: wp.array3d(dtype=wp.int8), out: wp.array3d(dtype=wp.int8), low: wp.vec3i, high: wp.vec3i):
    """Interior cells are copied, ghost cells become SOLID."""
    k, j, i = wp.tid()
    inside = k >= low[0] and k < high[0] and j >= low[1] and j < high[1] and i >= low[2] and i < high[2]
    if inside:
        out[k, j, i] = cells[k, j, i]
    else:
        out[k, j, i] = _SOLID


@wp.func
def joins(cells: wp.array3d(dtype=wp.int8), k: int, j: int, i: int, dk: int, dj: int, di: int):
    """Whether the face between a cell and its lower neighbor joins two FLUID cells."""
    return cells[k, j, i] == _FLUID and cells[k - dk, j - dj, i - di] == _FLUID


@wp.kernel(**options)
def count_faces_kernel(cells: wp.array3d(dtype=wp.int8), axes: wp.vec3i, d: wp.array3d(dtype=wp.uint8)):
    """Diagonal of unit coefficients: the number of open faces of a FLUID cell along the axes that count."""
    k, j, i = wp.tid()
    k += 1
    j += 1
    i += 1
    n = int(0)
    if cells[k, j, i] == _FLUID:
        if axes[0] != 0:
            n += int(cells[k, j, i - 1] != _SOLID) + int(cells[k, j, i + 1] != _SOLID)
        if axes[1] != 0:
            n += int(cells[k, j - 1, i] != _SOLID) + int(cells[k, j + 1, i] != _SOLID)
        if axes[2] != 0:
            n += int(cells[k - 1, j, i] != _SOLID) + int(cells[k + 1, j, i] != _SOLID)
    d[k, j, i] = wp.uint8(n)


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


@wp.kernel(**options)
def mask_diagonal_kernel(d: wp.array(dtype=Any), free: wp.array(dtype=wp.uint8), out: wp.array(dtype=Any)):
    """The diagonal on the free set, 0 elsewhere."""
    i = wp.tid()
    v = out.dtype(0)
    if free[i] != wp.uint8(0):
        v = out.dtype(d[i])
    out[i] = v


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
for _D, _T in ((wp.uint8, wp.uint8), (wp.float32, wp.float32), (wp.float64, wp.float64), (wp.float64, wp.float32)):
    wp.overload(mask_diagonal_kernel, [wp.array(dtype=_D), _U8, wp.array(dtype=_T)])
for _D in (wp.uint8, wp.float32, wp.float64):
    for _T in (wp.float32, wp.float64):
        wp.overload(mask_and_shift_kernel, [wp.array(dtype=_D), wp.float64, _U8, wp.array(dtype=_T), wp.array(dtype=_T)])
