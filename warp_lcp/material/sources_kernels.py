# mypy: ignore-errors
"""Kernels of sources: velocity on faces, cell types, particle counts."""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import (
    F32,
    I8,
    I32,
    INTS,
    POINTS,
    cell_below,
    cell_kernel,
    list_kernel,
)
from warp_lcp.grid.staggered import cell_index
from warp_lcp.kernels import KernelFile
from warp_lcp.operators.grid_poisson import FLUID, SOLID

_FLUID = wp.constant(wp.int8(FLUID))
_SOLID = wp.constant(wp.int8(SOLID))
_BYTES = wp.array(dtype=wp.uint8)

ENTER = KernelFile(Path(__file__).parent / "headers/particle_models.h")[
    "warp_lcp.material.sources.enter"
]


@wp.func
def source_of(slot: int, sources: INTS, running: _BYTES):
    """Return the running source of a slot; -1 if there is none (slot 0: none)."""
    source = int(-1)
    if slot > 0:
        source = sources[slot - 1]
        if running[source] == wp.uint8(0):
            source = -1
    return source


@cell_kernel("warp_lcp.material.sources")
def impose_kernel(
    k,
    j,
    i,
    axis: int,
    supply: int,
    slots: I32,
    sources: INTS,
    running: _BYTES,
    velocities: POINTS,
    field: F32,
    solid: F32,
    known: I8,
):
    """Set the velocity on the faces of the running sources' cells.

    With `supply`, faces where the flow would enter a source are closed to the pressure: the
    source's material does not come from the material behind it.
    """
    c, b, a = cell_below(axis, k, j, i)
    if slots[k, j, i] > 0 or slots[c, b, a] > 0:
        here = source_of(slots[k, j, i], sources, running)
        below = source_of(slots[c, b, a], sources, running)
        source = wp.where(here >= 0, here, below)
        if source >= 0:
            value = velocities[source][axis]
            if supply != 0 and ((below < 0 and value > 0.0) or (here < 0 and value < 0.0)):
                value = float(0.0)
            field[k, j, i] = value
            if solid:
                solid[k, j, i] = value
            if known:
                known[k, j, i] = wp.int8(1)
        elif solid:
            solid[k, j, i] = 0.0


@cell_kernel("warp_lcp.material.sources")
def occupy_kernel(
    k,
    j,
    i,
    slots: I32,
    sources: wp.array(dtype=wp.int32),
    running: wp.array(dtype=wp.uint8),
    fluid: int,
    kind: I8,
):
    """Mark the cells of running sources as SOLID, or as material with `fluid`.

    SOLID, since the velocities of their faces are given.
    """
    if source_of(slots[k, j, i], sources, running) >= 0:
        kind[k, j, i] = wp.where(fluid != 0, _FLUID, _SOLID)


@list_kernel("warp_lcp.material.sources")
def occupants_kernel(
    i, inverse_dx: float, n: wp.vec3i, origin: wp.vec3i, slots: I32, position: POINTS, counts: INTS
):
    """Count the particles in each slot."""
    # Cell of a particle: floor(x / dx) + 1 - origin along each axis, since layer 0 is the ring
    # around the grid; 1 along z in 2-D. Slot 0: the cell belongs to no source.
    x = position[i] * inverse_dx
    k = int(1)
    if slots.shape[0] > 3:
        k = cell_index(x[2] + 1.0 - float(origin[2]), n[2])
    slot = slots[
        k,
        cell_index(x[1] + 1.0 - float(origin[1]), n[1]),
        cell_index(x[0] + 1.0 - float(origin[0]), n[0]),
    ]
    if slot > 0:
        wp.atomic_add(counts, slot - 1, 1)
