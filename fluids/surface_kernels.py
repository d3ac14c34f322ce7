# mypy: ignore-errors
"""Kernels that say which cells hold liquid."""

import typing

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.operators.grid_poisson import AIR, FLUID

_AIR = wp.constant(wp.int8(AIR))
_FLUID = wp.constant(wp.int8(FLUID))


options: dict[str, typing.Any] = {"enable_backward": False, "module": "fluids.surface"}


@wp.kernel(**options)
def mark_particles_kernel(key: wp.array(dtype=wp.int32), kind: wp.array(dtype=wp.int8)):
    """A cell that holds a particle is FLUID."""
    cell = key[wp.tid()]
    if kind[cell] == _AIR:
        kind[cell] = _FLUID


@cell_kernel("fluids.surface")
def mark_inside_kernel(k, j, first, end, phi: F32, capacity: F32, most: float, kind: I8):
    """An open cell of the domain below the free surface is FLUID, if the share of its kernel that is open is no more than `most`."""
    for i in range(wp.max(first, 1), wp.min(end, kind.shape[2] - 1)):
        if kind[k, j, i] == _AIR and k > 0 and j > 0 and k + 1 < kind.shape[0] and j + 1 < kind.shape[1]:
            if phi[k, j, i] < 0.0 and capacity[k, j, i] <= most:
                kind[k, j, i] = _FLUID
