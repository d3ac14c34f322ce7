"""Smooth a closed surface without shrinking it, as Taubin does: a step of Laplacian smoothing, then a slightly longer one back."""

from __future__ import annotations

import warp as wp

from warp_lcp.grid import mesh_smoothing_kernels as kernels
from warp_lcp.grid.marching_cubes import Mesh
from warp_lcp.grid.particle_loops import chunks
from warp_lcp.grid.staggered import StaggeredGrid

FORTH, BACK = 0.5, -0.53  # shares of the way to the neighbors' mean: waves longer than about 9 points keep their height, short ones lose it
MOST = 0.3  # lattice cells that a point may move: facets are shallower, drops of few points are not squeezed to nothing


def smooth(mesh: Mesh, lattice: StaggeredGrid, room: wp.array | None, rounds: int) -> None:
    """Move the points of a surface but for those on the domain's sides and on solids.

    Args:
        mesh: a closed surface from `warp_lcp.grid.marching_cubes` (updated).
        lattice: the grid that it was found on.
        room: distance to solids at the lattice's cell centers [lattice cells], float32; None: there are no solids.
        rounds: steps forth and back; each lets a point look two points farther.
    """
    device, count = lattice.device, len(mesh.points)
    if not count or not rounds:
        return
    held = wp.empty(count, dtype=wp.uint8, device=device)
    wp.launch(
        kernels.hold_kernel, count, [lattice.planes, lattice.spacing, mesh.points, room, wp.vec3(*lattice.counts), held], device=device
    )
    start, most = wp.clone(mesh.points), MOST * lattice.spacing
    sums = wp.empty((count, 4), dtype=wp.float32, device=device)  # of the neighbors' coordinates, and how many they are
    size = wp.vec3(*(n * lattice.spacing for n in lattice.counts))
    rows = chunks(len(mesh.corners), device)
    for share in (FORTH, BACK) * rounds:
        sums.zero_()
        kernels.SEE_NEIGHBORS.bind(rows, corners=mesh.corners, points=mesh.points, sums=sums).launch()
        wp.launch(kernels.move_kernel, count, [share, most, sums, held, size, start, mesh.points], device=device)
