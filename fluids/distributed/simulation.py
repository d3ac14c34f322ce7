"""Liquid on the ranks of MPI: what `warp_lcp.distributed.particle_simulation` says of the particles, and one pressure of all ranks."""

from __future__ import annotations

from functools import partial

import numpy as np

from warp_lcp.distributed.particle_simulation import SharedParticleSimulation
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.fluids.distributed.coupling import SharedBodyCoupling
from warp_lcp.fluids.distributed.pressure import DistributedPressure
from warp_lcp.fluids.distributed.probes import SharedProbes
from warp_lcp.fluids.distributed.surface import SharedSurface
from warp_lcp.fluids.distributed.tension import SharedSurfaceTension
from warp_lcp.fluids.distributed.unilateral import SharedUnilateralPressure
from warp_lcp.fluids.distributed.viscosity import SharedViscosity
from warp_lcp.fluids.models import make_coupling, make_pressure, make_surface, make_tension, make_viscosity
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.probes import Probes
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.simulator import LiquidSimulation
from warp_lcp.fluids.surface import FreeSurface
from warp_lcp.fluids.surface_tension import SurfaceTension
from warp_lcp.fluids.viscosity import Viscosity
from warp_lcp.grid.staggered import Window
from warp_lcp.material.particle_log import Row
from warp_lcp.simulation import Part


class DistributedLiquid(LiquidSimulation, SharedParticleSimulation):
    """A rank's part of a liquid in progress, see `SharedParticleSimulation`; made of what `LiquidSimulation` and that take."""

    scene: LiquidScene
    particles: SharedParticles
    projection: DistributedPressure
    surface: SharedSurface

    def _surface(self) -> FreeSurface:
        part = self.part
        return SharedSurface(part, make_surface(self.scene, self.grid, self.boundary, self._fill_density(), part.owned))

    def _tension(self) -> SurfaceTension | None:
        return make_tension(self.scene, self.grid, self.boundary, self.surface, partial(SharedSurfaceTension, self.part))

    def _pressure(self) -> PressureProjection:
        scene, grid, boundary, part = self.scene, self.grid, self.boundary, self.part
        coupling = make_coupling(scene, grid, boundary, self.bodies, partial(SharedBodyCoupling, part))
        makers = partial(DistributedPressure, part), partial(SharedUnilateralPressure, part)
        return make_pressure(scene, grid, boundary, self.surface.surface, self.weights, coupling, *makers)

    def _probes(self) -> Probes | None:
        return SharedProbes(self.part, self.scene.probe, self.gravity, self.part.dimension) if self.scene.probe else None

    def frame(self) -> list[Part]:
        """Return this rank's particles and cells, see the base class."""
        return self.in_box(super().frame())

    def _viscosity(self) -> Viscosity | None:
        return make_viscosity(self.scene, self.grid, self.boundary, self.surface, self.bodies, partial(SharedViscosity, self.part))

    def mark(self) -> None:
        """Find the liquid's cells, and show them."""
        with self.with_ghosts():
            super().mark()

    def step(self, dt: float) -> Row:
        """Advance by dt [s]; see the base class. What it raises is raised on all ranks."""
        with self.attempt(dt):
            return super().step(dt)

    def particles_to_grid(self, window: Window) -> None:
        """Bring the particles' velocities to the faces, and viscosities, which ghosts' own ghosts would have a share in."""
        super().particles_to_grid(window)
        if self.viscosity is not None and self.viscosity.relative:
            self.part.fill(*self.viscosity.relative, *self.weights)

    def _rub(self, viscosity: Viscosity, window: Window, dt: float, speed: float) -> Row:
        """Change the velocity by what viscosity does to that after the pressure, by which nothing moves, however fast it is."""
        self._dt = 0.0
        row = super()._rub(viscosity, window, dt, speed)
        self._dt = dt
        return row

    def _meet_walls(self, window: Window, dt: float) -> Row:
        """Collect what the projection has done to solids in this rank's box, and let walls drag there."""
        row = super()._meet_walls(self.part.own_faces, dt)
        if self.wall_drag is not None:
            self.part.fill(*self.velocity)
        return {name: float(self.part.ranks.sum(value)) for name, value in row.items()}

    def _of_all(self, impulses: np.ndarray) -> np.ndarray:
        return np.asarray(self.part.ranks.sum(impulses))

    def _measure(self) -> None:
        """Fill the rows of the tables by what all ranks have found."""
        if self.forces is not None and self.scene.output.forces:
            self.forces.impulses = self._of_all(self.forces.impulses)
        super()._measure()
