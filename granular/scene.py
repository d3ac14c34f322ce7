"""Scene tables of sand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from warp_lcp.granular.materials import MATERIALS, FrictionAngleTest, Material, slope
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.scene.presets import PresetName
from warp_lcp.scene.scene import PRESET_KEY, CrossKeyError, Domain, Table, Time
from warp_lcp.scene.shapes import (
    FRICTIONS,
    STICKS,
    MaterialProperties,
    ShapeUnion,
    SolidProperties,
    WallFriction,
)
from warp_lcp.scene.suspicious_settings import GRAIN_DENSITY, UsualRange
from warp_lcp.settings import NonNegative, Positive, Share

STRESS_BYTES = {2: 160, 3: 330}  # bytes per cell: the coupled solve's fields
CUT_STRESS_BYTES = {2: 48, 3: 76}  # added where solids cut cells
# Slope k from which on the yield cone contains tensile stresses.
STEEPEST = {2: 1.0, 3: math.sqrt(0.75)}
STEEPEST_ANGLE = {  # degrees
    "repose": {2: 50.7, 3: 45.5},
    "simple-shear": {2: 45.0, 3: 40.8},
    "triaxial-compression": {3: 36.8},
}
FRICTION_ANGLE = UsualRange(6.0, 60.0, "degrees", "25 to 45", "radians", math.degrees(1.0))
# Estimated error of the velocities [g dt] at which a solve ends, relative to its tolerance.
VELOCITY_SHARE = 50.0
COHESION = UsualRange(0.0, 1e6, "Pa", "100 to 5,000 (damp sand), 1e4 to 1e5 (clay)")
SAND_CFL = UsualRange(0.0, 4.0, "", "0.5 to 1")
# Inertial number at which friction of glass beads has reached half of its growth
# [Jop, Forterre & Pouliquen 2006].
GLASS = 0.279

Angle = Annotated[float, Field(gt=0, lt=60)]


class SandTime(Time):
    """[time]: shorter default steps.

    Sand that moves further than a cell per step packs unevenly.
    """

    cfl: float = Field(default=0.8, ge=1e-3, description="Courant number, usually 0.5 to 1")
    dt_max: Positive = Field(default=5e-3, description="longest step [s]")


class SandDomain(Domain):
    """[domain]: also wall friction and periodic axes."""

    later: ClassVar = {}
    friction: WallFriction | None = Field(
        default=None,
        description=f"friction coefficient of the domain's walls: {FRICTIONS}; default: "
        "material.wall_friction",
    )
    solids: Literal["cut-cell", "voxel"] = Field(
        default="cut-cell",
        description="cut-cell: surfaces cut cells; voxel: solids fill whole cells and cannot move; "
        "stresses treat solids as whole cells if sand moves one, thin ones move, an axis is "
        'periodic or solver.method = "interleaved-sweeps"',
    )
    periodic: list[bool] | None = Field(
        default=None, description="periodic axes, [x, y] or [x, y, z]; not y"
    )  # type: ignore[assignment]


class MaterialTable(Table):
    """[material]: properties of the grains."""

    renamed: ClassVar = {"angle_of": "friction_angle_test"}
    # Under its old name the angle of repose was that of layers, k = tan.
    renamed_values: ClassVar = {"angle_of": {"repose": "simple-shear"}}
    name: Literal["dry-sand", "gravel", "sugar"] = Field(
        default="dry-sand", description="material that gives the defaults"
    )
    friction_angle: Angle | None = Field(
        default=None,
        description="friction angle [degrees], by default the slope of a heap, see "
        "friction_angle_test; default: by name",
    )
    density: Positive | None = Field(
        default=None,
        description="density at the densest packing, air included [kg/m^3]; default: by name",
    )
    max_fraction: Share | None = Field(
        default=None,
        description="volume fraction of grains at the densest packing; default: by name",
    )
    wall_friction: WallFriction | None = Field(
        default=None,
        description=f"friction coefficient of walls and solids: {FRICTIONS}; default: by name",
    )
    cohesion: NonNegative = Field(
        default=0.0,
        description="cohesion [Pa]: the shear strength at zero pressure is this times k / "
        "tan(friction_angle), see friction_angle_test",
    )
    tensile_strength: NonNegative = Field(
        default=0.0, description="tensile strength at dense packing [Pa]"
    )
    friction_angle_test: FrictionAngleTest | None = Field(
        default=None,
        description="test that measured friction_angle: repose (slope of a heap), simple-shear "
        "(slope where layers stop), plane-strain or triaxial-compression (soils); default: repose, "
        "simple-shear with friction.dynamic_angle",
    )


class Friction(Table):
    """[friction]: shear strength of sand.

    With `dynamic_angle`, friction grows with the shear rate: mu(I)
    [Jop, Forterre & Pouliquen 2006]. Glass beads of 0.53 mm have 20.9 and 32.76 degrees. An
    iteration of the solve takes up to 1.4 times as long.
    """

    model: Literal["cone", "box"] = Field(
        default="cone",
        description="cone: isotropic; box: Narain et al. 2010, layers flow where they should rest",
    )
    dynamic_angle: Angle | None = Field(
        default=None, description="friction angle at high shear rates [degrees]"
    )
    grain_size: Positive | None = Field(
        default=None, description="grain diameter [m], with dynamic_angle"
    )
    inertial_number: float | None = Field(
        default=None,
        ge=1e-9,
        description=f"I_0 of mu(I), with dynamic_angle; default: {GLASS:g} (glass beads)",
    )


class Gauge(Table):
    """[gauge]: flow rate through a height, `flow_rate` in the log."""

    height: float = Field(description="height above the domain's floor [m]")


def _not_automatic(value: object) -> object:
    """Refuse "auto", which is for liquids."""
    if value == "auto":
        message = (
            "is for liquids only: the tolerance of sand is relative to rho g dx, the weight "
            "of a cell; default: 1e-3"
        )
        raise PydanticCustomError("cross_check", "{message}", {"message": message})
    return value


class SandSolver(Table):
    """[solver]: solution for pressure and friction together."""

    preset: PresetName | None = Field(default=None, description=PRESET_KEY)
    method: Literal["accelerated-projection", "interleaved-sweeps"] = Field(
        default="accelerated-projection",
        description="accelerated-projection, or interleaved-sweeps: several times slower",
    )
    tolerance: Annotated[Share, BeforeValidator(_not_automatic)] = Field(
        default=1e-3, description="root mean square residual [rho g dx]"
    )
    velocity_tolerance: NonNegative | None = Field(
        default=None,
        description="a solve also ends where the estimated error of the velocities is at most this "
        "[g dt]; default: 50 tolerance, 0 with interleaved-sweeps; 0: only the residual counts",
    )
    max_iterations: int = Field(
        default=600, ge=10, description="after these the step accepts the stresses"
    )
    precision: Literal["single"] = Field(
        default="single", description="of the stresses; residuals are double"
    )

    @property
    def allowed_velocity_error(self) -> float:
        """Return the tolerance of the velocities [g dt], 0 if only the residual counts."""
        if self.velocity_tolerance is not None:
            return self.velocity_tolerance
        return 0.0 if self.method == "interleaved-sweeps" else VELOCITY_SHARE * self.tolerance


class SandProperties(MaterialProperties):
    """Properties of a body of sand besides its shape."""

    noun: ClassVar[str] = "Sand"
    friction_angle: Angle | None = Field(
        default=None, description="friction angle [degrees]; default: material.friction_angle"
    )
    cohesion: NonNegative | None = Field(
        default=None, description="cohesion [Pa]; default: material.cohesion"
    )


class RoughProperties(SolidProperties):
    """Properties of a solid that has friction with sand."""

    noun: ClassVar[str] = "Solid with friction"
    rubs: ClassVar[bool] = True


Sand = ShapeUnion[SandProperties]
Solid = ShapeUnion[RoughProperties]


def _true_errors(rules: Iterable[tuple[object, str, object, str]]) -> list[CrossKeyError]:
    """Return the errors whose condition is true.

    Each rule has a condition, the key, its value and the message.
    """
    return [
        CrossKeyError(tuple(key.split(".")), value, message)
        for case, key, value, message in rules
        if case
    ]


class SandScene(ParticleScene):
    """Scene of sand."""

    elsewhere: ClassVar = {"liquid": "fluids", "pressure": "fluids", "whitewater": "fluids"}
    palette: ClassVar = "sand"
    solve_bytes: ClassVar[int] = STRESS_BYTES[3]
    # Sand at rest has 1e-5; its pressure does not push overlapping particles apart.
    crowded: ClassVar[float] = 4e-4
    # Limits the density to 1.1 of the densest packing nearly everywhere; 1 would give 1.27.
    correction_gain: ClassVar[float] = 4.0
    # Friction slows sand down: 0.25 for columns, 0.4 to 0.8 for flows.
    fall_speed: ClassVar[float] = 0.5

    time: SandTime
    domain: SandDomain
    material: MaterialTable = Field(default_factory=MaterialTable)
    friction: Friction = Field(default_factory=Friction)
    gauge: Gauge | None = None
    solver: SandSolver = Field(default_factory=SandSolver)  # type: ignore[assignment]
    sand: list[Sand] = Field(default_factory=list)
    solid: list[Solid] = Field(default_factory=list)  # type: ignore[assignment]

    @model_validator(mode="before")
    @classmethod
    def _density_of_material(cls, data: object) -> object:
        """Set the default density to that of the material."""
        if not isinstance(data, dict):
            return data
        material, physics = data.get("material", {}), data.get("physics", {})
        if not isinstance(material, dict) or not isinstance(physics, dict):
            return data
        named = (
            MATERIALS.get(material.get("name", "dry-sand"))
            if isinstance(material.get("name", ""), str)
            else None
        )
        density = material.get("density", named.density if named else None)
        return data if density is None else {**data, "physics": {"density": density, **physics}}

    def materials(self) -> tuple[str, Sequence[MaterialProperties]]:
        """Return the key `sand` and its shapes."""
        return "sand", self.sand

    @property
    def endless(self) -> tuple[int, ...]:
        """Return the periodic axes."""
        return tuple(axis for axis, endless in enumerate(self.domain.periodic or ()) if endless)

    @property
    def preset(self) -> Material:
        """Return the named material."""
        return MATERIALS[self.material.name]

    @property
    def corrects_steadily(self) -> bool:
        """Return whether each step of `correction.every` corrects the density.

        So it is where axes are periodic or solids move: sand is sheared for long there, and packs
        by 4 % before many cells are overfull.
        """
        moved = any(solid.motion is not None for solid in self.solid)
        return super().corrects_steadily or bool(self.endless) or moved

    @property
    def friction_angle(self) -> float:
        """Return the internal friction angle [degrees]."""
        own = next(
            (sand.friction_angle for sand in self.sand if sand.friction_angle is not None), None
        )
        return own or self.material.friction_angle or self.preset.friction_angle

    @property
    def cohesion(self) -> float:
        """Return the cohesion [Pa], from the scene or the material."""
        own = next((sand.cohesion for sand in self.sand if sand.cohesion is not None), None)
        return self.material.cohesion if own is None else own

    @property
    def slope(self) -> float:
        """Return k of the yield set |s|_F / sqrt(2) <= k p."""
        return self._slope_of(self.friction_angle)

    @property
    def friction_angle_test(self) -> FrictionAngleTest:
        """Return the test that measured the friction angles.

        mu(I) is measured on layers, so the angles of rate-dependent friction are theirs by default.
        """
        grows = self.friction.dynamic_angle is not None
        return self.material.friction_angle_test or ("simple-shear" if grows else "repose")

    def _slope_of(self, angle: float) -> float:
        return slope(angle, self.friction_angle_test, self.dimension)

    @property
    def intercept(self) -> float:
        """Return the largest |s|_F / sqrt(2) without pressure [Pa]."""
        return self.slope * self.cohesion / math.tan(math.radians(self.friction_angle))

    def growth(self, spacing: float, kick_dt: float) -> dict[str, float]:
        """Return `gain` and `halfway` of the yield set; empty without mu(I).

        I = |shear rate| d sqrt(rho_s / p) [Jop, Forterre & Pouliquen 2006], with the grain density
        rho_s = rho / max_fraction.

        Args:
            spacing: cell size [m].
            kick_dt: time that forces act [s].
        """
        dynamic, grain = self.friction.dynamic_angle, self.friction.grain_size
        if dynamic is None or grain is None:
            return {}
        halfway = (
            (self.friction.inertial_number or GLASS)
            * spacing
            / grain
            * math.sqrt(self.max_fraction * spacing / kick_dt)
        )
        return {"gain": self._slope_of(dynamic) - self.slope, "halfway": halfway}

    @property
    def max_fraction(self) -> float:
        """Return the volume fraction of grains at the densest packing."""
        return self.material.max_fraction or self.preset.max_fraction

    def wall_frictions(self) -> list[float]:
        """Return the friction coefficient of the domain's walls and of each solid."""
        general = (
            self.preset.wall_friction
            if self.material.wall_friction is None
            else self.material.wall_friction
        )
        domain = general if self.domain.friction is None else self.domain.friction
        given = [domain, *(domain if s.friction is None else s.friction for s in self.solid)]
        return [STICKS if friction == "stick" else float(friction) for friction in given]

    def body_frictions(self) -> list[float]:
        """Return the friction coefficient of each solid's surface."""
        return self.wall_frictions()[1:]

    def find_errors(self) -> list[CrossKeyError]:
        """Return errors that involve several keys."""
        errors = super().find_errors()
        angles = [sand.friction_angle for sand in self.sand]
        cohesions = [sand.cohesion for sand in self.sand]
        for key, first, values in (
            ("friction_angle", self.friction_angle, angles),
            ("cohesion", self.cohesion, cohesions),
        ):
            for number, value in enumerate(values):
                if value is not None and value != first:
                    message = (
                        f"must be {first:g} as in the other [[sand]]: a scene has one material"
                    )
                    errors.append(CrossKeyError(("sand", number, key), value, message))
        return errors + self._strength_errors() + self._rate_errors() + self._domain_errors()

    def notes(self) -> list[str]:
        """Return suspicious settings."""
        notes = [
            *super().notes(),
            *GRAIN_DENSITY.notes("physics.density", self.physics.density),
            *SAND_CFL.notes("time.cfl", self.time.cfl),
        ]
        angles = [
            ("material.friction_angle", self.material.friction_angle),
            ("friction.dynamic_angle", self.friction.dynamic_angle),
        ]
        angles += [
            (f"sand[{number}].friction_angle", sand.friction_angle)
            for number, sand in enumerate(self.sand)
        ]
        for place, angle in angles:
            notes += FRICTION_ANGLE.notes(place, angle)
        cohesions = [("material.cohesion", self.material.cohesion)]
        cohesions += [
            (f"sand[{number}].cohesion", sand.cohesion)
            for number, sand in enumerate(self.sand)
            if sand.cohesion is not None
        ]
        for place, cohesion in cohesions:
            notes += COHESION.notes(place, cohesion)
        grains = self.friction.grain_size
        if grains is not None and grains > self.spacing:
            notes.append(
                f"friction.grain_size = {grains:g} m is larger than a cell, {self.spacing:.4g} m; "
                f"if mm were meant, it is {1e-3 * grains:g}"
            )
        return notes

    def _strength_errors(self) -> list[CrossKeyError]:
        material, most = self.material, self.cohesion / math.tan(math.radians(self.friction_angle))
        if material.tensile_strength > most:
            message = (
                f"must be at most {most:.4g}, the cohesion over the tangent of the friction angle"
            )
            return [
                CrossKeyError(("material", "tensile_strength"), material.tensile_strength, message)
            ]
        if self._slope_of(self.friction_angle) > STEEPEST[self.dimension]:
            return [self._too_steep()]
        if material.density is not None and material.density != self.physics.density:
            message = f"differs from physics.density = {self.physics.density:g}; give one of them"
            return [CrossKeyError(("material", "density"), material.density, message)]
        return []

    def _too_steep(self) -> CrossKeyError:
        """Return the error of a friction angle, at the key that sets it."""
        angle, message = self.friction_angle, self._at_most()
        number = next(
            (number for number, sand in enumerate(self.sand) if sand.friction_angle is not None),
            None,
        )
        if number is None and self.material.friction_angle is None:
            return CrossKeyError(
                ("material", "name"),
                self.material.name,
                f"has a friction angle of {angle:g} degrees, which {message}",
            )
        return CrossKeyError(
            ("material", "friction_angle")
            if number is None
            else ("sand", number, "friction_angle"),
            angle,
            message,
        )

    def _at_most(self) -> str:
        """Return the allowed range of an angle that is too steep, in words."""
        test = self.friction_angle_test
        most = STEEPEST_ANGLE[test][self.dimension]
        return (
            f'must be at most {most:g} where material.friction_angle_test = "{test}": a steeper '
            "cone would bear tension"
        )

    def _rate_errors(self) -> list[CrossKeyError]:
        """Return errors of friction that grows with the shear rate."""
        table, dynamic = self.friction, self.friction.dynamic_angle
        if dynamic is None:
            given = {"grain_size": table.grain_size, "inertial_number": table.inertial_number}
            message = "needs friction.dynamic_angle, which is missing"
            return _true_errors(
                (value is not None, f"friction.{key}", value, message)
                for key, value in given.items()
            )
        above = (
            f"must be above the friction angle, {self.friction_angle:g} degrees: friction "
            "grows with the rate of shear"
        )
        small, steep = (
            dynamic <= self.friction_angle,
            self._slope_of(dynamic) > STEEPEST[self.dimension],
        )
        missing = "must be given with friction.dynamic_angle: a length > 0 [m]"
        return _true_errors(
            [
                (small, "friction.dynamic_angle", dynamic, above),
                (
                    steep and not small,
                    "friction.dynamic_angle",
                    dynamic,
                    self._at_most() if steep else "",
                ),
                (table.grain_size is None, "friction.grain_size", None, missing),
                (
                    table.model == "box",
                    "friction.model",
                    table.model,
                    'must be "cone" with friction.dynamic_angle',
                ),
            ]
        )

    def _domain_errors(self) -> list[CrossKeyError]:
        """Return errors of periodic axes, rigid bodies and keys that sand lacks."""
        domain, method, closed, periodic = (
            self.domain,
            self.solver.method,
            self.endless,
            self.domain.periodic or [],
        )
        opened = any(
            side in domain.open
            for axis in closed
            for side in (("left", "right"), (), ("back", "front"))[axis]
        )
        ends = closed and (self.particles.reseed or self.source or self.drain)
        sweeps, bodies = method == "interleaved-sweeps", any(solid.is_body for solid in self.solid)
        holds = domain.wall != "separating" or any(
            solid.wall == "free-slip" for solid in self.solid
        )
        pulls = (
            'must be "separating", for solids too: walls cannot pull sand; for free slip set '
            "friction = 0"
        )
        height, top = None if self.gauge is None else self.gauge.height, domain.size[1]
        return _true_errors(
            [
                (
                    1 in closed,
                    "domain.periodic",
                    periodic,
                    "may be true along x and z only: sand falls along y",
                ),
                (opened, "domain.open", domain.open, "names a side of a periodic axis"),
                (
                    ends,
                    "domain.periodic",
                    periodic,
                    "cannot be combined with reseed, source or drain",
                ),
                (
                    closed and sweeps,
                    "solver.method",
                    method,
                    "cannot be combined with periodic axes: choose accelerated-projection",
                ),
                (
                    bodies and sweeps,
                    "solver.method",
                    method,
                    "cannot be combined with rigid bodies: choose accelerated-projection",
                ),
                (
                    bodies and closed,
                    "domain.periodic",
                    domain.periodic,
                    "cannot be combined with rigid bodies",
                ),
                (holds, "domain.wall", domain.wall, pulls),
                (
                    height is not None and not 0.0 < height < top,
                    "gauge.height",
                    height,
                    f"must lie in the domain, between 0 and {top:g} m",
                ),
            ]
        )

    def plan(self) -> list[tuple[str, str]]:
        """Return a summary of the run."""
        frictions = ", ".join("stick" if f == STICKS else f"{f:g}" for f in self.wall_frictions())
        cohesion = f", cohesion {self.cohesion:g} Pa" if self.cohesion else ""
        dynamic, grain = self.friction.dynamic_angle, self.friction.grain_size
        growing = (
            f", growing to {dynamic:g} degrees with the rate of shear of grains of {grain:g} m"
            if dynamic
            else ""
        )
        material = (
            f"{self.material.name}, friction angle {self.friction_angle:g} "
            f"degrees{cohesion}, {self.physics.density:g} kg/m^3"
        )
        return [
            *super().plan(),
            ("material", material),
            ("friction", f"{self.friction.model}{growing}, on walls {frictions}"),
        ]

    def own_memory_parts(self) -> dict[str, int]:
        """Return the peak memory of the stresses on the device [bytes]."""
        cut = CUT_STRESS_BYTES[self.dimension] if self.cuts_cells else 0
        return {"stresses": self.counted_cells * (STRESS_BYTES[self.dimension] + cut)}
