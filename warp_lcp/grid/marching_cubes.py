"""Marching cubes on a device: the surface phi = 0 as triangles, in 2-D as segments, closed and without duplicate points."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import warp as wp

from warp_lcp.grid import marching_cubes_kernels as kernels
from warp_lcp.grid.marching_cubes_table import segment_table, triangle_table
from warp_lcp.grid.staggered import StaggeredGrid, Window


@dataclass(frozen=True)
class Mesh:
    """A surface on a device.

    Attributes:
        points: [m], wp.vec3, shape (n,).
        corners: int32, shape (m, 3) of triangles, counterclockwise seen from where phi > 0, or (m, 2) of segments, phi < 0 on the left.
    """

    points: wp.array
    corners: wp.array


class MarchingCubes:
    """Find surfaces in fields of a grid.

    Args:
        grid: the grid.
    """

    def __init__(self, grid: StaggeredGrid) -> None:
        """Bring the table of cases to the device."""
        self.grid = grid
        self._table = wp.array(triangle_table() if grid.dimension == 3 else segment_table(), dtype=wp.int8, device=grid.device)

    def contour(self, phi: wp.array, number: wp.array) -> Mesh:
        """Return the surface phi = 0, linear between the cells' centers, and flat on the domain's sides where it is cut off there.

        Where it meets a side at a right angle it ends there in an edge: what crosses it between centers beside a side is put on the side.
        The same points in the same order on every run.

        Args:
            phi: float32 at cell centers, in the stored shape; > 0 in the ring, so that the surface is closed.
            number: int32 in the stored shape, scratch memory.
        """
        grid, device = self.grid, self.grid.device
        low = (1, 0, 0) if grid.dimension == 2 else (0, 0, 0)
        high = (2 if grid.dimension == 2 else grid.shape[0] - 1, grid.shape[1] - 1, grid.shape[2] - 1)
        cells = Window(low, high, device)  # between the centers of cells and of their upper neighbors
        counts = [wp.empty(cells.rows, dtype=wp.int32, device=device) for _ in range(2)]
        run = functools.partial(cells.run, whole=True, phi=phi, planes=grid.planes)
        run(kernels.COUNT, table=self._table, owned=counts[0], made=counts[1])
        ends = [wp.empty(count.size, dtype=wp.int32, device=device) for count in counts]
        for count, end in zip(counts, ends, strict=True):
            wp.utils.array_scan(count.flatten(), end, inclusive=True)
        points, corners = (int(end[-1:].numpy()[0]) for end in ends)
        mesh = Mesh(wp.empty(points, dtype=wp.vec3, device=device), wp.empty((corners, grid.dimension), dtype=wp.int32, device=device))
        run(kernels.POINTS, dx=grid.spacing, number=number, counts=counts[0], ends=ends[0], into=mesh.points)
        run(kernels.CORNERS, table=self._table, number=number, counts=counts[1], ends=ends[1], into=mesh.corners)
        return mesh
