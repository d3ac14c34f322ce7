# mypy: ignore-errors
"""Kernels that smooth a closed surface."""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, POINTS
from warp_lcp.rows import RowPass

TOUCHING = 0.015  # lattice cells from the domain's side: points that close the surface there are 0.01 off its other sides
NEAR = 0.25  # lattice cells: a point on a solid, as accurately as a distance that is linear between nodes can tell

_SUMS, _BYTES = wp.array2d(dtype=wp.float32), wp.array(dtype=wp.uint8)
_options = {"enable_backward": False, "module": "warp_lcp.grid.mesh_smoothing"}

SEE_NEIGHBORS = RowPass(
    "warp_lcp.grid.mesh_smoothing.see_neighbors",
    Path(__file__).parent / "headers" / "see_neighbors.h",
    wp.float32,
    box={"corners": wp.int32},
    whole={"points": wp.vec3, "sums": wp.float32},
)


@wp.kernel(**_options)
def hold_kernel(planes: int, dx: float, points: POINTS, room: F32, counts: wp.vec3, held: _BYTES):
    """Mark points that stay: those on the domain's sides, so that these end in an edge, and on solids."""
    p = wp.tid()
    x = points[p] / dx
    stays = bool(False)
    for axis in range(planes + 1):
        if x[axis] < TOUCHING or x[axis] > counts[axis] - TOUCHING:
            stays = True
    if room:
        i = int(x[0] + 0.5)
        j = int(x[1] + 0.5)
        k = int(1)
        fz = float(0.0)
        up = int(0)
        if planes == 2:
            k = int(x[2] + 0.5)
            fz = x[2] + 0.5 - float(k)
            up = int(1)
        fx = x[0] + 0.5 - float(i)
        fy = x[1] + 0.5 - float(j)
        low = wp.lerp(wp.lerp(room[k, j, i], room[k, j, i + 1], fx), wp.lerp(room[k, j + 1, i], room[k, j + 1, i + 1], fx), fy)
        high = wp.lerp(
            wp.lerp(room[k + up, j, i], room[k + up, j, i + 1], fx), wp.lerp(room[k + up, j + 1, i], room[k + up, j + 1, i + 1], fx), fy
        )
        if wp.lerp(low, high, fz) < NEAR:
            stays = True
    held[p] = wp.where(stays, wp.uint8(1), wp.uint8(0))


@wp.kernel(**_options)
def move_kernel(share: float, most: float, sums: _SUMS, held: _BYTES, size: wp.vec3, start: POINTS, points: POINTS):
    """Move a point a share of the way to the mean of its neighbors, within the domain and not too far from where it started."""
    p = wp.tid()
    if held[p] != wp.uint8(0):
        return
    x = points[p]
    for axis in range(3):
        x[axis] += share * (sums[p, axis] / sums[p, 3] - x[axis])
    way = x - start[p]
    far = wp.length(way)
    if far > most:
        x = start[p] + (most / far) * way
    points[p] = wp.vec3(wp.clamp(x[0], 0.0, size[0]), wp.clamp(x[1], 0.0, size[1]), wp.clamp(x[2], 0.0, size[2]))
