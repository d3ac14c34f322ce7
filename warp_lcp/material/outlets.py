"""Where material leaves: drains and open sides of the domain. Their particles are removed."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.grid.particles import Particles
from warp_lcp.grid.sides import mark_gone
from warp_lcp.grid.solids import Geometry
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.sources import NOW


@wp.kernel(enable_backward=False, module="warp_lcp.material.outlets")
@typing.no_type_check
def mark_inside_kernel(distance: wp.array(dtype=wp.float32), marks: wp.array(dtype=wp.int32)):
    """Mark particles at a negative distance."""
    p = wp.tid()
    if distance[p] < 0.0:
        marks[p] = 1


@dataclass(frozen=True)
class Drain:
    """A region that swallows material.

    Args:
        geometry: the region.
        start: when it opens [s].
        stop: when it closes [s].
    """

    geometry: Geometry
    start: float = 0.0
    stop: float = np.inf

    def opens(self, before: float, now: float) -> bool:
        """Tell whether it is open at a time after `before` and up to `now` [s]."""
        return self.start <= now + NOW and before + NOW < self.stop


class Outlets:
    """Remove the particles that are in a drain or have crossed an open side.

    A drain acts at the end of each step in part of which it is open, however small that part is.

    Args:
        grid: the grid.
        drains: regions that swallow material.
        open_sides: of the domain, see `warp_lcp.grid.sides.side_bits`.
    """

    def __init__(self, grid: StaggeredGrid, drains: Sequence[Drain], open_sides: int) -> None:
        """Keep the arguments."""
        self.grid, self.drains, self.open_sides = grid, tuple(drains), open_sides
        self._distance = wp.zeros(0, dtype=wp.float32, device=grid.device)

    def apply(self, particles: Particles, before: float, now: float) -> tuple[int, int]:
        """Remove particles; the others keep their order.

        Args:
            particles: the material (updated).
            before: at the start of the step [s].
            now: at its end [s].

        Returns:
            How many drains have swallowed, and how many have left through open sides.
        """
        departed, drained = self.remove_departed(particles), 0
        drains = [drain for drain in self.drains if drain.opens(before, now)]
        if drains and particles.count:
            marks = particles.marks
            marks.zero_()
            if len(self._distance) < particles.count:
                self._distance = wp.zeros(particles.capacity, dtype=wp.float32, device=self.grid.device)
            for drain in drains:
                distance = self._distance[: particles.count]
                drain.geometry.signed_distance(particles.position, distance)
                wp.launch(mark_inside_kernel, particles.count, [distance, marks], device=self.grid.device)
            drained = particles.remove(marks)
        return drained, departed

    def remove_departed(self, particles: Particles) -> int:
        """Remove the particles that have crossed an open side, and return how many."""
        if not (self.open_sides and particles.count):
            return 0
        marks = particles.marks
        mark_gone(self.grid, self.open_sides, particles.position, marks)
        return particles.remove(marks)
