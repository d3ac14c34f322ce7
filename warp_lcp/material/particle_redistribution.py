"""Particle redistribution: density correction and reseeding."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import warp as wp

from warp_lcp.grid.level_set import Fill
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.density_correction import Correction, DensityCorrection
from warp_lcp.material.particle_assembly import (
    make_density_correction,
    make_density_monitor,
    make_reseeding,
)
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.simulation import Stopwatch

CORRECTION_COLUMNS = ("density_status", "density_iterations", "max_density")
STATE = "density_correction"
PACE = 2.0  # factor on sqrt(dx / g): time in which an automatic correction removes the excess
# Fraction of a liquid in excess above which moving solids compress it faster than at that pace.
# Splashes among solids at rest have up to 0.034. Motions of rigid bodies do not count.
SEVERE, SEVERE_THIN = 0.03, 0.003
PASSES = 8  # most corrections in a step
# Sand that solids push: a correction that began with a cell above this density, relative to the
# densest packing, is repeated; a cell whose kernel is open by two thirds then holds 1.10 of its
# share. And most corrections in a step: each moves particles by up to half a cell, and a window has
# two cells to spare.
CROWDED_CELL, CROWDED_PASSES = 1.065, 4
# Largest density of a cell, relative to rest, beside driven thin solids; the least is 2 minus it.
MOST_THIN = 1.02


class ParticleRedistribution:
    """Particle redistribution: density correction and reseeding, when they are due.

    Without the table [density_correction], except where `ParticleScene.corrects_steadily`, a
    correction acts in steps that begin with more than the fraction `ParticleScene.most_crowded` of
    the material in excess of what cells may hold. It removes the excess over a time `PACE`
    sqrt(dx / g), so that a short step lifts little material. The density is that at the start of
    the step, which the liquid's surface and the sand's packing have computed already. Whether a
    step acts depends on the particles' positions only, so that a checkpoint needs no more state.
    The fields of the correction are allocated when it first acts.

    Moving solids may compress liquid much faster, such as a bottle that is shaken: where more
    than a fraction `SEVERE` is in excess (`SEVERE_THIN` where thin solids move), a correction
    removes more, up to all of the excess from twice that fraction on. A correction moves particles
    by half a cell at most, and is then repeated until less than that fraction is in excess.

    Sand that moving solids push is corrected in every step. The correction is repeated while a cell
    holds more than `CROWDED_CELL`: a kernel spreads over cells what a blade sweeps out of one.

    Walls that turn leave gaps: particles go straight on within a step, and along a wall at distance
    h from the center of its rotation, at omega [1/s], they depart from it by about omega^2 h dt^2 /
    2. The density there falls, so that nothing is in excess. Where thin solids are driven, each
    step therefore corrects all of the density, to 1 +- (`MOST_THIN` - 1).

    Args:
        scene: the scene, with its settings.
        grid: its grid.
        boundary: its solids.

    Attributes:
        reseeding: the reseeding; None if the scene has none.
        density_monitor: decides when to correct; None if the scene decides, or if there is no
            correction.
        correction: the density correction; None if it has not acted yet, or never does.
        moved: whether the last `apply` may have moved particles.
    """

    def __init__(self, scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary) -> None:
        """Make the parts that the scene asks for."""
        self._scene, self._grid, self._boundary = scene, grid, boundary
        self.reseeding = make_reseeding(scene, grid, boundary)
        self.density_monitor = make_density_monitor(scene, grid, boundary)
        moved = any(solid.motion is not None for solid in scene.solid)
        driven = scene.keeps_volume and moved
        thin = boundary.thin is not None and boundary.thin.moves
        self._severe = (SEVERE_THIN if thin else SEVERE) if driven else math.inf
        self._crowded = math.inf if scene.keeps_volume or not moved else CROWDED_CELL
        # Whether each step corrects all of the density.
        self._always = driven and thin and self.density_monitor is not None
        self.correction: DensityCorrection | None = None
        settings = scene.correction
        self._every, self._most = settings.every if settings is not None else 0, scene.most_crowded
        if scene.corrects_steadily and settings is not None:
            self.correction = self._make_correction()
        g = math.hypot(*scene.physics.gravity)
        self._pace = PACE * math.sqrt(grid.spacing / g) if g > 0.0 else 0.0  # [s]
        self.moved = False
        # Whether a step has measured the density monitor, and the number of the last step that
        # called `measure_density`.
        self._looked, self._step = False, -1

    def measure_density(
        self, step: int, density: wp.array | None, particles: Particles, window: Window
    ) -> None:
        """Measure the density at the start of a step, if a density monitor decides.

        Nothing has moved yet.

        Args:
            step: its number.
            density: density of the particles, in units of that at rest, float32; None if it is not
                known yet.
            particles: the material.
            window: cells that hold all of it, with two to spare on each side.
        """
        if self._step == step:
            return
        self._step = step
        self._looked = self.density_monitor is not None and step % self._every == 0
        if self.density_monitor is not None and self._looked:
            self.density_monitor.measure(density, particles, window)

    def has_looked(self, step: int) -> bool:
        """Return whether `measure_density` has been called in a step."""
        return self._step == step

    @property
    def max_density(self) -> float | None:
        """Return the largest density at the start of the step, if it was measured."""
        return (
            self.density_monitor.read_densities()[1]
            if self.density_monitor is not None and self._looked
            else None
        )

    def due(self, step: int) -> bool:
        """Return whether a step moves particles by reseeding or correction."""
        return self._evens(step) or self._parts(step)

    def corrects_alone(self, step: int) -> bool:
        """Return whether the only redistribution of a step is a density correction."""
        return not self._evens(step) and self._parts(step)

    def apply(
        self,
        particles: Particles,
        window: Window,
        step: int,
        dt: float,
        watch: Stopwatch,
        fill: Fill | None,
        contact: wp.array | None,
    ) -> dict[str, float | int | str]:
        """Reseed the particles and correct their density, if it is due.

        Args:
            particles: the material (moved).
            window: cells that hold all particles, with two to spare on each side.
            step: its number.
            dt: its length [s].
            watch: stopwatch of the stages.
            fill: adds the density of material without particles, in a window.
            contact: uint8, RELEASED where walls have separated in the step; None if it is not
                known.

        Returns:
            The log entries.
        """
        row: dict[str, float | int | str] = {}
        self.moved = self._evens(step)
        if self.reseeding is not None and self.moved:
            with watch.stage("reseeding", *particles.arrays().values()):
                row["reseeded"] = self.reseeding.apply(particles, window, step)
        if self._parts(step):
            correction = self.correction = self.correction or self._make_correction()
            with watch.stage(
                "density correction",
                particles.position,
                correction.density,
                correction.x,
                *correction.displacement,
            ):
                share = self._share(dt)
                done = correction.apply(particles, window, fill=fill, contact=contact, share=share)
                iterations = done.result.iterations if done.result is not None else 0
                if share == 1.0 and done.result is not None:
                    iterations += self._repeat(correction, particles, window, step, fill, contact)
                    iterations += self._spread(correction, done, particles, window, step, contact)
            self.moved = self.moved or done.result is not None
            row["density_status"] = (
                done.result.status.name if done.result is not None else "NOTHING_TO_DO"
            )
            row["density_iterations"] = iterations
            row["max_density"] = done.max_density
        return row

    def _repeat(
        self,
        correction: DensityCorrection,
        particles: Particles,
        window: Window,
        step: int,
        fill: Fill | None,
        contact: wp.array | None,
    ) -> int:
        """Repeat a full correction until little material is in excess; collective.

        Args:
            correction: the correction, which has moved the particles once in the step.
            particles: the material (moved).
            window: cells that hold all particles, with as many to spare as a step's window has.
            step: its number.
            fill: see `apply`.
            contact: see `apply`.

        Returns:
            The number of iterations of the solves.
        """
        iterations, monitor = 0, self.density_monitor
        for _ in range(PASSES - 1):
            if monitor is None or not math.isfinite(self._severe):
                break
            # The particles have moved out of their cells, and on ranks out of their boxes.
            particles.arrange(step)
            particles.drop_ghosts()
            monitor.measure(None, particles, window)
            if monitor.read_densities()[0] <= self._severe:
                break
            done = correction.apply(particles, window, fill=fill, contact=contact)
            if done.result is None:
                break
            iterations += done.result.iterations
        return iterations

    def _spread(
        self,
        correction: DensityCorrection,
        done: Correction,
        particles: Particles,
        window: Window,
        step: int,
        contact: wp.array | None,
    ) -> int:
        """Repeat a correction of sand while it finds crowded cells; collective.

        Args:
            correction: the correction, which has moved the particles once in the step.
            done: its result.
            particles: the material (moved).
            window: cells that hold all particles, with two to spare on each side.
            step: its number.
            contact: see `apply`.

        Returns:
            The number of iterations of the solves.
        """
        iterations = 0
        for _ in range(CROWDED_PASSES - 1):
            if done.max_density <= self._crowded or done.result is None:
                break
            particles.arrange(step)
            particles.drop_ghosts()
            done = correction.apply(particles, window, contact=contact)
            iterations += done.result.iterations if done.result is not None else 0
        return iterations

    def _evens(self, step: int) -> bool:
        return self.reseeding is not None and step % self.reseeding.every == 0

    def _parts(self, step: int) -> bool:
        if self.density_monitor is not None:
            if self._always or not self._looked:
                return self._looked
            return self.density_monitor.read_densities()[0] > self._most
        return self.correction is not None and step % self.correction.every == 0

    def _share(self, dt: float) -> float:
        """Return the fraction of the excess that a step removes.

        All of it where the scene sets the steps, and where thin solids are driven. Otherwise a
        fraction in proportion to the time step, and more of a severe excess.
        """
        if self.density_monitor is None or self._pace == 0.0 or self._always:
            return 1.0
        share = min(1.0, dt / self._pace)
        if math.isfinite(self._severe):
            excess = self.density_monitor.read_densities()[0]
            rest = min(max(excess / self._severe - 1.0, 0.0), 1.0)
            share += (1.0 - share) * rest
        return share

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns that `apply` fills."""
        evens = ("reseeded",) if self.reseeding is not None else ()
        return (*evens, *CORRECTION_COLUMNS) if self._scene.correction is not None else evens

    def state(self) -> dict[str, np.ndarray]:
        """Return the solution that the next correction starts from, if there was one."""
        return {} if self.correction is None else {STATE: self.correction.x.numpy().copy()}

    def expect(self, state: Mapping[str, np.ndarray]) -> None:
        """Prepare for a state from before or after the first correction."""
        if self.density_monitor is not None:
            self.correction = (
                (self.correction or self._make_correction()) if STATE in state else None
            )

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a checkpoint's `state`."""
        if self.correction is not None:
            self.correction.x.assign(state[STATE])

    def _make_correction(self) -> DensityCorrection:
        most = MOST_THIN if self._always else None
        return make_density_correction(self._scene, self._grid, self._boundary, most=most)
