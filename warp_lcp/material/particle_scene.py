"""Scenes of materials on particles: sampling, sources, estimates of a run."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from warp_lcp.grid.surface_mesh import MESH_LATTICE_BYTES, MESH_POINT_BYTES, MESH_SOLID_BYTES
from warp_lcp.material.domain_window import start_of
from warp_lcp.material.particle_volume import VELOCITY_BYTES, VOLUME_BYTES
from warp_lcp.scene.models import SceneModel, model_lines, prices
from warp_lcp.scene.presets import preset_values
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.shapes import Drain, MaterialProperties, Source, SourceProperties
from warp_lcp.scene.suspicious_settings import material_notes
from warp_lcp.scene.table import CrossKeyError, Table
from warp_lcp.settings import Count, CountOrZero, Part, Share

# Measured at 96^3 as the growth of a process on the CPU, first step included.
GRID_BYTES = 36  # fields of the grid, per cell
CUT_BYTES = 45
MOVING_BYTES = 30
SOURCE_BYTES = 8
# Bytes a cell of the density correction's fields and method; and more where cells are cut.
CORRECTION_BYTES, CUT_CORRECTION_BYTES = 54, 22
EVEN_BYTES = 9  # and more where the correction closes voids
RESEED_BYTES = 13
BAND_BYTES = 24
FLIGHT_BYTES = 10  # marks of the cells of airborne bodies
# Largest growth of a narrow band with its surface: 1.3 times in a double dam break, 1.7 in a dam
# break in 3-D.
SPREAD = 2.0
PLANES = 2.5  # planes for which a 2-D cell counts: its fields have three, the solver's one
VECTOR_BYTES, KEY_BYTES = 12, 16  # a particle's vectors, one of them spare, and its sort keys
SEEDING_BYTES = 136  # a particle on the host, before the solver is made
# Fraction of the distance of particles: the error of their float32 coordinates on 4096 cells.
SITE_SLACK = 1e-3
LATTICE_BYTES = 50  # a point of one plane of cells, while particles are selected


class ReseedingSettings(Table):
    """[particles.reseed]: reseeding inside the material; off without the table."""

    every: Count = Field(default=2, description="steps between reseedings")
    min: Count | None = Field(
        default=None, description="fewest particles of a cell; default: 3/8 of those at rest"
    )
    max: Count | None = Field(
        default=None, description="most particles of a cell; default: twice those at rest"
    )


class NarrowBandSettings(Table):
    """[particles.narrow_band]: particles only near the surface; off without the table."""

    width: float = Field(
        default=4.0, ge=3, description="cells below the surface that hold particles"
    )


class ParticleSettings(Table):
    """[particles]: sampling of the material, transfers between particles and grid."""

    per_axis: int = Field(default=2, ge=1, le=4, description="particles per cell edge at the start")
    transfer: Literal["apic", "flip", "pic"] = Field(
        default="apic", description="apic, flip (livelier, noisier) or pic (damps)"
    )
    flip_ratio: Part = Field(default=0.95, description="share of FLIP; the rest is PIC")
    jitter: Part = Field(
        default=0.25, description="random initial displacement [particle distances]"
    )
    seed: CountOrZero = Field(default=2015, description="seed of jitter")
    reseed: ReseedingSettings | None = None
    narrow_band: NarrowBandSettings | None = None

    def reseed_range(self, dimension: int) -> tuple[int, int]:
        """Return the range of particle numbers of cells that reseeding leaves alone."""
        at_rest, given = self.per_axis**dimension, self.reseed or ReseedingSettings()
        return given.min or math.ceil(0.375 * at_rest), given.max or 2 * at_rest


class DensityCorrectionSettings(Table):
    """[density_correction]: reduces overfull cells; by default once they hold 0.1 % of a liquid."""

    every: CountOrZero = Field(default=1, description="steps between corrections; 0: off")
    tolerance: Share = Field(default=1e-2, description="relative residual")
    max_density: float | None = Field(
        default=None,
        gt=0,
        le=2,
        description="largest relative density of a cell; default: 1 + 0.1 / particles.per_axis",
    )

    def largest(self, per_axis: int) -> float:
        """Return the largest density of a cell, relative to rest.

        Particles on a lattice are the more uneven, the fewer they are.
        """
        return self.max_density if self.max_density is not None else 1.0 + 0.1 / per_axis


class ParticleScene(Scene):
    """Scene of a material that particles carry.

    Subclasses add the list of the material's shapes and name it in `materials`.
    """

    # Bytes a cell of the solve's fields that exist before the particles are made.
    solve_bytes: ClassVar[int] = 0
    correction_gain: ClassVar[float] = 1.0  # gain of the density correction
    # Fraction of the material in excess, times particles.per_axis. A pool at rest has 1e-3 / 3e-5
    # at 1 / 2, a splash 1e-2.
    crowded: ClassVar[float] = 2e-3
    # Mean speed of the fastest particle over a run, relative to that after its whole fall.
    fall_speed: ClassVar[float] = 1.0
    # Mean cost of a step over a run, relative to that while a column falls.
    stirred: ClassVar[float] = 1.0
    # Whether the grid can carry the material without particles.
    carried_by_grid: ClassVar[bool] = False

    particles: ParticleSettings = Field(default_factory=ParticleSettings)
    density_correction: DensityCorrectionSettings | None = None
    source: list[Source] = Field(default_factory=list)
    drain: list[Drain] = Field(default_factory=list)

    @abstractmethod
    def materials(self) -> tuple[str, Sequence[MaterialProperties]]:
        """Return the key of the material's shapes, such as `liquid`, and the shapes."""

    def carried_numbers(
        self, materials: Sequence[MaterialProperties | SourceProperties]
    ) -> list[float] | None:
        """Return the number that particles of each material or source carry; None if none."""
        return None

    def models(self) -> list[SceneModel]:
        """Return the models of the scene, and the models that it cannot need.

        Subclasses add their own.
        """
        moving = [number for number, solid in enumerate(self.solid) if solid.moves]
        bodies = [number for number, solid in enumerate(self.solid) if solid.is_body]
        settings, output = self.particles, self.output
        corrects = self.correction is not None
        steadily = corrects and self.corrects_steadily
        used = {
            "cut cells": _solids(range(len(self.solid))) if self.cuts_cells else "",
            "moving solids": _solids(moving) if moving else "",
            "rigid bodies": _solids(bodies) if bodies else "",
            "FLIP": 'particles.transfer = "flip"' if settings.transfer == "flip" else "",
            "density correction": ""
            if not steadily
            else "[density_correction]"
            if self.density_correction is not None
            else "sand is sheared for long",
            "automatic density correction": "particles are moved out of overfull cells"
            if corrects and not steadily
            else "",
            "reseeding": "[particles.reseed]" if settings.reseed is not None else "",
            "narrow band": "[particles.narrow_band]" if settings.narrow_band is not None else "",
            "sources": "[[source]]" if self.source else "",
            "outlets": "[[drain]] or domain.open" if self.drain or self.domain.open else "",
            "surface mesh": "output.surface" if output.surface else "",
            "volume": "output.volume" if output.volume else "",
            "diagnostics": "output.diagnostics" if output.diagnostics else "",
        }
        return [
            SceneModel(name, why, count=len(bodies) if name == "rigid bodies" else 1)
            for name, why in used.items()
            if why
        ]

    @property
    def correction(self) -> DensityCorrectionSettings | None:
        """Return the settings of the density correction; None if there is none.

        Without the table they are the values of a preset.
        """
        given = self.density_correction
        if given is None:
            if self.stays_full or self.settles:
                return None
            given = DensityCorrectionSettings(**preset_values(self, "density_correction"))
        return given if given.every else None

    @property
    def corrects_steadily(self) -> bool:
        """Return whether each step of `correction.every` corrects the density.

        Otherwise only steps that begin with overfull cells do, see `most_crowded`.
        """
        return self.density_correction is not None

    @property
    def most_crowded(self) -> float:
        """Return the fraction of overfull material that starts a density correction.

        It applies if the scene does not set the steps.
        """
        return self.crowded / self.particles.per_axis

    @property
    def keeps_volume(self) -> bool:
        """Return whether the density correction closes voids inside the material too."""
        return False

    @property
    def settles(self) -> bool:
        """Return whether the material's own law keeps its density."""
        return False

    @property
    def speeds_up(self) -> bool:
        """Return whether internal forces can accelerate airborne material."""
        return self.settles

    @property
    def stays_full(self) -> bool:
        """Return whether the material fills the domain at all times."""
        return False

    @property
    def coheres(self) -> bool:
        """Return whether rotating airborne material stays together."""
        return False

    @property
    def flies(self) -> bool:
        """Return whether airborne bodies are detected.

        Not with a narrow band, which has no particles inside; not in a domain that stays full; not
        with periodic axes.
        """
        return self.particles.narrow_band is None and not self.stays_full and not self.endless

    def find_errors(self) -> list[CrossKeyError]:
        """Return errors that concern several keys."""
        key, materials = self.materials()
        errors = (
            []
            if materials or self.source
            else [CrossKeyError((key,), None, "is missing, and there is no [[source]] either")]
        )
        errors += self.shape_errors(key, materials, inside=True)
        errors += self.shape_errors("source", self.source, inside=True) + self.shape_errors(
            "drain", self.drain, inside=True
        )
        if self.particles.narrow_band is not None and not self.carried_by_grid:
            message = "is for liquids only: the state of sand is stored on its particles"
            errors.append(CrossKeyError(("particles", "narrow_band"), None, message))
        if self.output.forces and not self.carried_by_grid:
            errors.append(CrossKeyError(("output", "forces"), True, "is for liquids only"))
        for number, source in enumerate(self.source if not self.carried_by_grid else []):
            if source.viscosity is not None:
                errors.append(
                    CrossKeyError(
                        ("source", number, "viscosity"), source.viscosity, "is for liquids only"
                    )
                )
        return super().find_errors() + errors + self._reseed_errors()

    def notes(self) -> list[str]:
        """Return settings that look like mistakes."""
        return [*super().notes(), *material_notes(self, *self.materials())]

    def _reseed_errors(self) -> list[CrossKeyError]:
        least, most = self.particles.reseed_range(self.dimension)
        at_rest = self.particles.per_axis**self.dimension
        if self.particles.reseed is None or least <= at_rest <= most:
            return []
        key, value, word = ("min", least, "most") if least > at_rest else ("max", most, "least")
        message = f"must be at {word} the {at_rest} particles of a cell at rest"
        return [CrossKeyError(("particles", "reseed", key), value, message)]

    def particle_estimate(self, *, later: bool = True) -> int:
        """Return the largest number of particles of the scene.

        Meshes and slanted shapes count as the boxes around them. Sources may fill the domain;
        whether they do, and what leaves it, is not known before. With a narrow band it is an
        estimate, since its growth is not known either.

        count = min(sites of all shapes + particles from sources, cells per_axis^d). With a narrow
        band of volume V it is at most (V / dx^d per_axis^d + particles from sources), times SPREAD
        if later particles count.

        Args:
            later: include what sources add; False for the particles at the start.
        """
        let_in = sum(self._source_sites(source, later=later) for source in self.source)
        at_start = sum(
            int(self._sites(shape.bounds(self.dimension)).prod()) for shape in self.materials()[1]
        )
        count: int = min(
            at_start + let_in, math.prod(self.cell_counts) * self.particles.per_axis**self.dimension
        )
        if self.particles.narrow_band is not None:
            band = sum(
                self._band_volume(shape, self.particles.narrow_band.width)
                for shape in self.materials()[1]
            )
            sites = band / self.spacing**self.dimension * self.particles.per_axis**self.dimension
            count = min(count, round((SPREAD if later else 1.0) * (sites + let_in)))
        return count

    def _sites(self, box: np.ndarray | None, *, whole_cells: bool = False) -> np.ndarray:
        """Return the most lattice points of the start in a box, along each axis.

        The shape is (dimension,).

        Args:
            box: low and high corner [m], shape (2, 3); None for the domain.
            whole_cells: count the points of cells whose centers lie in the box.
        """
        count = np.array(self.cell_counts[: self.dimension]) * self.particles.per_axis
        if box is None:
            return count
        step = self.spacing if whole_cells else self.spacing / self.particles.per_axis
        reach = SITE_SLACK + (0.0 if whole_cells else 0.5 * self.particles.jitter)
        low, high = np.clip(box[:, : self.dimension] / step, -1.0, count + 1.0)
        first, last = np.ceil(low - 0.5 - reach), np.floor(high - 0.5 + reach)
        most = count // self.particles.per_axis if whole_cells else count
        found: np.ndarray = (
            (np.minimum(last, most - 1) - np.maximum(first, 0) + 1).clip(min=0).astype(int)
        )
        sites: np.ndarray = found * self.particles.per_axis if whole_cells else found
        return sites

    def _source_sites(self, source: Source, *, later: bool) -> int:
        """Return the most particles of a source, at its start and until the run ends.

        In T seconds ceil(|v_a| T per_axis / dx) + 1 layers of lattice points enter along each axis
        a with v_a != 0. A layer has the product of the sites along the other axes, each one more
        where the lattice moves along it.
        """
        sites = self._sites(source.bounds(self.dimension), whole_cells=True)
        at_start = int(sites.prod()) if later or source.begin == 0.0 else 0
        seconds = max(min(source.stop or math.inf, self.time.duration) - source.begin, 0.0)
        speed = np.abs(source.velocity)
        # A lattice that moves along an axis may have one more point there.
        across = sites + (speed > 0.0)
        layers = np.where(
            speed > 0.0,
            np.ceil(speed * seconds * self.particles.per_axis / self.spacing) + 1.0,
            0.0,
        )
        let_in = sum(
            layers[axis] * np.delete(across, axis).prod(dtype=float)
            for axis in range(self.dimension)
        )
        return at_start + (int(min(let_in, 2.0**62)) if later and sites.all() else 0)

    def _band_volume(self, shape: MaterialProperties, width: float) -> float:
        """Return the volume of a shape's box in a narrow band [m^3; m^2 in 2-D].

        It is no deeper than the band below a free side.
        """
        size, deep = np.array(self.domain.size), width * self.spacing
        bounds = shape.bounds(self.dimension)
        low, high = (
            (np.zeros_like(size), size)
            if bounds is None
            else (corner[: self.dimension] for corner in bounds)
        )
        low, high = np.maximum(low, 0.0), np.minimum(high, size)
        inner = high - low - deep * ((low > 0.0).astype(float) + (high < size))
        return float(np.maximum(high - low, 0.0).prod() - np.maximum(inner, 0.0).prod())

    def plan(self) -> list[tuple[str, str]]:
        """Return the plan of a run in words."""
        particles = self.particle_estimate()
        settings = self.particles
        at_first = f"{self.particle_estimate(later=False):,} at the start, " if self.source else ""
        most = "about" if settings.narrow_band is not None else "at most"
        covered = (
            f"{' x '.join(map(str, self.covered_counts[: self.dimension]))} cells at the "
            "start; the grid follows the material"
        )
        part = [("covered", covered)] if self.covered_counts != self.cell_counts else []
        return [
            *super().plan(),
            *part,
            (
                "particles",
                f"{at_first}{most} {particles:,}, {settings.per_axis**self.dimension} a cell, "
                f"{settings.transfer}",
            ),
            *self._rearrangement(),
            *self.model_plan(),
            ("memory", f"about {_megabytes(self.memory_estimate())} MB"),
            *(
                (f"  {name}", f"{_megabytes(count)} MB")
                for name, count in self.memory_parts().items()
            ),
        ]

    def model_plan(self, measured: float | None = None) -> list[tuple[str, str]]:
        """Return the models in words, with their shares of memory and time.

        Args:
            measured: time of a step on this machine [s]; None for the machine of the price table.
        """
        cells, particles = math.prod(self.covered_counts), self.particle_estimate()
        listed = prices(self.scene.simulator, self.dimension)
        return model_lines(
            self.models(),
            listed,
            cells,
            particles,
            memory=sum(self.memory_parts().values()),
            measured=measured,
        )

    def _rearrangement(self) -> list[tuple[str, str]]:
        """Return the density correction and reseeding in words."""
        lines, correction, reseed = [], self.correction, self.particles.reseed
        band = self.particles.narrow_band
        if band is not None:
            lines.append(
                (
                    "narrow band",
                    f"particles within {band.width:g} cells of the surface, the grid stores the "
                    "rest",
                )
            )
        if correction is not None:
            most, when = correction.largest(self.particles.per_axis), _steps(correction.every)
            if not self.corrects_steadily:
                when += (
                    f" if more than {100.0 * self.most_crowded:.2g} % of the material exceeds it"
                )
            lines.append(
                ("density", f"at most {most:.4g} times the density at rest, corrected {when}")
            )
        if reseed is not None:
            least, many = self.particles.reseed_range(self.dimension)
            lines.append(
                ("reseeding", f"{least} to {many} particles a cell, {_steps(reseed.every)}")
            )
        return lines

    def memory_parts(self) -> dict[str, int]:
        """Return the largest device memory of each part of a run [bytes].

        Parts that the run does not have are left out. The values are estimates.
        """
        cells, settings, cut = self.counted_cells, self.particles, self.cuts_cells
        moving = any(solid.moves for solid in self.solid)
        vectors = (
            3
            + (self.dimension if settings.transfer == "apic" else 0)
            + (self.carried_numbers(()) is not None)
            + self.output.ids
        )
        correction = CORRECTION_BYTES + CUT_CORRECTION_BYTES * cut + EVEN_BYTES * self.keeps_volume
        parts = {
            "grid": cells * (GRID_BYTES + 4 * self.dimension * (settings.transfer == "flip")),
            **self.own_memory_parts(),
            "bodies in flight": cells * FLIGHT_BYTES * self.flies,
            "solids": cells * (CUT_BYTES * cut + MOVING_BYTES * moving),
            "density correction": cells * correction * (self.correction is not None),
            "reseeding": cells * RESEED_BYTES * (settings.reseed is not None),
            "narrow band": cells * BAND_BYTES * (settings.narrow_band is not None),
            "sources": cells * SOURCE_BYTES * bool(self.source),
            "volume": cells
            * (VOLUME_BYTES + VELOCITY_BYTES * (self.output.volume_format == "vdb"))
            * self.output.volume,
            "surface mesh": self.output.surface * self._surface_bytes(),
            "particles": self.particle_estimate() * (VECTOR_BYTES * vectors + KEY_BYTES),
        }
        return {name: count for name, count in parts.items() if count}

    def _surface_bytes(self) -> int:
        """Return the memory of a surface mesh and its lattice [bytes].

        The mesh is assumed to be as large as the domain's sides.
        """
        nx, ny, nz = (
            n * (self.output.surface_resolution or self.particles.per_axis)
            for n in self.covered_counts
        )
        cells = nx * ny * (nz if self.dimension == 3 else 3)
        points = 2 * (nx * ny + ny * nz + nz * nx) if self.dimension == 3 else 2 * (nx + ny)
        return (
            cells * (MESH_LATTICE_BYTES + MESH_SOLID_BYTES * bool(self.solid))
            + points * MESH_POINT_BYTES
        )

    def own_memory_parts(self) -> dict[str, int]:
        """Return the largest device memory of the material's own models [bytes].

        Parts that a scene does not have count 0.
        """
        return {}

    def memory_estimate(self) -> int:
        """Return the estimated peak memory of a run [bytes], without the program itself.

        The making of the particles may need the most.
        """
        nx, ny, _ = self.covered_counts
        lattice = nx * ny * self.particles.per_axis**self.dimension
        making = (
            self.counted_cells * (GRID_BYTES + self.solve_bytes) // 2
            + self.particle_estimate() * SEEDING_BYTES
        )
        estimate: int = max(super().memory_estimate(), making + lattice * LATTICE_BYTES)
        return estimate

    @property
    def covered_counts(self) -> tuple[int, int, int]:
        """Return the cells along x, y and z that the grid covers at the start.

        The grid grows with the material.
        """
        return start_of(self, "cpu")[1].counts

    @property
    def counted_cells(self) -> int:
        """Return the equivalent 3-D cells of the first grid, for memory estimates."""
        nx, ny, nz = self.covered_counts
        return round(nx * ny * (nz if self.dimension == 3 else PLANES))

    @property
    def cuts_cells(self) -> bool:
        """Return whether solids may cut through cells."""
        return self.domain.solids == "cut-cell" and bool(self.solid)


def _megabytes(count: int) -> str:
    return f"{count / 2**20:,.0f}" if count >= 10 * 2**20 else f"{count / 2**20:.1f}"


def _steps(every: int) -> str:
    """Return the interval of steps in words."""
    return "every step" if every == 1 else f"every {every} steps"


def _solids(numbers: Iterable[int]) -> str:
    """Return the names of solids in a line."""
    return ", ".join(f"solid {number}" for number in numbers)
