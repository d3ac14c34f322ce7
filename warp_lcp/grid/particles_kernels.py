# mypy: ignore-errors
"""Kernels that number particles by cell, reorder them and add them up."""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import list_kernel
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.compiler import forward_kernel

KERNELS = KernelFile(Path(__file__).parent / "headers/particles.h")
NUMBER = KERNELS["warp_lcp.grid.particles.number"]
TOTAL = KERNELS["warp_lcp.grid.particles.total"]
ADD_IN_ORDER = KERNELS["warp_lcp.grid.particles.add_in_order"]
CLOSE_RANKS = KERNELS["warp_lcp.grid.particles.close_ranks"]  # on the CPU

APART = 16  # numbers between the counts of two pieces, so that they do not share a set of the cache
_SORT = {"APART": APART}
SORT_COUNT = KERNELS.kernel("warp_lcp.grid.particles.sort_count", constants=_SORT)
SORT_BEGIN = KERNELS.kernel("warp_lcp.grid.particles.sort_begin", constants=_SORT)
SORT_PLACE = KERNELS.kernel("warp_lcp.grid.particles.sort_place", constants=_SORT)


@forward_kernel(module="warp_lcp.grid.particles")
def count_up_kernel(
    order: wp.array(dtype=wp.int32), key: wp.array(dtype=wp.int32), count: int, last: int
):
    """Write 0, 1, 2, ... and, after the particles' keys, a key larger than all others."""
    p = wp.tid()
    order[p] = p
    if p >= count:
        key[p] = last


@forward_kernel(module="warp_lcp.grid.particles")
def offset_kernel(key: wp.array(dtype=wp.int32), count: int, offsets: wp.array(dtype=wp.int32)):
    """Find the first particle of each cell, or of the next nonempty one.

    The keys are sorted.
    """
    cell = wp.tid()
    if cell > key[count - 1]:  # lower_bound would return the last particle
        offsets[cell] = count
    else:
        offsets[cell] = wp.lower_bound(key, 0, count, cell)


@list_kernel("warp_lcp.grid.particles")
def reorder_kernel(
    i,
    order: wp.array(dtype=wp.int32),
    source: wp.array(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
):
    """Copy the particles in a new order."""
    target[i] = source[order[i]]


@list_kernel("warp_lcp.grid.particles_removal")
def stays_kernel(
    i,
    marks: wp.array(dtype=wp.int32),
    stays: wp.array(dtype=wp.int32),
    removed: wp.array(dtype=wp.int32),
):
    """Write 1 for each particle without a mark, else 0, and count removed particles.

    Those with the mark 1 are counted apart from those with another mark.
    """
    mark = marks[i]
    stays[i] = wp.where(mark == 0, 1, 0)
    if mark != 0:
        wp.atomic_add(removed, wp.where(mark == 1, 0, 1), 1)


@forward_kernel(module="warp_lcp.grid.particles")
def close_ranks_kernel(
    marks: wp.array(dtype=wp.int32),
    stay: wp.array(dtype=wp.int32),
    source: wp.array(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
):
    """Move particles without a mark to their places after a removal.

    `stay` is the inclusive prefix sum of the particles that stay.
    """
    p = wp.tid()
    if marks[p] == 0:
        target[stay[p] - 1] = source[p]
