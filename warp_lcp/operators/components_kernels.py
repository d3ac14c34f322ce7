# mypy: ignore-errors
"""Kernels that find connected components without a Dirichlet neighbor: union-find by atomic minima, the same on CPU and CUDA."""

from typing import Any

import warp as wp

from warp_lcp.operators.grid_poisson_kernels import AIR, FLUID, coefficient

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))

options = {"enable_backward": False, "module": "warp_lcp.components"}


@wp.func
def find(parent: wp.array(dtype=wp.int32), i: int):
    """Root of i: parents always have smaller indices."""
    r = int(i)
    while parent[r] != r:
        r = parent[r]
    return r


@wp.func
def unite(parent: wp.array(dtype=wp.int32), i: int, j: int):
    """Join the trees of i and j; the smaller root stays one. A lost race is seen in the old value and tried again."""
    a = find(parent, i)
    b = find(parent, j)
    while a != b:
        if a < b:
            t = a
            a = b
            b = t
        old = wp.atomic_min(parent, a, b)
        if old == a:
            b = a  # done: a was a root and hangs below b now
        else:
            a = find(parent, old)
            b = find(parent, b)


@wp.kernel(**options)
def singletons_kernel(parent: wp.array(dtype=wp.int32)):
    """Each cell is a tree of its own."""
    i = wp.tid()
    parent[i] = i


@wp.kernel(**options)
def unite_kernel(
    cells: wp.array3d(dtype=wp.int8),
    face_x: wp.array3d(dtype=Any),
    face_y: wp.array3d(dtype=Any),
    face_z: wp.array3d(dtype=Any),
    uniform: wp.vec3d,
    n: wp.vec3i,
    parent: wp.array(dtype=wp.int32),
):
    """Join FLUID cells across faces with a coefficient; ghost cells of periodic axes stand for the cells at the other end."""
    k, j, i = wp.tid()
    k += 1
    j += 1
    i += 1
    if cells[k, j, i] != _FLUID:
        return
    ny2 = n[1] + 2
    nx2 = n[2] + 2
    p = (k * ny2 + j) * nx2 + i
    if cells[k, j, i - 1] == _FLUID and coefficient(face_x, uniform[0], k, j, i) > wp.float64(0.0):
        q = p - 1
        if i == 1:
            q = p + n[2] - 1
        unite(parent, p, q)
    if cells[k, j - 1, i] == _FLUID and coefficient(face_y, uniform[1], k, j, i) > wp.float64(0.0):
        q = p - nx2
        if j == 1:
            q = p + (n[1] - 1) * nx2
        unite(parent, p, q)
    if cells[k - 1, j, i] == _FLUID and coefficient(face_z, uniform[2], k, j, i) > wp.float64(0.0):
        q = p - ny2 * nx2
        if k == 1:
            q = p + (n[0] - 1) * ny2 * nx2
        unite(parent, p, q)


@wp.kernel(**options)
def ground_kernel(
    cells: wp.array3d(dtype=wp.int8),
    face_x: wp.array3d(dtype=Any),
    face_y: wp.array3d(dtype=Any),
    face_z: wp.array3d(dtype=Any),
    uniform: wp.vec3d,
    shift: wp.array3d(dtype=Any),
    parent: wp.array(dtype=wp.int32),
    grounded: wp.array(dtype=wp.uint8),
):
    """Flatten the trees and mark roots of components that touch AIR through a face with a coefficient, or have a shift."""
    k, j, i = wp.tid()
    k += 1
    j += 1
    i += 1
    p = (k * cells.shape[1] + j) * cells.shape[2] + i
    if cells[k, j, i] != _FLUID:
        return
    root = find(parent, p)
    zero = wp.float64(0.0)
    hit = cells[k, j, i - 1] == _AIR and coefficient(face_x, uniform[0], k, j, i) > zero
    hit = hit or (cells[k, j, i + 1] == _AIR and coefficient(face_x, uniform[0], k, j, i + 1) > zero)
    hit = hit or (cells[k, j - 1, i] == _AIR and coefficient(face_y, uniform[1], k, j, i) > zero)
    hit = hit or (cells[k, j + 1, i] == _AIR and coefficient(face_y, uniform[1], k, j + 1, i) > zero)
    hit = hit or (cells[k - 1, j, i] == _AIR and coefficient(face_z, uniform[2], k, j, i) > zero)
    hit = hit or (cells[k + 1, j, i] == _AIR and coefficient(face_z, uniform[2], k + 1, j, i) > zero)
    if shift.shape[0] > 0:
        hit = hit or wp.float64(shift[k, j, i]) > zero
    if hit:
        grounded[root] = wp.uint8(1)


@wp.kernel(**options)
def count_floating_kernel(
    cells: wp.array(dtype=wp.int8),
    parent: wp.array(dtype=wp.int32),
    grounded: wp.array(dtype=wp.uint8),
    count: wp.array(dtype=wp.int32),
):
    """Count components that no AIR and no shift holds."""
    p = wp.tid()
    if cells[p] == _FLUID and parent[p] == p and grounded[p] == wp.uint8(0):
        wp.atomic_add(count, 0, 1)


@wp.kernel(**options)
def component_sums_kernel(
    label: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.uint8),
    r: wp.array(dtype=Any),
    sums: wp.array(dtype=wp.float64),
    held: wp.array(dtype=wp.int32),
):
    """Sum r over each component, and note which have an unknown that is not free."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if free[i] != wp.uint8(0):
            wp.atomic_add(sums, c, wp.float64(r[i]))
        else:
            held[c] = 1


@wp.kernel(**options)
def remove_means_kernel(
    label: wp.array(dtype=wp.int32),
    sums: wp.array(dtype=wp.float64),
    held: wp.array(dtype=wp.int32),
    sizes: wp.array(dtype=wp.float64),
    r: wp.array(dtype=Any),
):
    """Take the mean off every component that is free as a whole."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            r[i] = r[i] - r.dtype(sums[c] / sizes[c])


@wp.kernel(**options)
def smallest_gap_kernel(
    label: wp.array(dtype=wp.int32),
    x: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    below: wp.array(dtype=wp.float64),
    above: wp.array(dtype=wp.float64),
):
    """Smallest distance to the lower and to the upper bounds over each component."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        wp.atomic_min(below, c, x[i] - lower[i])
        wp.atomic_min(above, c, upper[i] - x[i])


@wp.kernel(**options)
def shift_components_kernel(
    label: wp.array(dtype=wp.int32), held: wp.array(dtype=wp.int32), constant: wp.array(dtype=wp.float64), x: wp.array(dtype=wp.float64)
):
    """Add each component's constant, where the component is free as a whole."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            x[i] = x[i] + constant[c]


for _T in (wp.float32, wp.float64):
    _F, _L = wp.array3d(dtype=_T), wp.array(dtype=wp.int32)
    _C, _S = wp.array3d(dtype=wp.int8), wp.array(dtype=wp.float64)
    wp.overload(unite_kernel, [_C, _F, _F, _F, wp.vec3d, wp.vec3i, _L])
    wp.overload(ground_kernel, [_C, _F, _F, _F, wp.vec3d, _F, _L, wp.array(dtype=wp.uint8)])
    wp.overload(component_sums_kernel, [_L, wp.array(dtype=wp.uint8), wp.array(dtype=_T), _S, _L])
    wp.overload(remove_means_kernel, [_L, _S, _L, _S, wp.array(dtype=_T)])
