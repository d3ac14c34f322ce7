"""The free surface of liquid that ranks share: each finds it on its part, with what others know of the cells beside."""

from __future__ import annotations

import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.assembly import stays_full
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.surface import FreeSurface, GhostFluidSurface, NoSurface, WholeCellSurface
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import Window
from warp_lcp.material.boundary import Boundary


def make_shared_surface(scene: LiquidScene, part: Subdomain, boundary: Boundary) -> FreeSurface:
    """Return the free surface that a scene asks for on a rank's part, whose particles come with ghosts; `mark`, `volume` are collective."""
    if stays_full(scene, boundary):
        return SharedFull(part, boundary)
    count = scene.particles.per_axis**part.grid.dimension
    if scene.pressure.surface == "ghost-fluid":
        return SharedGhostFluid(part, boundary, particles_a_cell=count, smoothing=scene.pressure.smoothing)
    return SharedWholeCells(part, boundary, particles_a_cell=count)


class SharedWholeCells(WholeCellSurface):
    """`WholeCellSurface` on a rank's part."""

    def __init__(self, part: Subdomain, boundary: Boundary, *, particles_a_cell: int) -> None:
        super().__init__(part.grid, boundary, particles_a_cell=particles_a_cell, fill=lambda window, density: part.fill(density))
        self._part = part

    def mark(self, particles: Particles, window: Window, kind: wp.array) -> None:
        """Write the cells' kinds."""
        super().mark(particles, window, kind)
        self._part.fill(kind)


class SharedGhostFluid(GhostFluidSurface):
    """`GhostFluidSurface` on a rank's part."""

    def __init__(self, part: Subdomain, boundary: Boundary, *, particles_a_cell: int, smoothing: int) -> None:
        super().__init__(
            part.grid, boundary, particles_a_cell=particles_a_cell, smoothing=smoothing, fill=lambda window, density: part.fill(density)
        )
        self._part = part

    def mark(self, particles: Particles, window: Window, kind: wp.array) -> None:
        """Write the cells' kinds: FLUID below the surface."""
        super().mark(particles, window, kind)
        self._part.fill(self.level_set.phi, kind)

    def volume(self, cells: int) -> float:
        """Return the volume inside the surface."""
        window = self._part.clipped(self._window)
        mine = self.level_set.volume(self.boundary.distance, window) if window is not None else 0.0
        return float(self._part.ranks.sum(mine))


class SharedFull(NoSurface):
    """`NoSurface` on a rank's part."""

    def __init__(self, part: Subdomain, boundary: Boundary) -> None:
        super().__init__(part.grid, boundary, part.owned)
        self._volume = float(part.ranks.sum(self._volume))
