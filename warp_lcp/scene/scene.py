"""Base class of scenes: tables that every scene has.

Simulators subclass `Scene` with their materials and models.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self
from unicodedata import normalize

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, model_validator
from pydantic.functional_validators import ModelWrapValidatorHandler
from pydantic_core import PydanticCustomError

from warp_lcp.frames.meshio_format import FrameFormat
from warp_lcp.grid.domain_sides import SIDES
from warp_lcp.grid.voxelize import STRAY
from warp_lcp.problem.method_protocol import PrecisionName
from warp_lcp.scene.camera import Camera
from warp_lcp.scene.presets import PresetName, fill_in, preset_line
from warp_lcp.scene.shapes import (
    BODY_FRICTION,
    STICKS,
    Liquid,
    MaterialProperties,
    Shape,
    Solid,
    Wall,
)
from warp_lcp.scene.suspicious_settings import scene_notes
from warp_lcp.scene.table import (
    CrossKeyError,
    KeyFault,
    SceneError,
    Table,
    Vector,
    refuse,
    validate,
)
from warp_lcp.settings import Count, CountOrZero, Positive, Share, adapter
from warp_lcp.solvers.registry import grid_methods

if TYPE_CHECKING:
    from warp_lcp.rigid.joints import Joint

MOST_CELLS = 8192  # along an axis: float32 positions there are rounded to a thousandth of a cell
FAR_SIDES = ("right", "top", "front")

__all__ = [
    "CrossKeyError",
    "KeyFault",
    "Liquid",
    "Scene",
    "SceneError",
    "Shape",
    "Solid",
    "Table",
    "Vector",
    "Wall",
    "validate",
]

GridMethod = Literal[grid_methods()]


def _tolerance(value: object) -> object:
    """Return a number in (0, 1) or "auto", with an error as for any other number.

    The error does not mention the type of the alternative.
    """
    return value if value == "auto" else adapter(Share).validate_python(value)


Tolerance = Annotated[
    Share | Literal["auto"],
    BeforeValidator(_tolerance, json_schema_input_type=Share | Literal["auto"]),
]

PRESET_KEY = "set of defaults by accuracy"

LONGEST_NAME = 60  # characters; file systems allow 255 bytes, and a letter has up to four
NAME_RULE = (
    f'must be a name of at most {LONGEST_NAME} letters, digits, "-", "_", "." and spaces, '
    "without a dot or space at its ends"
)

WHOLE_CELLS = 1e-6  # largest relative distance of a side from a whole number of cells


def side_of_whole_cells(side: float, spacing: float) -> float:
    """Return a side [m] rounded up to whole cells.

    A side of whole cells, up to rounding errors, is returned as it is.
    """
    cells = side / spacing
    if round(cells) >= 1 and abs(cells - round(cells)) <= WHOLE_CELLS * cells:
        return side
    return math.ceil(cells) * spacing


def _name(text: str) -> str:
    """Return a valid name of a folder, also with a prefix; "" for no name."""
    if len(text) > LONGEST_NAME or text != text.strip(". ") or set(text) - set(file_name(text)):
        raise PydanticCustomError("name", NAME_RULE)
    return text


def file_name(text: str) -> str:
    """Return a text as a valid `scene.name`; "scene" if nothing is left of it."""
    kept = "".join(c if c.isalnum() or c in "-_. " else "-" for c in normalize("NFC", text))[
        :LONGEST_NAME
    ].strip(". ")
    return kept or "scene"


class SceneHeader(Table):
    """[scene]: simulator, name and description."""

    simulator: str = Field(description="fluids, granular, contacts or another plug-in")
    name: Annotated[str, AfterValidator(_name)] = Field(
        default="", description="short name; default: the file's"
    )
    description: str = Field(default="", description="sentence about the scene")


class Time(Table):
    """[time]: duration, frames and steps."""

    duration: Positive = Field(description="simulated time [s]")
    frames_per_second: Positive = Field(default=30.0, description="frames per simulated second")
    cfl: float = Field(default=2.0, ge=1e-3, description="Courant number, usually 1 to 4")
    dt_max: Positive = Field(default=0.02, description="longest step [s]")
    dt_min: Positive = Field(default=1e-6, description="shortest step from cfl or retries [s]")

    @property
    def frame_count(self) -> int:
        """Return the number of the last frame; frame 0 is the start."""
        return max(1, math.ceil(self.duration * self.frames_per_second * (1.0 - 1e-9)))

    def frame_time(self, frame: int) -> float:
        """Return the time [s] of a frame.

        The last one is the end of the run, even if that is no multiple of the frame interval.
        """
        return min(frame / self.frames_per_second, self.duration)


class Domain(Table):
    """[domain]: a box from the origin, and its grid.

    With `spacing` the domain is unbounded: right, top and front are open.
    """

    later: ClassVar = {"periodic": frozenset({True})}
    elsewhere: ClassVar = {"friction": "granular", "periodic": "granular"}
    has_grid: ClassVar[bool] = True
    size: list[Positive] = Field(
        min_length=2,
        max_length=3,
        description="sides [m]: [x, y] or [x, y, z], rounded up to whole cells; omitted with "
        "spacing",
    )
    resolution: int = Field(
        ge=2, le=MOST_CELLS, description="cells along the longest side; omitted with spacing"
    )
    spacing: Positive | None = Field(
        default=None,
        description="cell size [m] of an unbounded domain, instead of size and resolution",
    )
    dimension: Literal[2, 3] | None = Field(
        default=None, description="number of axes, with spacing; default: 3"
    )
    wall: Wall = Field(default="separating", description="boundary condition")
    solids: Literal["cut-cell", "voxel"] = Field(
        default="cut-cell",
        description="cut-cell: surfaces cut cells; voxel: solids fill whole cells and cannot move",
    )
    open: list[Literal[SIDES]] = Field(
        default_factory=list, description="sides where material leaves"
    )
    follow: bool = Field(
        default=True, description="grid around the material only; false: the whole domain"
    )
    periodic: list[Literal[False]] | None = Field(
        default=None, description="false along every axis"
    )
    _size_in_scene: list[float] = PrivateAttr(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _without_ends(cls, data: object) -> object:
        """Set the sides of a domain with `spacing` to an unreachable distance."""
        if (
            not isinstance(data, dict)
            or not isinstance(data.get("spacing"), int | float)
            or isinstance(data.get("open", []), str)
        ):
            return data
        axes = 2 if data.get("dimension") == 2 else 3
        sides = [
            *data.get("open", []),
            *(side for side in FAR_SIDES[:axes] if side not in data.get("open", [])),
        ]
        return {
            "size": [MOST_CELLS * data["spacing"]] * axes,
            "resolution": MOST_CELLS,
            "dimension": axes,
        } | {**data, "open": sides}

    @model_validator(mode="wrap")
    @classmethod
    def _with_whole_cells(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Round sides up to whole cells, and keep those that the scene has."""
        domain = handler(data)
        if domain.spacing is not None or not cls.has_grid:
            return domain
        spacing = max(domain.size) / domain.resolution
        sides = [side_of_whole_cells(side, spacing) for side in domain.size]
        if sides == domain.size:
            return domain
        rounded = domain.model_copy(update={"size": sides})
        rounded._size_in_scene = domain.size
        return rounded

    @property
    def rounded_sides(self) -> list[tuple[int, float, float]]:
        """Return axis, side in the scene and length [m] of each side that was rounded up."""
        sides = zip(self._size_in_scene, self.size, strict=False)
        return [(axis, given, side) for axis, (given, side) in enumerate(sides) if given != side]

    @property
    def boundless(self) -> bool:
        """Return whether the domain is unbounded."""
        return self.spacing is not None

    def spacing_errors(self) -> list[CrossKeyError]:
        """Return errors of `spacing` and `dimension`."""
        place, axes = ("domain", "spacing"), int(self.dimension or 0)
        if self.spacing is None:
            return (
                [
                    CrossKeyError(
                        ("domain", "dimension"),
                        axes,
                        "is only for a domain with spacing; otherwise size gives it",
                    )
                ]
                if axes
                else []
            )
        if (self.size, self.resolution) != ([MOST_CELLS * self.spacing] * axes, MOST_CELLS):
            return [
                CrossKeyError(
                    place,
                    self.spacing,
                    "replaces size and resolution: give either spacing or these",
                )
            ]
        return (
            []
            if self.follow
            else [
                CrossKeyError(
                    ("domain", "follow"),
                    False,
                    "must be true with spacing: no grid covers an unbounded domain",
                )
            ]
        )


class Physics(Table):
    """[physics]: gravity and density."""

    gravity: Vector = Field(description="acceleration of gravity [m/s^2]; default: 9.81 down")
    density: Positive = Field(
        default=1000.0, description="density of the liquid [kg/m^3]; of sand: material.density"
    )


class SolverTable(Table):
    """[solver]: solution of the complementarity problem of each step."""

    preset: PresetName | None = Field(default=None, description=PRESET_KEY)
    method: GridMethod = Field(
        default="projected-multigrid", description="the default is the fastest"
    )
    tolerance: Tolerance = Field(
        default=1e-4, description='relative residual; "auto": follows the time step'
    )
    precision: PrecisionName = Field(default="mixed", description="precision")
    max_iterations: Count = Field(default=100, description="iterations before the step fails")


class Output(Table):
    """[output]: files in the run folder."""

    particles: bool = Field(default=True, description="frames of particles")
    ids: bool = Field(default=False, description="id and age of each particle")
    grid: bool = Field(default=True, description="frames of cells")
    surface: bool = Field(default=False, description="frames of the surface")
    surface_resolution: int | None = Field(
        default=None,
        ge=1,
        le=8,
        description="surface points per cell edge; default: particles.per_axis",
    )
    surface_smoothing: float = Field(
        default=1.5, ge=0.5, le=10, description="kernel width of the surface [particle distances]"
    )
    surface_ply: bool = Field(default=False, description="surfaces also as PLY files")
    format: FrameFormat = Field(default="vtu", description="format of frames")
    grid_format: Literal["vtu", "vti"] = Field(default="vtu", description="format of cells")
    volume: bool = Field(default=False, description="frames of level set and density, 3-D")
    volume_format: Literal["nvdb", "vdb"] = Field(
        default="nvdb", description='format of volumes: NanoVDB; "vdb": OpenVDB, with velocity'
    )
    diagnostics: bool = Field(
        default=True, description="log volume and divergence; sand: yielding and dissipation"
    )
    forces: bool = Field(
        default=False, description="forces.csv: force and torque of a liquid on each solid"
    )
    checkpoint_every: CountOrZero = Field(
        default=50, description="steps between checkpoints; 0: unlimited"
    )
    checkpoint_minutes: Positive | None = Field(
        default=None, description="real time between checkpoints [min]"
    )
    checkpoints_kept: Count = Field(default=3, description="number of checkpoints kept")


class Scene(Table):
    """Scene file, read and validated.

    SI units; y is up; a domain of two sides is the x-y plane.
    """

    elsewhere: ClassVar = dict.fromkeys(("sand", "material", "friction", "gauge"), "granular")
    palette: ClassVar[Literal["water", "sand"]] = "water"  # color scheme of its images
    scene: SceneHeader
    time: Time
    domain: Domain
    physics: Physics
    solver: SolverTable = Field(default_factory=SolverTable)
    solid: list[Solid] = Field(default_factory=list)
    output: Output = Field(default_factory=Output)
    camera: Camera = Field(default_factory=Camera)

    @model_validator(mode="before")
    @classmethod
    def _gravity_is_down(cls, data: object) -> object:
        """Set gravity, whose default depends on the number of dimensions."""
        if not isinstance(data, dict):
            return data
        domain, physics = data.get("domain"), data.get("physics", {})
        size = domain.get("size") if isinstance(domain, dict) else None
        boundless = (
            isinstance(domain, dict)
            and size is None
            and domain.get("spacing") is not None
            and domain.get("dimension") != 2
        )
        if isinstance(physics, dict):
            gravity = (
                [0.0, -9.81, 0.0]
                if boundless or (isinstance(size, list) and len(size) == 3)
                else [0.0, -9.81]
            )
            return {**data, "physics": {"gravity": gravity, **physics}}
        return data

    @model_validator(mode="before")
    @classmethod
    def _preset_fills_in(cls, data: object) -> object:
        """Apply the defaults of `solver.preset`."""
        return fill_in(cls, data) if isinstance(data, dict) else data

    @model_validator(mode="after")
    def _check_across_tables(self) -> Self:
        refuse(type(self).__name__, self.find_errors())
        return self

    @property
    def dimension(self) -> int:
        """Return the domain's number of axes, 2 or 3."""
        return len(self.domain.size)

    @property
    def spacing(self) -> float:
        """Return the side of a cell [m]."""
        return self.domain.spacing or max(self.domain.size) / self.domain.resolution

    @property
    def has_whitewater(self) -> bool:
        """Return whether frames have spray, foam and bubbles."""
        return False

    @property
    def whitewater_estimate(self) -> int:
        """Return the estimated mean number of particles of whitewater in a run."""
        return 0

    @property
    def seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and high corner [m] of the region in pictures, shape (3,).

        It is the domain or, if that is unbounded, the region of the shapes.
        """
        size = np.array([*self.domain.size, 0.0][:3])
        boxes = (
            [shape.bounds(self.dimension) for _, shape in self.shapes()]
            if self.domain.boundless
            else []
        )
        near = [np.clip(box, 0.0, size) for box in boxes if box is not None]
        if not near:
            return np.zeros(3), size
        low, high = (
            np.min([box[0] for box in near], axis=0),
            np.max([box[1] for box in near], axis=0),
        )
        return low, np.maximum(high, low + self.spacing * (size > 0.0))

    @property
    def cell_counts(self) -> tuple[int, int, int]:
        """Return the cells along x, y and z; one along z in 2-D."""
        x, y, z = [round(side / self.spacing) for side in [*self.domain.size, self.spacing][:3]]
        return x, y, z

    @property
    def endless(self) -> tuple[int, ...]:
        """Return the periodic axes."""
        return ()

    def materials(self) -> tuple[str, Sequence[MaterialProperties]]:
        """Return the key of the material's shapes, such as `liquid`, and the shapes.

        Empty for scenes without a material.
        """
        return "material", ()

    def joints(self) -> Sequence[Joint]:
        """Return the joints between rigid bodies.

        Bodies are numbered from 0 in the order of their solids.
        """
        return ()

    def body_frictions(self) -> list[float]:
        """Return the friction coefficient of each solid against bodies and walls."""
        given = [
            BODY_FRICTION if solid.friction is None else solid.friction for solid in self.solid
        ]
        return [STICKS if friction == "stick" else float(friction) for friction in given]

    def find_errors(self) -> list[CrossKeyError]:
        """Return errors that involve several keys.

        Subclasses add theirs to `super().find_errors()`.
        """
        errors = self._grid_errors()
        if len(self.physics.gravity) != self.dimension:
            message = f"must have {self.dimension} entries, as domain.size has"
            errors.append(CrossKeyError(("physics", "gravity"), self.physics.gravity, message))
        if self.time.dt_min > self.time.dt_max:
            errors.append(
                CrossKeyError(
                    ("time", "dt_min"),
                    self.time.dt_min,
                    f"must not exceed time.dt_max = {self.time.dt_max}",
                )
            )
        errors += [
            CrossKeyError(("camera", *c.place), c.value, c.message)
            for c in self.camera.find_errors(self.dimension, self.domain.size)
        ]
        if self.output.volume and self.dimension == 2:
            errors.append(
                CrossKeyError(
                    ("output", "volume"), True, "needs a 3-D domain; domain.size has 2 entries"
                )
            )
        errors += (
            self.shape_errors("solid", self.solid) + self._motion_errors() + self._side_errors()
        )
        return errors + self._outside_errors()

    def shape_errors(
        self, key: str, shapes: Sequence[Shape], *, inside: bool = False
    ) -> list[CrossKeyError]:
        """Return errors of an array of shapes.

        Args:
            key: the array's name in the file, such as `liquid`.
            shapes: its entries.
            inside: also refuse entries that lie wholly outside the domain.
        """
        errors = []
        for index, shape in enumerate(shapes):
            own_errors = shape.find_errors(self.dimension)
            if inside and not own_errors and self.enclosed_volume(shape) == 0.0:
                own_errors = [
                    CrossKeyError(
                        (),
                        None,
                        "lies outside the domain, which extends from the origin to "
                        f"{self.domain.size} m",
                    )
                ]
            errors += [
                CrossKeyError((key, index, *error.place), error.value, error.message)
                for error in own_errors
            ]
        return errors

    def enclosed_volume(self, shape: Shape) -> float:
        """Return an upper bound of a shape's volume in the domain [m^3; m^2 in 2-D].

        The volume of its bounding box.
        """
        size = np.array(self.domain.size)
        bounds = shape.bounds(self.dimension)
        if bounds is None:
            return float(size.prod())
        low, high = (corner[: self.dimension] for corner in bounds)
        return float(np.maximum(np.minimum(high, size) - np.maximum(low, 0.0), 0.0).prod())

    def shapes(self) -> Iterator[tuple[str, Shape]]:
        """Yield every shape with its place in the file, such as `solid[0]`."""
        for key, entries in self:
            for index, entry in enumerate(entries if isinstance(entries, list) else ()):
                if isinstance(entry, Shape):
                    yield f"{key}[{index}]", entry

    def notes(self) -> list[str]:
        """Return suspicious settings, a line each, for the start of a run.

        Subclasses add those of their tables.
        """
        notes = []
        for place, shape in self.shapes():
            turned = shape.turned_out(self.domain.size)
            if turned is not None and turned[0] > STRAY * self.spacing:
                center = [float(f"{coordinate:.6g}") for coordinate in turned[1]]
                notes.append(
                    f"{place} ({shape.shape}): rotate about the origin moves it {turned[0]:.4g} m "
                    "out of the domain; to rotate it "
                    f"about its center, set about = {center}"
                )
        return [*notes, *scene_notes(self)]

    def memory_parts(self) -> dict[str, int]:
        """Return the estimated memory of each part of a run on its device [bytes].

        Defined by subclasses.
        """
        return {}

    def memory_estimate(self) -> int:
        """Return the estimated peak memory of a run [bytes]; 0: unknown.

        It does not include the program itself.
        """
        return sum(self.memory_parts().values())

    def plan(self) -> list[tuple[str, str]]:
        """Return a summary of the run, as pairs of a word and a line.

        Subclasses append theirs, such as particles and memory.
        """
        cells, spacing = self.cell_counts[: self.dimension], f"{self.spacing:.6g} m"
        extent = f"{' x '.join(map(str, cells))} = {math.prod(cells):,} cells of {spacing}"
        moving = ", ".join(
            f"solid {index} {solid.motion.kind}"
            for index, solid in enumerate(self.solid)
            if solid.motion
        )
        bodies = ", ".join(
            self._body_line(index, solid) for index, solid in enumerate(self.solid) if solid.is_body
        )
        preset = preset_line(self)
        return [
            *([("preset", preset)] if preset else []),
            (
                "grid",
                f"unbounded, cells of {spacing}, at most {MOST_CELLS} along an axis"
                if self.domain.boundless
                else extent,
            ),
            (
                "walls",
                ", ".join(
                    [
                        self.domain.wall,
                        *(f"solid {i} {s.wall}" for i, s in enumerate(self.solid) if s.wall),
                    ]
                ),
            ),
            *([("open", ", ".join(self.domain.open))] if self.domain.open else []),
            *([("moving", moving)] if moving else []),
            *([("bodies", bodies)] if bodies else []),
            (
                "time",
                f"{self.time.duration:g} s in steps of at most {self.time.dt_max:g} s, CFL "
                f"{self.time.cfl:g}",
            ),
            (
                "frames",
                f"{self.time.frame_count + 1} at {self.time.frames_per_second:g} per second",
            ),
            (
                "solver",
                f"{self.solver.method} to {_shown(self.solver.tolerance)}, {self.solver.precision} "
                "precision",
            ),
        ]

    def _side_errors(self) -> list[CrossKeyError]:
        """Return errors of the domain's open sides."""
        errors = []
        for index, side in enumerate(self.domain.open):
            if side in self.domain.open[:index]:
                errors.append(CrossKeyError(("domain", "open", index), side, "is named twice"))
            if side in SIDES[2 * self.dimension :]:
                errors.append(
                    CrossKeyError(
                        ("domain", "open", index),
                        side,
                        "is a side of a 3-D domain; domain.size has 2 entries",
                    )
                )
        return errors

    def _outside_errors(self) -> list[CrossKeyError]:
        """Return errors of rigid bodies that lie wholly outside the domain.

        As far as their keys tell, without mesh files.
        """
        return [
            CrossKeyError(
                ("solid", index),
                None,
                f"lies outside the domain, which extends from the origin to {self.domain.size} m",
            )
            for index, solid in enumerate(self.solid)
            if solid.is_body
            and not solid.find_errors(self.dimension)
            and self.enclosed_volume(solid) == 0.0
        ]

    def _motion_errors(self) -> list[CrossKeyError]:
        """Return errors of moving solids that fill whole cells."""
        if self.domain.solids == "cut-cell":
            return []
        message = 'needs domain.solids = "cut-cell": solids that fill whole cells cannot move'
        return [
            CrossKeyError(("solid", index, key), None, message)
            for index, solid in enumerate(self.solid)
            for key in ("motion", "mass", "density")
            if getattr(solid, key) is not None
        ]

    def _body_line(self, index: int, solid: Solid) -> str:
        """Return a description of a rigid body, for the plan."""
        unit = "kg" if self.dimension == 3 else "kg/m"
        return f"solid {index} {solid.shape} of " + (
            f"{solid.mass:g} {unit}" if solid.mass is not None else f"{solid.density:g} kg/m^3"
        )

    def _grid_errors(self) -> list[CrossKeyError]:
        """Return errors of the grid: spacing, periodic axes."""
        errors = self.domain.spacing_errors()
        if self.domain.periodic is not None and len(self.domain.periodic) != self.dimension:
            errors.append(
                CrossKeyError(
                    ("domain", "periodic"),
                    self.domain.periodic,
                    f"must have {self.dimension} entries",
                )
            )
        return errors


def _shown(tolerance: float | str) -> str:
    """Return a solver's tolerance in words."""
    return f"{tolerance:g}" if isinstance(tolerance, float) else "a tenth of the time step's error"
