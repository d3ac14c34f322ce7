"""Liquid on the ranks of MPI: what `warp_lcp.distributed.particle_simulation` says of the particles, and one pressure of all ranks."""

from __future__ import annotations

from warp_lcp.distributed.particle_simulation import SharedParticleSimulation
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.simulator import LiquidSimulation
from warp_lcp.fluids.viscosity import Viscosity
from warp_lcp.grid.staggered import Window
from warp_lcp.material.particle_log import Row
from warp_lcp.simulation import Part


class DistributedLiquid(LiquidSimulation, SharedParticleSimulation):
    """A rank's part of a liquid in progress, see `SharedParticleSimulation`; made of what `LiquidSimulation` and that take."""

    scene: LiquidScene
    particles: SharedParticles

    def frame(self) -> list[Part]:
        """Return this rank's particles and cells, see the base class."""
        return self.in_box(super().frame())

    def mark(self) -> None:
        """Find the liquid's cells, and show them."""
        with self.with_ghosts():
            super().mark()

    def step(self, dt: float) -> Row:
        """Advance by dt [s]; see the base class. What it raises is raised on all ranks."""
        with self.attempt(dt):
            return super().step(dt)

    def _rub(self, viscosity: Viscosity, window: Window, dt: float, speed: float) -> Row:
        """Change the velocity by what viscosity does to that after the pressure, by which nothing moves, however fast it is."""
        self._dt = 0.0
        row = super()._rub(viscosity, window, dt, speed)
        self._dt = dt
        return row
