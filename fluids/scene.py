"""Scenes of liquid: the tables `pressure`, `particles` and `liquid`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from warp_lcp.driver.scene import Complaint, Liquid, Scene, Table

BYTES_PER_CELL = 160  # fields of the grid and of the pressure solve, measured at 128^3
BYTES_PER_PARTICLE = 96  # with APIC's gradients, sort keys and a spare array


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
        memory = math.prod(self.cell_counts) * BYTES_PER_CELL + particles * BYTES_PER_PARTICLE
        return [
            *super().plan(),
            ("particles", f"at most {particles:,}, {settings.per_axis**self.dimension} a cell, {settings.transfer}"),
            ("memory", f"about {max(1, round(memory / 2**20)):,} MB"),
        ]
