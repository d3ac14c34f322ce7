"""Volumes of a material for renderers: distance to the surface, and density."""

from __future__ import annotations

import numpy as np

from warp_lcp.grid.level_set import Fill, LevelSet
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.boundary import Boundary
from warp_lcp.simulation import Volume

VOLUME_BYTES = 13  # fields of the level set, per cell
VELOCITY_BYTES = 60  # points, velocities and faces while a frame is measured, per cell, at most


class ParticleVolume:
    """Measure a material on the cells of its grid when a frame is written.

    Args:
        grid: a 3-D grid.
        boundary: solids and walls.
        particles_a_cell: number of particles in a cell of the material at rest.
        with_velocity: whether frames also have the velocity, all volumes in one file.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        *,
        particles_a_cell: int,
        with_velocity: bool = False,
    ) -> None:
        self._grid, self._boundary, self.with_velocity = grid, boundary, with_velocity
        self._level_set = LevelSet(grid, particles_a_cell=particles_a_cell)

    def measure(self, particles: Particles, *, fill: Fill | None = None) -> list[Volume]:
        """Return the volumes `level_set` and `density`.

        `level_set` is the distance to the surface [m], < 0 inside; `density` is in units of that at
        rest.

        Args:
            particles: particles of the material; on CUDA they are sorted, as the next step would
                do, where the order is needed.
            fill: adds the density of material without particles, in a window.
        """
        if particles.offsets is not None:
            particles.sort()
        grid, level_set = self._grid, self._level_set
        level_set.update(
            particles, grid.everywhere, self._boundary.capacity, self._boundary.base, fill=fill
        )
        spacing, band = grid.spacing, level_set.limit * grid.spacing
        distance = grid.interior(level_set.phi.numpy()) * np.float32(spacing)
        density = grid.interior(level_set.density.numpy()).copy()
        return [
            Volume("level_set", distance, spacing, band, grid.origin),
            Volume("density", density, spacing, origin=grid.origin),
        ]
