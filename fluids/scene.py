"""Scene tables of liquids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Literal

from pydantic import Field

from warp_lcp.fluids.drag_and_probe_tables import Probe, WallDragSettings, probe_errors
from warp_lcp.fluids.whitewater_table import WhitewaterSettings
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.scene.models import SceneModel
from warp_lcp.scene.scene import CrossKeyError, Liquid, Table
from warp_lcp.scene.shapes import LiquidProperties, MaterialProperties, Shape, SourceProperties
from warp_lcp.scene.suspicious_settings import LIQUID_DENSITY, UsualRange
from warp_lcp.settings import Positive

# Measured at 96^3 as the growth of a process on the CPU, first step included; bytes a cell.
PRESSURE_BYTES = 92  # fields of the pressure solve
BOUND_BYTES = 9  # of them, bounds of separating walls
LEVEL_SET_BYTES = 19  # added for a surface between cells, or slivers
SMOOTHING_BYTES = 12
TENSION_BYTES = 21
UNILATERAL_BYTES = 1
# Its fields, those of coarse levels, and the velocity before the pressure solve.
VISCOUS_BYTES = {2: 140, 3: 220}
# Viscosities of cells and edges, and the first particle of each cell, where viscosities differ.
MIXED_BYTES = {2: 12, 3: 20}
# Fields of the coupled solve, its Krylov vectors, and the levels of its pressure cycle.
STOKES_BYTES = {2: 2500, 3: 1400}
# Velocity, distance and new particles of a cell; vectors and scratch memory of a particle.
WHITEWATER_CELL_BYTES, WHITEWATER_PARTICLE_BYTES = 20, 64
# Courant numbers below this are short steps: liquid poured over a mesh gained energy without bound
# at 1/4 on 40 cells, at 1/8 on 20.
SHORT_STEPS = 0.5
# Added for a right-hand side that bodies change, and for each motion of a light body.
BODY_BYTES, POTENTIAL_BYTES = 8, 4
VISCOSITY = UsualRange(
    1e-4,
    1e7,
    "Pa s",
    "0.001 (water), 10 (honey), 10,000 (tar)",
    "m^2/s of a liquid as heavy as water",
    1e3,
)
TENSION = UsualRange(1e-4, 3.0, "N/m", "0.02 to 0.5, 0.072 for water,", "mN/m", 1e-3)
DRAG = UsualRange(0.0, 1.0, "", "about 0.005")
LIQUID_CFL = UsualRange(0.0, 10.0, "", "1 to 4")
# Methods for A + U W U', see `fluids.coupling`.
COUPLED_METHODS = ("projected-multigrid", "minimum-map-newton", "primal-dual-active-set")


class Pressure(Table):
    """[pressure]: pressure model and free surface."""

    model: Literal["incompressible", "unilateral"] = Field(
        default="incompressible",
        description="incompressible, or unilateral: no suction, liquid separates freely",
    )
    surface: Literal["ghost-fluid", "voxel"] = Field(
        default="ghost-fluid", description="ghost-fluid: between cell centers; voxel: on cell faces"
    )
    smoothing: int = Field(
        default=0, ge=0, le=8, description="filter passes over a ghost-fluid surface"
    )


class ViscositySettings(Table):
    """[viscosity]: viscous liquid; off without the table."""

    value: float = Field(
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="dynamic viscosity [Pa s]: water 0.001, honey 10",
    )
    slip_length: float = Field(
        default=0.0,
        ge=0,
        allow_inf_nan=True,
        description='slip length of "separating" and "sticky" walls [m]',
    )
    splitting_tolerance: float = Field(
        default=0.05,
        ge=0,
        allow_inf_nan=True,
        description="error of the split step, relative to the velocity, above which velocity and "
        "pressure are solved at once; inf: never, 0: always",
    )


class SurfaceTensionSettings(Table):
    """[surface_tension]: tension of the free surface; off without the table."""

    coefficient: Positive = Field(description="surface tension [N/m]; water 0.072")
    contact_angle: float = Field(
        default=90.0, ge=0, le=180, description="in the liquid [degrees]; above 90 walls repel it"
    )


def _viscosity(shape: Shape) -> float | None:
    """Return the viscosity of a material or source [Pa s]; None for the default."""
    return shape.viscosity if isinstance(shape, LiquidProperties | SourceProperties) else None


class LiquidScene(ParticleScene):
    """Scene of liquid.

    The tables of all materials, and those of liquids: `pressure`, `viscosity` and others.
    """

    solve_bytes: ClassVar[int] = PRESSURE_BYTES
    carried_by_grid: ClassVar[bool] = True
    # Factor on the estimated time of a step: splashed liquid occupies more cells, and solves take
    # more iterations.
    stirred: ClassVar[float] = 1.2

    pressure: Pressure = Field(default_factory=Pressure)
    viscosity: ViscositySettings | None = Field(default=None)
    surface_tension: SurfaceTensionSettings | None = None
    liquid: list[Liquid] = Field(default_factory=list)
    probe: list[Probe] = Field(default_factory=list)
    wall_drag: WallDragSettings | None = None
    whitewater: WhitewaterSettings | None = None

    def materials(self) -> tuple[str, Sequence[MaterialProperties]]:
        """Return the key `liquid` and its shapes."""
        return "liquid", self.liquid

    def find_errors(self) -> list[CrossKeyError]:
        """Return errors that involve several keys."""
        errors = super().find_errors()
        if self.solver.method not in COUPLED_METHODS and any(solid.is_body for solid in self.solid):
            message = (
                "cannot be combined with rigid bodies (their part of the matrix has only "
                f"products); use {', '.join(COUPLED_METHODS)}"
            )
            errors.append(CrossKeyError(("solver", "method"), self.solver.method, message))
        if self.pressure.model == "unilateral" and self.pressure.surface == "voxel":
            errors.append(
                CrossKeyError(
                    ("pressure", "surface"),
                    "voxel",
                    'cannot be combined with pressure.model = "unilateral", which has no free '
                    "surface",
                )
            )
        if self.pressure.model == "unilateral" and self.particles.narrow_band is not None:
            message = (
                'cannot be combined with pressure.model = "unilateral", whose liquid may '
                "separate anywhere inside"
            )
            errors.append(CrossKeyError(("particles", "narrow_band"), None, message))
        elif self.pressure.surface == "voxel" and self.particles.narrow_band is not None:
            message = 'needs pressure.surface = "ghost-fluid", which computes how full cells are'
            errors.append(CrossKeyError(("particles", "narrow_band"), None, message))
        if self.surface_tension is not None and self.pressure.surface == "voxel":
            message = 'needs pressure.surface = "ghost-fluid", whose surface has a curvature'
            errors.append(CrossKeyError(("surface_tension",), None, message))
        if self.surface_tension is not None and self.pressure.model == "unilateral":
            message = (
                'needs pressure.model = "incompressible": surface tension needs a pressure '
                "that may be negative"
            )
            errors.append(CrossKeyError(("surface_tension",), None, message))
        if self.whitewater is not None and self.pressure.surface == "voxel":
            message = 'needs pressure.surface = "ghost-fluid", whose surface has a distance'
            errors.append(CrossKeyError(("whitewater",), None, message))
        return [
            *errors,
            *self._viscosity_errors(),
            *probe_errors(self.probe, self.domain.size, self.physics.gravity),
        ]

    def notes(self) -> list[str]:
        """Return suspicious settings."""
        notes, tension = (
            [*super().notes(), *LIQUID_DENSITY.notes("physics.density", self.physics.density)],
            self.surface_tension,
        )
        given = [("viscosity.value", self.viscosity.value if self.viscosity else None)]
        given += [(f"{place}.viscosity", _viscosity(shape)) for place, shape in self.shapes()]
        for place, value in given:
            notes += VISCOSITY.notes(place, value)
        notes += LIQUID_CFL.notes("time.cfl", self.time.cfl)
        if tension is not None:
            notes += TENSION.notes("surface_tension.coefficient", tension.coefficient)
            if 0.0 < tension.contact_angle <= math.pi + 0.01:
                degrees = math.degrees(tension.contact_angle)
                notes.append(
                    f"surface_tension.contact_angle = {tension.contact_angle:g} is in degrees; if "
                    f"radians were meant, it is {degrees:.3g}"
                )
        if self.whitewater is not None:
            notes += self._whitewater_notes(self.whitewater)
        drags = (
            [
                ("wall_drag.coefficient", self.wall_drag.coefficient),
                ("wall_drag.domain", self.wall_drag.domain),
            ]
            if self.wall_drag
            else []
        )
        for place, value in [
            *drags,
            *((f"solid[{n}].drag", solid.drag) for n, solid in enumerate(self.solid)),
        ]:
            notes += DRAG.notes(place, value)
        return notes

    def _whitewater_notes(self, settings: WhitewaterSettings) -> list[str]:
        """Return a note if the length of whitewater is not between a cell and the domain."""
        length = settings.length
        if length is None or self.spacing <= length <= max(self.domain.size):
            return []
        return [
            f"whitewater.length = {length:g} m: usual lengths are between a cell, "
            f"{self.spacing:.3g} m, and the domain's longest side; others give few particles or "
            "none"
        ]

    def _viscosity_errors(self) -> list[CrossKeyError]:
        """Return errors of settings that need viscosity or exclude it."""
        if self.viscosity is not None and self.endless:
            return [CrossKeyError(("viscosity",), None, "cannot be combined with periodic axes")]
        tables: dict[str, Sequence[LiquidProperties | SourceProperties]] = {
            "liquid": self.liquid,
            "source": self.source,
        }
        own_settings = [
            (key, n, shape.viscosity)
            for key, shapes in tables.items()
            for n, shape in enumerate(shapes)
        ]
        own_settings = [given for given in own_settings if given[-1] is not None]
        if self.viscosity is not None:
            message = "cannot be combined with liquids of different viscosities"
            return (
                [CrossKeyError(("particles", "narrow_band"), None, message)]
                if own_settings and self.particles.narrow_band is not None
                else []
            )
        message = 'needs the table [viscosity]; without viscosity use "free-slip"'
        walls = [
            (("domain", "wall"), self.domain.wall),
            *((("solid", n, "wall"), solid.wall) for n, solid in enumerate(self.solid)),
        ]
        errors = [CrossKeyError(place, wall, message) for place, wall in walls if wall == "sticky"]
        slips = [
            (n, solid.slip_length)
            for n, solid in enumerate(self.solid)
            if solid.slip_length is not None
        ]
        errors += [
            CrossKeyError((key, n, "viscosity"), value, "needs the table [viscosity]")
            for key, n, value in own_settings
        ]
        return errors + [
            CrossKeyError(("solid", n, "slip_length"), slip, "needs the table [viscosity]")
            for n, slip in slips
        ]

    def carried_numbers(
        self, materials: Sequence[MaterialProperties | SourceProperties]
    ) -> list[float] | None:
        """Return viscosities relative to `viscosity.value`; None if all are equal."""
        liquids: list[LiquidProperties | SourceProperties] = [*self.liquid, *self.source]
        if self.viscosity is None or all(shape.viscosity is None for shape in liquids):
            return None
        return [
            (_viscosity(shape) or self.viscosity.value) / self.viscosity.value
            for shape in materials
        ]

    @property
    def slip_lengths(self) -> list[float]:
        """Return the slip lengths of the domain's wall and of each solid [m]."""
        assert self.viscosity is not None
        slip_walls = [
            (self.domain.wall, None),
            *((solid.wall or self.domain.wall, solid.slip_length) for solid in self.solid),
        ]
        return [
            math.inf
            if wall == "free-slip"
            else (self.viscosity.slip_length if slip is None else slip)
            for wall, slip in slip_walls
        ]

    def models(self) -> list[SceneModel]:
        """Return the models that the scene turns on, and those that have no effect."""
        full, ghost = self.stays_full, self.pressure.surface == "ghost-fluid"
        closed = "liquid fills a closed box: there is no free surface"
        models = []
        if self.pressure.model == "unilateral":
            models.append(SceneModel("unilateral pressure", 'pressure.model = "unilateral"'))
        elif self.walls_separate:
            models.append(
                SceneModel(
                    "separating walls",
                    "liquid may separate from domain.wall or a solid: bounds on the pressure",
                )
            )
        elif self.domain.wall == "separating":
            models.append(
                SceneModel(
                    "separating walls",
                    "the domain has no wall: equations without bounds",
                    built=False,
                )
            )
        if ghost:
            models.append(
                SceneModel(
                    "ghost-fluid surface",
                    closed if full else 'pressure.surface = "ghost-fluid"',
                    built=not full,
                )
            )
        if self.pressure.smoothing and ghost:
            models.append(
                SceneModel("smoothing", closed if full else "pressure.smoothing", built=not full)
            )
        if self.viscosity is not None:
            models.append(SceneModel("viscosity", "viscosity.value"))
        if self.couples:
            models.append(SceneModel("coupled solve", "viscosity.splitting_tolerance"))
        elif self.viscosity is not None and math.isfinite(self.viscosity.splitting_tolerance):
            models.append(
                SceneModel(
                    "coupled solve",
                    'pressure.model = "unilateral": viscosity and pressure act one after the other',
                    built=False,
                )
            )
        if self.surface_tension is not None:
            models.append(
                SceneModel(
                    "surface tension", closed if full else "[surface_tension]", built=not full
                )
            )
        if self.short_steps:
            models.append(SceneModel("support of spray", f"time.cfl is below {SHORT_STEPS}"))
        if self.solver.tolerance == "auto":
            models.append(SceneModel("automatic tolerance", 'solver.tolerance = "auto"'))
        if self.probe:
            models.append(SceneModel("probes", "[[probe]]"))
        if self.output.forces:
            models.append(SceneModel("forces on solids", "output.forces"))
        if self.drags is not None:
            models.append(
                SceneModel(
                    "drag along walls",
                    "[wall_drag]" if self.wall_drag is not None else "drag of a solid",
                )
            )
        if self.whitewater is not None:
            why = closed if full else "[whitewater]"
            models.append(SceneModel("whitewater", why, built=not full))
        return [*models, *super().models()]

    @property
    def couples(self) -> bool:
        """Return whether velocity and pressure of viscous liquid may be solved together."""
        settings = self.viscosity
        return (
            settings is not None
            and math.isfinite(settings.splitting_tolerance)
            and self.pressure.model == "incompressible"
        )

    @property
    def has_whitewater(self) -> bool:
        """Return whether the scene has whitewater and a free surface."""
        return self.whitewater is not None and not self.stays_full

    @property
    def resolved_whitewater(self) -> WhitewaterSettings | None:
        """Return the settings of whitewater, defaults included; None without it."""
        if self.whitewater is None or not self.has_whitewater:
            return None
        return self.whitewater.resolved(
            longest=None if self.domain.boundless else max(self.domain.size),
            spacing=self.spacing,
            gravity=self.physics.gravity,
            dimension=self.dimension,
        )

    @property
    def whitewater_estimate(self) -> int:
        """Return the estimated mean number of particles of whitewater in a run."""
        settings = self.resolved_whitewater
        if settings is None:
            return 0
        volume = self.particle_estimate() * (self.spacing / self.particles.per_axis) ** (
            self.dimension
        )
        return settings.expected_count(volume, self.time.duration)

    @property
    def drags(self) -> list[float] | None:
        """Return c_f of the domain's walls and of each solid; None without wall drag.

        See `fluids.wall_drag`.
        """
        table = self.wall_drag or WallDragSettings()
        walls = [table.domain, *(solid.drag for solid in self.solid)]
        found = [table.coefficient if given is None else given for given in walls]
        return found if any(found) else None

    @property
    def keeps_volume(self) -> bool:
        """Return whether voids inside the liquid are closed.

        False with the unilateral model, where liquid may separate, and with a narrow band, whose
        interior density is known only to a tenth.
        """
        return self.pressure.model == "incompressible" and self.particles.narrow_band is None

    @property
    def settles(self) -> bool:
        """Return whether overfull cells relax to the density at rest.

        False with the unilateral model, where gravity does this, see `fluids.unilateral_pressure`.
        """
        return self.pressure.model == "unilateral" and any(self.physics.gravity)

    @property
    def speeds_up(self) -> bool:
        """Return whether settling or surface tension can accelerate liquid."""
        return self.settles or self.surface_tension is not None

    @property
    def stays_full(self) -> bool:
        """Return whether liquid fills the domain, so that there is no free surface.

        True if only solids at rest take space besides the liquid.
        """
        openings = (
            self.domain.open
            or self.source
            or self.drain
            or any(solid.moves for solid in self.solid)
        )
        return (
            not openings
            and self.particles.narrow_band is None
            and self.pressure.model == "incompressible"
            and self._filled()
        )

    def _filled(self) -> bool:
        """Return whether a box of liquid holds the whole domain."""
        for liquid in self.liquid:
            bounds = (
                liquid.bounds(self.dimension)
                if liquid.shape == "box" and liquid.rotate is None and not liquid.invert
                else None
            )
            if bounds is not None and all(
                bounds[0][a] <= 0.0 and bounds[1][a] >= side
                for a, side in enumerate(self.domain.size)
            ):
                return True
        return False

    @property
    def walls_separate(self) -> bool:
        """Return whether a wall of the scene is separating."""
        walls = self.domain.wall == "separating" and len(self.domain.open) < 2 * self.dimension
        return walls or any(
            (solid.wall or self.domain.wall) == "separating" for solid in self.solid
        )

    @property
    def coheres(self) -> bool:
        """Return whether pressure below that of air can hold rotating liquid together."""
        return self.pressure.model == "incompressible"

    @property
    def short_steps(self) -> bool:
        """Return whether steps are short enough to need support of spray.

        In short steps spray must not take the velocity of the liquid beside it, see
        `fluids.pressure`.
        """
        return self.time.cfl < SHORT_STEPS and self.pressure.model == "incompressible"

    def own_memory_parts(self) -> dict[str, int]:
        """Return the peak memory of pressure and surface on the device [bytes]."""
        cells, level_set = self.counted_cells, self.pressure.surface == "ghost-fluid"
        bounded = self.walls_separate or self.pressure.model == "unilateral"
        motions = sum(solid.is_body for solid in self.solid) * (3 if self.dimension == 2 else 6)
        return {
            "pressure": cells
            * (
                PRESSURE_BYTES
                - BOUND_BYTES * (not bounded)
                + UNILATERAL_BYTES * (self.pressure.model == "unilateral")
            ),
            "viscosity": cells
            * (self.viscosity is not None)
            * (
                VISCOUS_BYTES[self.dimension]
                + MIXED_BYTES[self.dimension] * (self.carried_numbers(()) is not None)
            ),
            "coupled solve": cells * self.couples * STOKES_BYTES[self.dimension],
            "bodies": cells * (BODY_BYTES * bool(motions) + POTENTIAL_BYTES * motions),
            "drag along walls": cells * 4 * self.dimension * (self.drags is not None),
            "surface": cells
            * (not self.stays_full)
            * (
                LEVEL_SET_BYTES * (level_set or self.cuts_cells)
                + SMOOTHING_BYTES * (level_set and self.pressure.smoothing > 0)
            ),
            "surface tension": cells
            * TENSION_BYTES
            * (self.surface_tension is not None and not self.stays_full),
            "whitewater": 0
            if self.whitewater is None or not self.has_whitewater
            else cells * WHITEWATER_CELL_BYTES
            + self.whitewater.max_particles * WHITEWATER_PARTICLE_BYTES,
        }
