# mypy: ignore-errors
"""Kernels that number particles by cell, reorder them and add them up."""

import warp as wp

from warp_lcp.grid.cell_kernel import list_kernel
from warp_lcp.grid.particle_loops import HEADERS, cell_pass, particle_pass

_PARTICLES, _COUNTS = "warp_lcp.grid.particles", {"nx": int, "ny": int, "nz": int}
NUMBER = particle_pass(f"{_PARTICLES}.number", {"position": wp.vec3}, whole={"key": wp.int32}, numbers=_COUNTS)
TOTAL = particle_pass(
    f"{_PARTICLES}.total", {"position": wp.vec3, "velocity": wp.vec3}, sums=("energy", "x", "y", "z", "u", "v", "w", "lost", "wild"),
    largest=("top", "high_x", "high_y", "high_z", "low_x", "low_y", "low_z"),
)  # fmt: skip

APART = 16  # numbers between the counts of two pieces, so that they do not share a set of the cache
_INTS, _SORT = wp.int32, {"headers": HEADERS, "constants": {"APART": APART}}
SORT_COUNT = cell_pass(
    f"{_PARTICLES}.sort_count", "", {"key": _INTS}, whole={"counts": _INTS}, numbers={"shift": int, "digits": int}, **_SORT
)
SORT_BEGIN = cell_pass(f"{_PARTICLES}.sort_begin", "", {"counts": _INTS}, numbers={"pieces": int, "digits": int}, **_SORT)
SORT_PLACE = cell_pass(
    f"{_PARTICLES}.sort_place", "", {"key": _INTS}, whole=dict.fromkeys(("counts", "order", "sorted", "moved"), _INTS), optional=("order",),
    numbers={"shift": int, "digits": int}, **_SORT,
)  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def count_up_kernel(order: wp.array(dtype=wp.int32)):
    """Write 0, 1, 2, ..."""
    p = wp.tid()
    order[p] = p


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def offset_kernel(key: wp.array(dtype=wp.int32), count: int, offsets: wp.array(dtype=wp.int32)):
    """Find the first particle of each cell, or of the next one that has any, among sorted keys."""
    cell = wp.tid()
    if cell > key[count - 1]:  # lower_bound would return the last particle
        offsets[cell] = count
    else:
        offsets[cell] = wp.lower_bound(key, 0, count, cell)


@list_kernel("warp_lcp.grid.particles")
def reorder_kernel(i, order: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3)):
    """Take the particles in a new order."""
    target[i] = source[order[i]]


@list_kernel("warp_lcp.grid.particles")
def put_kernel(i, order: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3)):
    """Put particles where they are wanted."""
    target[order[i]] = source[i]


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def stays_kernel(marks: wp.array(dtype=wp.int32), stays: wp.array(dtype=wp.int32)):
    """Write 1 for a particle without a mark, 0 for others."""
    p = wp.tid()
    stays[p] = wp.where(marks[p] == 0, 1, 0)


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def close_ranks_kernel(
    marks: wp.array(dtype=wp.int32), stay: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3)
):
    """Move particles without a mark to where `stay`, the number of those up to and with each, says."""
    p = wp.tid()
    if marks[p] == 0:
        target[stay[p] - 1] = source[p]
