"""Spray: lone particles in free flight, which need no grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
import warp as wp
from scipy import ndimage

from warp_lcp.grid.cell_kernel import launch_list, list_kernel
from warp_lcp.grid.particles import Particles, ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.kernels.recorded_arguments import Scalar

EVERY = 8  # steps between searches for particles that have left the others
TILE = 8  # cells of a tile; empty tiles separate clusters of particles
FEW = 8  # most particles of a cluster that leaves the grid
# Cells from the box around all other particles at which a cluster leaves the grid; it returns at
# half of that.
AWAY = 2 * TILE
MOST_TILES = 1 << 22  # most tiles; they are larger if there would be more
# Cells from a solid or wall, in addition to a step's path, within which particles stay on the grid.
CLEAR = 3
SLOW = 10.0  # [cells/s] added to each speed: the margin of slow particles, too, grows with dt


@list_kernel("warp_lcp.material.spray")
@no_type_check
def fly_kernel(
    i,
    change_x: float,
    change_y: float,
    change_z: float,
    dt: float,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
):
    """Change velocities, then move particles for a time step."""
    v = velocity[i] + wp.vec3(change_x, change_y, change_z)
    velocity[i] = v
    position[i] = position[i] + dt * v


class Spray:
    """Carry lone particles along their parabolas, off the grid.

    They return when they come near other particles, a solid or a wall. A cluster of at most `FEW`
    particles far outside the box around all others flies, so the grid need not reach there. Its
    particles move on straight with gravity, as an airborne body on the grid would, except for
    rotation: mass, momentum, energy and angular momentum are conserved. The APIC gradients are
    lost; those of a lone particle have no effect.

    Args:
        grid: any of the simulation's.
        solids: solids that it may meet.
        open_sides: open sides of the domain, see `warp_lcp.grid.domain_sides.side_bits`.
        active: whether any particle may fly.
        keeps: whether particles carry a number.
        ids: whether particles have ids.

    Attributes:
        particles: those in flight.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        solids: Sequence[PlacedSolid],
        open_sides: int,
        *,
        active: bool = True,
        keeps: bool = False,
        ids: bool = False,
    ) -> None:
        self.active, self._solids, self._open, self._extent, self._dimension = (
            active,
            tuple(solids),
            open_sides,
            grid.extent,
            grid.dimension,
        )
        self._numbers = [Scalar() for _ in range(4)]  # change of the velocity [m/s], time step [s]
        self._flying = LaunchGraph(grid.device, self._launch)
        nothing = np.zeros((0, 3), dtype=np.float32)
        self.particles = Particles(
            grid,
            nothing,
            nothing,
            affine=False,
            kept=nothing[:, 0] if keeps else None,
            ids=ids,
            indexed=False,
        )

    def exchange(
        self, particles: Particles, totals: ParticleTotals, step: int, time: float, dt: float
    ) -> ParticleTotals:
        """Exchange particles with the grid, and return sums over those on the grid.

        Clusters that have left the others start to fly; particles near an obstacle return.

        Args:
            particles: on the grid (updated).
            totals: sums over them.
            step: number of the step.
            time: time at the start of the step [s].
            dt: its length [s].
        """
        spray, dx, before = self.particles, particles.grid.spacing, particles.count
        if spray.count:
            reach = 0.5 * AWAY * dx
            near = self._within(spray, totals.low - reach, totals.high + reach) | self._meets(
                spray, time, dt, dx
            )
            self._move(spray, particles, near)
        if self.active and step % EVERY == 0 and particles.count:
            self._move(particles, spray, self._leaves(particles, time, dt, dx))
        return totals if particles.count == before else particles.totals()

    def fly(self, change: np.ndarray, dt: float) -> None:
        """Change the velocity by `change` [m/s], shape (3,), and move by a time step [s]."""
        own = self.particles
        if own.count:
            for number, value in zip(self._numbers, (*change, dt), strict=True):
                number.value = float(value)
            self._flying.run()

    def _launch(self) -> None:
        """Launch the motion of the particles in a step."""
        own = self.particles
        launch_list(
            fly_kernel,
            own.count,
            [*self._numbers, own.position, own.velocity],
            device=own.grid.device,
        )

    def behind(self, name: str, array: np.ndarray) -> np.ndarray:
        """Append the spray's array to that of the particles on the grid, (n, 3)."""
        own_array = self.particles.arrays().get(name)
        return np.concatenate(
            [
                array,
                np.zeros((self.particles.count, 3), dtype=array.dtype)
                if own_array is None
                else own_array.numpy(),
            ]
        )

    def with_own(self, totals: ParticleTotals) -> ParticleTotals:
        """Add the sums over the spray to those over the particles on the grid."""
        return totals.joined(self.particles.totals()) if self.particles.count else totals

    def _leaves(self, particles: Particles, time: float, dt: float, dx: float) -> np.ndarray:
        """Return a mask of lone particles, far from all others and near no obstacle."""
        x = particles.position.numpy()
        alone = self._alone(x, dx)
        if alone.any() and not alone.all():
            rest = x[~alone]
            alone &= ~self._within(
                particles, rest.min(axis=0) - AWAY * dx, rest.max(axis=0) + AWAY * dx
            )
        if alone.any():
            alone[alone] = ~self._meets(particles, time, dt, dx, alone)
        return alone

    def _within(self, particles: Particles, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return a mask of the particles in a box."""
        x, axes = particles.position.numpy(), slice(self._dimension)
        return np.asarray(((x >= low) & (x <= high))[:, axes].all(axis=1))

    def _meets(
        self,
        particles: Particles,
        time: float,
        dt: float,
        dx: float,
        which: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return a mask of particles that may come near a solid or closed side in a step.

        It is near if its distance [m] is less than CLEAR dx + (|v| + SLOW dx) dt: its way in the
        step, and a margin. The way lacks gravity's part g dt^2 and that of moving solids. The CFL
        time step limits the two to CFL dx, usually less than CLEAR dx. Particles without a finite
        position or velocity count as near.
        """
        x, v = (
            array.numpy() if which is None else array.numpy()[which]
            for array in (particles.position, particles.velocity)
        )
        room = CLEAR * dx + (np.linalg.norm(v, axis=1) + SLOW * dx) * dt
        near: np.ndarray = ~np.isfinite(x + v).all(axis=1)
        for axis in range(self._dimension):
            for side, gap in enumerate((x[:, axis], self._extent[axis] - x[:, axis])):
                if not self._open >> (2 * axis + side) & 1:
                    near |= gap < room
        points = wp.array(x, dtype=wp.vec3, device=particles.grid.device)
        distance = wp.empty(len(x), dtype=wp.float32, device=particles.grid.device)
        for solid in self._solids:
            geometry = (
                solid.geometry
                if solid.motion is None
                else solid.geometry.moved(solid.motion.pose(time))
            )
            geometry.signed_distance(points, distance)
            near |= distance.numpy() < room
        return near

    def _alone(self, position: np.ndarray, dx: float) -> np.ndarray:
        """Return a mask of particles, given by position [m], in clusters of few."""
        tile, low = (
            np.floor(position / (TILE * dx)).astype(np.int64),
            np.floor(position.min(axis=0) / (TILE * dx)).astype(np.int64),
        )
        while np.prod((tile - low).max(axis=0) + 1.0) > MOST_TILES:
            tile, low = tile // 2, low // 2
        tile -= low
        shape = tuple(int(n) + 1 for n in tile.max(axis=0))
        flat = np.ravel_multi_index(tuple(tile.T), shape)
        held = np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape)
        cluster, _ = ndimage.label(held, structure=np.ones((3, 3, 3)))
        few = np.bincount(cluster.ravel(), weights=held.ravel()) <= FEW
        return np.asarray(few[cluster.ravel()[flat]])

    def _move(self, source: Particles, target: Particles, which: np.ndarray) -> None:
        """Move particles from one set to the end of another."""
        if not which.any():
            return
        kept = None if source.kept is None else source.kept.numpy()[which, 0]
        ids = None if source.ids is None else source.ids[which]
        target.append(source.position.numpy()[which], source.velocity.numpy()[which], kept, ids)
        source.marks.assign(which.astype(np.int32))
        source.remove(source.marks)
