"""Taubin smoothing of a closed surface, which does not shrink it.

Each round is a step of Laplacian smoothing and a slightly longer step back.
"""

import typing
from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, POINTS, interpolated
from warp_lcp.grid.marching_cubes import DeviceMesh
from warp_lcp.grid.particle_loops import chunks
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.compiler import forward_kernel

# Lattice cells from the domain's side. Points that close the surface there are 0.01 off its other
# sides.
TOUCHING = 0.015
ON_SIDE, ON_SOLID = 1, 2  # bits of a point's mark
# Lattice cells. Tolerance of a point on a solid: the accuracy of a distance that is linear between
# nodes.
NEAR = 0.25

_SUMS, _BYTES = wp.array2d(dtype=wp.float32), wp.array(dtype=wp.uint8)
_options = {"module": "warp_lcp.grid.mesh_smoothing"}

KERNELS = KernelFile(Path(__file__).parent / "headers/surface_mesh.h")
SEE_NEIGHBORS = KERNELS["warp_lcp.grid.mesh_smoothing.see_neighbors"]


@forward_kernel(**_options)
@typing.no_type_check
def hold_kernel(
    planes: int,
    dx: float,
    origin: wp.vec3,
    points: POINTS,
    room: F32,
    counts: wp.vec3,
    held: _BYTES,
):
    """Mark fixed points: those on the domain's sides, and those on solids.

    The marks are ON_SIDE + ON_SOLID. The surface so ends in an edge at the sides.
    """
    p = wp.tid()
    x = points[p] / dx
    mark = int(0)
    for axis in range(planes + 1):
        if x[axis] < TOUCHING or x[axis] > counts[axis] - TOUCHING:
            mark = ON_SIDE
    if room:
        if (
            interpolated(
                room, planes, x[0] + 0.5 - origin[0], x[1] + 0.5 - origin[1], x[2] + 0.5 - origin[2]
            )
            < NEAR
        ):
            mark = mark + ON_SOLID
    held[p] = wp.uint8(mark)


@forward_kernel(**_options)
@typing.no_type_check
def move_kernel(
    share: float,
    most: float,
    sums: _SUMS,
    held: _BYTES,
    size: wp.vec3,
    start: POINTS,
    points: POINTS,
):
    """Move a point a share of the way to the mean of its neighbors.

    It stays within the domain and within a distance `most` of its start.

    In m, with the mean of its neighbors, sums[p, :3] / sums[p, 3]:

        x <- x + share (mean - x),   then   |x - start| <= most,   then   0 <= x <= size.

    A negative share is the step back of Taubin's smoothing.
    """
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
    points[p] = wp.vec3(
        wp.clamp(x[0], 0.0, size[0]), wp.clamp(x[1], 0.0, size[1]), wp.clamp(x[2], 0.0, size[2])
    )


# Shares of the way to the neighbors' mean. Waves longer than about 9 points keep their height,
# shorter ones lose it.
FORTH, BACK = 0.5, -0.53
# Lattice cells that a point may move. Facets are shallower; drops of few points are not squeezed to
# nothing.
MOST = 0.3


def smooth(
    mesh: DeviceMesh, lattice: StaggeredGrid, room: wp.array | None, rounds: int
) -> wp.array:
    """Smooth a surface; points on the domain's sides and on solids are fixed.

    Args:
        mesh: a closed surface from `warp_lcp.grid.marching_cubes` (updated).
        lattice: the grid that it was found on.
        room: distance to solids at the lattice's cell centers [lattice cells], float32; None if
            there are no solids.
        rounds: steps forth and back; each lets a point look two points farther.

    Returns:
        Marks of the points that are fixed, uint8, shape (points,).
    """
    device, count = lattice.device, len(mesh.points)
    flags = wp.zeros(count, dtype=wp.uint8, device=device)
    if not count:
        return flags
    ends = [wp.vec3(*numbers) for numbers in (lattice.origin, lattice.domain_counts)]
    wp.launch(
        hold_kernel,
        count,
        [lattice.planes, lattice.spacing, ends[0], mesh.points, room, ends[1], flags],
        device=device,
    )
    start, most = wp.clone(mesh.points), MOST * lattice.spacing
    # Sums of the neighbors' coordinates, and the number of neighbors.
    sums = wp.empty((count, 4), dtype=wp.float32, device=device)
    size = wp.vec3(*lattice.extent)
    rows = chunks(len(mesh.corners), device)
    for share in (FORTH, BACK) * rounds:
        sums.zero_()
        SEE_NEIGHBORS.bind(rows, corners=mesh.corners, points=mesh.points, sums=sums).launch()
        wp.launch(
            move_kernel, count, [share, most, sums, flags, size, start, mesh.points], device=device
        )
    return flags
