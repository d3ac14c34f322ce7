"""Kernels that say which cells hold liquid."""

import typing

import warp as wp

from warp_lcp.grid.staggered import CellRange
from warp_lcp.operators.grid_poisson import AIR, FLUID

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))

options: dict[str, typing.Any] = {"enable_backward": False, "module": "fluids.surface"}


@wp.kernel(**options)
@typing.no_type_check
def mark_particles_kernel(key: wp.array(dtype=wp.int32), kind: wp.array(dtype=wp.int8)):
    """A cell that holds a particle is FLUID."""
    cell = key[wp.tid()]
    if kind[cell] == _AIR:
        kind[cell] = _FLUID


@wp.kernel(**options)
@typing.no_type_check
def mark_inside_kernel(
    cells: CellRange,
    phi: wp.array3d(dtype=wp.float32),
    capacity: wp.array3d(dtype=wp.float32),
    most: float,
    kind: wp.array3d(dtype=wp.int8),
):
    """An open cell of the domain below the free surface is FLUID, if the share of its kernel that is open is no more than `most`."""
    plane, row, chunk = wp.tid()
    k = cells.k + plane
    j = cells.j + row
    first = cells.i + chunk * cells.grain
    for i in range(wp.max(first, 1), wp.min(wp.min(first + cells.grain, cells.end), kind.shape[2] - 1)):
        if kind[k, j, i] == _AIR and k > 0 and j > 0 and k + 1 < kind.shape[0] and j + 1 < kind.shape[1]:
            if phi[k, j, i] < 0.0 and capacity[k, j, i] <= most:
                kind[k, j, i] = _FLUID
