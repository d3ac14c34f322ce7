"""Frames of a particle simulation: points, surfaces, volumes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
import warp as wp

from warp_lcp.grid.level_set import Fill
from warp_lcp.grid.particle_ids import ParticleIds, unpack_ids
from warp_lcp.grid.particles import UNSORTED, Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.surface_mesh import FilledInterior, SurfaceMesh, faces_from_particles, sample
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.narrow_band import NarrowBand
from warp_lcp.material.particle_volume import ParticleVolume
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.simulation import Points, Surface, Volume, VolumeGroup


class ParticleFrames(ABC):
    """Parts of a frame that all materials have; attributes as of `ParticleSimulation`."""

    grid: StaggeredGrid
    boundary: Boundary
    particles: Particles
    band: NarrowBand | None
    bodies: RigidBodies | None
    surface_mesh: SurfaceMesh | None
    particle_volume: ParticleVolume | None
    velocity: list[wp.array]
    weights: list[wp.array]
    births: ParticleIds | None
    time: float
    _faces_know: bool

    @abstractmethod
    def _particle_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the particles' arrays by name."""

    @property
    def image_counts(self) -> tuple[int, int, int] | None:
        """Return the number of cells of a frame's image, (x, y, z); None for all.

        On a grid that follows the material these are the cells that hold some.
        """
        return self.grid.domain_counts if self.grid.part.shared or self.grid.whole is None else None

    def points(self) -> Points:
        """Return the particles for a frame, with velocity and speed [m/s].

        If they have ids, with `id` and `age` [s].
        """
        arrays = self._particle_arrays()
        velocity = arrays["velocity"]
        fields = {"velocity": velocity, "speed": np.sqrt(np.einsum("ij,ij->i", velocity, velocity))}
        if self.births is not None:
            ids = unpack_ids(arrays["identity"])
            fields |= {"id": ids, "age": self.births.ages(ids, self.time)}
        return Points("particles", arrays["position"], fields)

    @property
    def ids(self) -> np.ndarray | None:
        """Ids of `particles`, int64, shape (count,); None without `output.ids`."""
        return self.particles.ids

    @property
    def ages(self) -> np.ndarray | None:
        """Ages of `particles` [s], float32, shape (count,); None without `output.ids`."""
        ids = self.particles.ids
        return None if ids is None or self.births is None else self.births.ages(ids, self.time)

    def surfaces(self) -> list[Surface]:
        """Return the material's surface for a frame, if the scene asks for it; collective.

        It has the velocity [m/s] of the particles around it. Each rank returns the surface in its
        box.
        """
        if self.surface_mesh is None:
            return []
        with self.particles.exchange.with_ghosts(UNSORTED):
            return [self._wrap(self.surface_mesh)]

    def _wrap(self, surface: SurfaceMesh) -> Surface:
        """Return the surface around the particles and their ghosts."""
        position = self.particles.position
        band = self.band
        mesh = surface.find(
            position,
            FilledInterior(band.depth, band.full, self.boundary.base) if band is not None else None,
        )
        if not self._faces_know:  # the next step overwrites what the faces are given here
            faces_from_particles(
                self.grid, position, self.particles.velocity, self.velocity, self.weights
            )
        velocity = sample(self.grid, self.velocity, mesh.points)
        return Surface(
            "surface",
            mesh.points.numpy().copy(),
            mesh.corners.numpy().copy(),
            {"velocity": velocity.numpy().copy()},
        )

    def volumes(self) -> list[Volume | VolumeGroup]:
        """Return the material's level set and density for a frame; collective.

        Empty unless the scene asks for them. The root returns the volumes of all ranks, since no
        reader merges several volumes. For OpenVDB they are one group, with the velocity.
        """
        if self.particle_volume is None:
            return []
        part, with_velocity = self.grid.part, self.particle_volume.with_velocity
        with self.particles.exchange.with_ghosts(UNSORTED):
            found = self.particle_volume.measure(self.particles, fill=self._fill_density())
            level_set = found[0]
            velocity = self._velocity_at_cells(level_set) if with_velocity else None
        whole = [part.gathered(volume.values) for volume in found]
        moving = [] if velocity is None else [part.gathered(values) for values in velocity]
        first = part.gathered_from
        volumes = [
            replace(v, values=values, origin=first)
            for v, values in zip(found, whole, strict=True)
            if values is not None
        ]
        if not with_velocity or not volumes:
            return [*volumes]
        vectors = np.stack([values for values in moving if values is not None], axis=-1)
        velocities = Volume("velocity", vectors, level_set.spacing, origin=first)
        return [VolumeGroup("volume", (*volumes, velocities))]

    def _velocity_at_cells(self, level_set: Volume) -> np.ndarray:
        """Return the velocity at the centers of cells [m/s], float32, shape (3, nz, ny, nx).

        It is that of the faces, in cells within the material and the band of the level set; 0
        elsewhere. Faces that do not yet have the particles' velocity get it in fields of their own,
        so that the run does not change.
        """
        grid, fields = self.grid, self.velocity
        if not self._faces_know:
            fields = grid.faces()
            particles = self.particles
            faces_from_particles(grid, particles.position, particles.velocity, fields, grid.faces())
        assert level_set.band is not None
        cells = np.argwhere(level_set.values < level_set.band)
        centers = (cells[:, ::-1] + np.array(grid.origin) + 0.5) * grid.spacing
        points = wp.array(centers.astype(np.float32), dtype=wp.vec3, device=grid.device)
        values = np.zeros((3, *level_set.values.shape), dtype=np.float32)
        values[:, *cells.T] = sample(grid, fields, points).numpy().T
        return values

    def _fill_density(self) -> Fill | None:
        """Return a function that adds the density of material without particles.

        It acts in a window, for surfaces. None if there is no such material.
        """
        own, part = self.band.fill if self.band is not None else None, self.grid.part
        if not part.shared:
            return own

        def fill(window: Window, density: wp.array) -> None:
            if own is not None:
                own(window, density)
            part.fill(density)

        return fill

    def body_surfaces(self) -> list[Surface]:
        """Return the rigid bodies for a frame, on the root.

        Data: `body`, the number of the body, and velocity [m/s].
        """
        if self.bodies is None or not self.grid.part.ranks.is_root:
            return []
        surface = self.bodies.surfaces()
        return [Surface("bodies", surface.points, surface.corners, surface.fields)]
