"""Fields on grids, and distances of points."""

import numpy as np
import warp as wp

from warp_lcp.grid.staggered import StaggeredGrid


def distances(geometry, points, device="cpu"):
    """Return the signed distances of points to a shape, shape (n,)."""
    out = wp.empty(len(points), dtype=wp.float32, device=device)
    geometry.signed_distance(wp.array(points, dtype=wp.vec3, device=device), out)
    return out.numpy()


def uniform_velocity(grid: StaggeredGrid, velocity: tuple[float, ...]) -> list[wp.array]:
    """Return a uniform velocity on the faces."""
    faces = grid.faces()
    for field, speed in zip(faces, velocity, strict=False):
        field.fill_(speed)
    return faces


def particles_of_cells(grid, particles) -> np.ndarray:
    """Return the particles of each cell, shape (nz, ny, nx)."""
    cells = particles.cells_of(particles.position.numpy())
    nx, ny, nz = grid.counts
    return np.bincount(
        (cells[:, 2] * ny + cells[:, 1]) * nx + cells[:, 0], minlength=nx * ny * nz
    ).reshape(nz, ny, nx)
