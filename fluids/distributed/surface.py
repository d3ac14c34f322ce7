"""The free surface of liquid that ranks share."""

from __future__ import annotations

import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.surface import FreeSurface, WholeCellSurface
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import Window


class SharedSurface:
    """The free surface of liquid that ranks share: each finds it on its part, with what others know of the cells beside.

    `mark` and `volume` are collective.

    Args:
        part: where this rank works; its particles come with ghosts.
        surface: on that part, its volume counted in the box.

    Attributes:
        surface: as given; others as of `FreeSurface`.
    """

    def __init__(self, part: Subdomain, surface: FreeSurface) -> None:
        self.phi, self.density, self.complete, self._part, self.surface = surface.phi, surface.density, surface.complete, part, surface

    def begin(self, window: Window) -> None:
        """Clear what the last step has left elsewhere."""
        self.surface.begin(window)

    def mark(self, particles: Particles, window: Window, kind: wp.array) -> None:
        """Write the cells' kinds, those of the ghost layers and what they come from by other ranks."""
        self.surface.mark(particles, window, kind)
        self._part.fill(kind, *([] if self.phi is None else [self.phi]))

    def measure(self) -> None:
        """Find the volume of this rank's liquid."""
        self.surface.measure()

    def volume(self, cells: int) -> float:
        """Return the volume of all ranks' liquid, given the number of all FLUID cells."""
        mine = self.surface.volume(cells)
        return mine if isinstance(self.surface, WholeCellSurface) else float(self._part.ranks.sum(mine))
