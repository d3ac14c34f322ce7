"""Reseeding: even out the number of particles of cells deep inside the material."""

from __future__ import annotations

import itertools

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.particle_loops import PARTICLE, ListMemory
from warp_lcp.grid.particles import SORTED, Particles
from warp_lcp.grid.particles_kernels import offset_kernel
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, launch
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material import reseeding_kernels as kernels
from warp_lcp.material.boundary import Boundary

COST = 8 * PARTICLE  # work of a cell that wants particles, in cells of a usual pass


class Reseeding:
    """Reseeding: sparse cells deep inside take particles from dense neighbors.

    A flow draws particles together along some streamlines and apart along others. A density
    correction repairs the first, but voids between particles remain: they count as material as long
    as the surface does not see them, and the volume grows. A cell takes particles if no wall
    touches it, and if its surroundings of 3^dimension cells are full. If it holds fewer than
    `least`, it takes from neighbors that hold more than at rest. It takes from neighbors with more
    than `most` until it holds as many as at rest. Nothing is created or removed:

    - Mass: particles only move, to the emptiest part of the cell, by less than two cells along each
      axis.
    - Momentum and kinetic energy: each particle keeps its velocity and its gradient. Over this
      distance they differ from the flow's by as much as the interpolation errs. Angular momentum
      and the center of mass change with the particles' places.
    - The surface and bubbles of more than a cell: cells with surroundings that are not full stay
      unchanged. A whole region that is thin stays thin.

    The result is the same on every run. `apply` is collective: a rank treats its own cells and
    those beside them, whose particles it has as ghosts. After each direction all ranks agree on the
    number of particles in cells.

    Args:
        grid: the grid.
        boundary: solids and walls.
        least: number of particles below which a cell is filled up, at most that at rest.
        most: number of particles above which a cell gives some away, at least that at rest.
        particles_a_cell: number of particles in a cell of material at rest.
        every: steps between reseedings.

    Raises:
        ValueError: `least` <= `particles_a_cell` <= `most` does not hold.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        *,
        least: int,
        most: int,
        particles_a_cell: int,
        every: int,
    ) -> None:
        if not 1 <= least <= particles_a_cell <= most:
            raise ValueError(
                f"least = {least}, most = {most}: must be at least 1, and {particles_a_cell} "
                "between them"
            )
        self.grid, self.boundary, self.every = grid, boundary, every
        self.least, self.most, self.particles_a_cell = least, most, particles_a_cell
        self._count, self._takers = (
            grid.field(wp.int32),
            wp.zeros(grid.size, dtype=wp.int32, device=grid.device),
        )
        low, high = grid.part.owned.low, grid.part.owned.high
        beside = grid.window(low[::-1], [n - 1 for n in high[::-1]], grow=1).common(grid.domain)
        assert beside is not None, "a process has cells"
        self._candidates = beside  # cells that may take: this process's, and those beside them
        self._inside = ActiveWindow(grid.domain)  # those of a step
        self._setting = self._settings()
        self._seed, self._list = Scalar(), ListMemory(grid.device)
        self._finding, self._exchanging = (
            LaunchGraph(grid.device, f, at_once=grid.part.at_once)
            for f in (self._find, self._exchange)
        )
        self._offsets = wp.zeros(grid.size + 1, dtype=wp.int32, device=grid.device)
        # Number of takers, and of particles moved.
        self._numbers = wp.zeros(2, dtype=wp.int32, device=grid.device)
        steps = [(-1, 0, 1) if axis < grid.dimension else (0,) for axis in (2, 1, 0)]
        self._directions = sorted(
            (d for d in itertools.product(*steps) if any(d)), key=lambda d: sum(map(abs, d))
        )

    def _settings(self) -> kernels.ReseedingParameters:
        """Return the settings that are the same for all cells and steps, for kernels."""
        grid, s = self.grid, kernels.ReseedingParameters()
        s.planes, s.dx, s.inverse_dx = grid.planes, grid.spacing, 1.0 / grid.spacing
        s.origin, s.across = (
            wp.vec3i(*grid.origin),
            wp.vec2i(*(n + 2 for n in grid.domain_counts[:2])),
        )
        s.least, s.at_rest, s.most = self.least, self.particles_a_cell, self.most
        return s

    def apply(self, particles: Particles, window: Window, step: int) -> int:
        """Move particles; return the number of moved particles.

        Args:
            particles: the material (sorted, moved).
            window: cells that hold all particles, with two to spare on each side.
            step: number of the step, which the random part of the new places depends on.
        """
        ranks = self.grid.part.ranks
        if not ranks.any(particles.count > 0):
            return 0
        particles.arrange(SORTED)
        # Beyond open sides is air without particles; beyond that are no cells.
        inside = window.common(self._candidates)
        self._seed.value = step
        if inside is not None:
            self._inside.move_to(inside)
        variant = window.near is None, inside is None or inside.near is None
        self._finding.run(particles, window, inside is None, variant=variant)
        before, takers = self._held(), int(self._numbers.numpy()[0])
        if not ranks.any(takers > 0):
            particles.drop_ghosts()
            return 0
        self._list.set_list(takers, {"takers": self._takers})
        self._exchanging.run(particles)
        particles.drop_ghosts()
        return self._moved(before)

    def _find(self, particles: Particles, window: Window, nothing: bool) -> None:
        """Launch the particle count of each cell, and the search for cells with too few.

        With `nothing` there is nothing to search.
        """
        b, offsets = self.boundary, particles.offsets
        if offsets is None:
            offsets, count = self._offsets, particles.listed_count
            launch(
                offset_kernel,
                self.grid.size + 1,
                [particles.key, count, offsets],
                device=self.grid.device,
            )
        clear(self._numbers)
        window.launch(kernels.count_kernel, [offsets, self._count])
        self.grid.part.fill(self._count)
        if not nothing:
            base = b.base if self.grid.barriers is None else self.grid.barriers.calm
            inputs = [
                self._setting,
                self._count,
                b.capacity,
                base,
                b.touch,
                self._takers,
                self._numbers,
            ]
            self._inside.launch(kernels.find_kernel, inputs)

    def _exchange(self, particles: Particles) -> None:
        """Launch moves of particles between neighboring cells, direction by direction."""
        offsets = self._offsets if particles.offsets is None else particles.offsets
        count = int(self._list.count.value)
        inputs = [
            self._seed,
            self._setting,
            self._takers,
            offsets,
            self._count,
            particles.position,
            self._numbers,
        ]
        for direction in self._directions:
            given = [wp.vec3i(*direction), *inputs]
            launch_list(
                kernels.exchange_kernel,
                count,
                given,
                device=self.grid.device,
                cost=COST,
                ordered=True,
            )
            self.grid.part.fill(self._count)

    def _held(self) -> np.ndarray | None:
        """Return the particle counts of a rank's cells before any have moved.

        None on one process, which counts the moves.
        """
        part = self.grid.part
        return np.array(part.box_of(self._count.numpy())) if part.shared else None

    def _moved(self, before: np.ndarray | None) -> int:
        """Return the number of particles that have moved.

        A rank moves ghosts, too, so ranks count what their cells have gained.
        """
        if before is None:
            return int(self._numbers.numpy()[1])
        part = self.grid.part
        return int(part.ranks.sum(np.maximum(part.box_of(self._count.numpy()) - before, 0).sum()))
