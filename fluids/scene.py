"""Scenes of liquid: the tables `pressure`, `particles` and `liquid`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from warp_lcp.driver.scene import Complaint, Liquid, Scene, Table

# Measured at 96^3 as the growth of a process on the CPU, first step included.
BYTES_A_CELL = 128  # fields of the grid and of the pressure solve
LEVEL_SET_BYTES = 19  # more a cell for a surface between cells, or slivers
SMOOTHING_BYTES = 12
CUT_BYTES = 45
MOVING_BYTES = 30
PLANES = 2.5  # that a 2-D cell counts for: its fields have three, the solver's one
VECTOR_BYTES, KEY_BYTES = 12, 16  # a particle's vectors, one of them spare, and its sort keys
SEEDING_BYTES = 136  # a particle on the host, while the liquid is made and the solver is not
LATTICE_BYTES = 50  # a point of one plane of cells, while particles are chosen from them


class Pressure(Table):
    """[pressure]: what the pressure does."""

    later: ClassVar = {"model": frozenset({"unilateral"})}
    model: Literal["incompressible"] = Field(default="incompressible", description="the only model of this version")
    surface: Literal["ghost-fluid", "voxel"] = Field(
        default="ghost-fluid",
        description="ghost-fluid: the free surface lies between cell centers, second order; voxel: on the cells' faces",
    )
    smoothing: int = Field(default=0, ge=0, le=8, description="binomial passes over the level set of a ghost-fluid surface")


class ParticleSettings(Table):
    """[particles]: how the liquid is sampled and how its velocity moves between particles and grid."""

    per_axis: int = Field(default=2, ge=1, le=4, description="particles along the edge of a cell at the start")
    transfer: Literal["apic", "flip", "pic"] = Field(default="apic", description="flip is livelier and noisier, pic damps")
    flip_ratio: float = Field(default=0.95, ge=0, le=1, description="the share of FLIP when transfer is flip; the rest is PIC")
    jitter: float = Field(default=0.25, ge=0, le=1, description="random displacement at the start, a fraction of the particles' distance")
    seed: int = Field(default=2015, ge=0, description="of the random displacements")


class LiquidScene(Scene):
    """A scene of liquid."""

    pressure: Pressure = Field(default_factory=Pressure)
    particles: ParticleSettings = Field(default_factory=ParticleSettings)
    liquid: list[Liquid] = Field(min_length=1)

    def complaints(self) -> list[Complaint]:
        """Return what is wrong across keys."""
        return super().complaints() + self.shape_complaints("liquid", self.liquid, inside=True)

    def particle_estimate(self) -> int:
        """Return about how many particles the scene starts with, at most: meshes and slanted shapes count as the boxes around them."""
        volume = min(sum(self.enclosed_volume(liquid) for liquid in self.liquid), math.prod(self.domain.size))
        return round(volume / self.spacing**self.dimension * self.particles.per_axis**self.dimension)

    def plan(self) -> list[tuple[str, str]]:
        """Return what a run would do."""
        particles = self.particle_estimate()
        settings = self.particles
        return [
            *super().plan(),
            ("particles", f"at most {particles:,}, {settings.per_axis**self.dimension} a cell, {settings.transfer}"),
            ("memory", f"about {max(1, round(self.memory_estimate() / 2**20)):,} MB"),
        ]

    def memory_estimate(self) -> int:
        """Return about how much memory a run takes at most [bytes], without the program itself."""
        nx, ny, nz = self.cell_counts
        cells = round(nx * ny * (nz if self.dimension == 3 else PLANES))
        particles = self.particle_estimate()
        cut = self.domain.solids == "cut-cell" and bool(self.solid)
        level_set = self.pressure.surface == "ghost-fluid"
        a_cell = BYTES_A_CELL + LEVEL_SET_BYTES * (level_set or cut) + SMOOTHING_BYTES * (level_set and self.pressure.smoothing > 0)
        a_cell += CUT_BYTES * cut + MOVING_BYTES * any(solid.motion is not None for solid in self.solid)
        a_cell += 4 * self.dimension * (self.particles.transfer == "flip")
        vectors = 3 + (self.dimension if self.particles.transfer == "apic" else 0)
        running = cells * a_cell + particles * (VECTOR_BYTES * vectors + KEY_BYTES)
        lattice = nx * ny * self.particles.per_axis**self.dimension
        return max(running, cells * BYTES_A_CELL // 2 + particles * SEEDING_BYTES + lattice * LATTICE_BYTES)
