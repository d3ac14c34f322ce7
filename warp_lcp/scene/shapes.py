"""Shapes of a scene file: solids, initial material, sources and drains."""

from __future__ import annotations

import operator
import sys
from abc import abstractmethod
from functools import cache, cached_property, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import (
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    create_model,
)
from pydantic_core import PydanticCustomError

from warp_lcp.scene.motions import Motion
from warp_lcp.scene.table import Angles, CrossKeyError, Table, Vector, counted
from warp_lcp.settings import NonNegative, Part, Positive

if TYPE_CHECKING:
    from warp_lcp.grid.signed_distance import Geometry, Placement

BUILTIN = "builtin:"  # prefix of the names of meshes that the project generates

Wall = Literal["separating", "free-slip", "sticky"]


def _wall_friction(value: object, handler: ValidatorFunctionWrapHandler) -> float | str:
    """Return a number from 0 to 10 or "stick", with one error for both alternatives."""
    try:
        friction: float | str = handler(value)
    except ValidationError as error:
        raise PydanticCustomError(
            "friction", 'must be a number from 0 to 10, or "stick"'
        ) from error
    return friction


WallFriction = Annotated[
    Annotated[float, Field(ge=0, le=10)] | Literal["stick"],
    WrapValidator(_wall_friction, json_schema_input_type=float | Literal["stick"]),
]
FRICTIONS = "0 (free slip) to 10, or stick"
# Coulomb's coefficient of a sticky wall: sand at the wall slides only where the sand itself yields.
STICKS = 1e6
BODY_FRICTION = 0.5  # default of a rigid body


class _BoundsCache:
    """Cache of a shape's bounding boxes by dimension.

    Caches compare by identity; shapes are compared by their keys only.
    """

    def __init__(self) -> None:
        self.known: dict[int, np.ndarray | None] = {}


class Shape(Table):
    """Region of space: p = about + rotation (scale (q - about)) + translation.

    `about` is the origin by default. `rotate` is in degrees: one angle in 2-D, angles about the
    fixed axes x, y, z (in that order) in 3-D. `invert` swaps inside and outside.
    """

    noun: ClassVar[str] = "Shape"  # what a table fills: begins its description
    if TYPE_CHECKING:
        shape: str  # value of the file's key, unique for each kind of shape
    translate: Vector | None = Field(default=None, description="translation [m]")
    rotate: Angles | None = Field(
        default=None, description="rotation [degrees]: a number in 2-D, [x, y, z] in 3-D"
    )
    about: Vector | None = Field(
        default=None, description="fixed point of scale and rotate [m]; default: the origin"
    )
    scale: Positive = Field(default=1.0, description="scale factor")
    invert: bool = Field(default=False, description="fill the outside")

    @abstractmethod
    def to_geometry(self, folder: Path, dimension: int) -> Geometry:
        """Return the shape as a signed distance.

        Args:
            folder: folder of the files that the shape names.
            dimension: 2 or 3.

        Raises:
            ValueError: a file cannot be read or does not enclose a volume.
        """

    def placement(self, dimension: int) -> Placement:
        """Return scale, rotation and translation in a scene of 2 or 3 dimensions."""
        from warp_lcp.grid.signed_distance import Placement

        zeros = [0.0] * dimension
        placement = Placement.from_degrees(
            self.scale,
            self.rotate or zeros[: 1 if dimension == 2 else 3],
            self.translate or zeros,
            dimension,
        )
        return placement if self.about is None else placement.about(self.about)

    def turned_out(self, domain: list[float]) -> tuple[float, list[float]] | None:
        """Return the distance by which `rotate` moves the shape out of a domain.

        And its center before [m]; None if it does not. Only for shapes that are rotated about the
        origin, which may be a mistake.
        """
        if self.about is not None or not any(self.rotate or []) or self.invert:
            return None
        dimension, unturned = len(domain), self.model_copy(update={"rotate": None})
        placed = [shape.to_geometry(Path(), dimension).bounds() for shape in (unturned, self)]
        if placed[0] is None or placed[1] is None:
            return None
        corners = [box[:, :dimension] for box in placed if box is not None]
        before, now = (
            max(float(-low.min()), float((high - domain).max()), 0.0) for low, high in corners
        )
        return (now, corners[0].mean(axis=0).tolist()) if now > before else None

    def bounds(self, dimension: int) -> np.ndarray | None:
        """Return the low and high corner [m] of a box around the shape, shape (2, 3).

        None if the shape is unbounded, or only its file has its size.
        """
        known = self._boxes.known
        if dimension not in known:
            known[dimension] = self.to_geometry(Path(), dimension).bounds()
        return known[dimension]

    @cached_property
    def _boxes(self) -> _BoundsCache:
        return _BoundsCache()

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the shape in a scene of 2 or 3 dimensions."""
        lengths = {name: dimension for name, value in self if isinstance(value, list)}
        lengths |= {
            name: 1 if dimension == 2 else 3
            for name in ("rotate", "angular_velocity")
            if name in lengths
        }
        return [
            CrossKeyError(
                (type(self).model_fields[name].alias or name,),
                value,
                f"must {counted(count)} in {dimension}-D",
            )
            for name, count in lengths.items()
            if len(value := getattr(self, name)) != count
        ] + (
            [CrossKeyError(("about",), self.about, "has no effect without rotate or scale")]
            if self._about_idles
            else []
        )

    @property
    def _about_idles(self) -> bool:
        return self.about is not None and self.rotate is None and self.scale == 1.0


Properties = TypeVar("Properties", bound=Shape)


class BoxTable(Shape):
    """Box between two corners."""

    shape: Literal["box"] = "box"
    min: Vector = Field(description="lower corner [m]")
    max: Vector = Field(description="upper corner [m]")

    def to_geometry(self, folder: Path, dimension: int) -> Geometry:
        """Return the box; in 2-D it extends along z without limit."""
        from warp_lcp.grid import signed_distance

        return signed_distance.Box(
            lower=self.min, upper=self.max, placement=self.placement(dimension), invert=self.invert
        )

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the box in a scene of 2 or 3 dimensions."""
        errors = super().find_errors(dimension)
        if not errors and any(low >= high for low, high in zip(self.min, self.max, strict=True)):
            errors.append(
                CrossKeyError(
                    ("max",), self.max, f"must be greater than min = {self.min} along every axis"
                )
            )
        return errors


class SphereTable(Shape):
    """Ball; a disc in 2-D."""

    shape: Literal["sphere"] = "sphere"
    center: Vector = Field(description="center [m]")
    radius: Positive = Field(description="radius [m]")

    def to_geometry(self, folder: Path, dimension: int) -> Geometry:
        """Return the ball, a disk in 2-D."""
        from warp_lcp.grid import signed_distance

        return signed_distance.Sphere(
            center=self.center,
            radius=self.radius,
            placement=self.placement(dimension),
            invert=self.invert,
        )


class CapsuleTable(Shape):
    """All points within a radius of a segment."""

    shape: Literal["capsule"] = "capsule"
    start: Vector = Field(alias="from", description="start of the axis [m]")
    end: Vector = Field(alias="to", description="end of the axis [m]")
    radius: Positive = Field(description="radius [m]")

    def to_geometry(self, folder: Path, dimension: int) -> Geometry:
        """Return the capsule around its axis."""
        from warp_lcp.grid import signed_distance

        return signed_distance.Capsule(
            start=self.start,
            end=self.end,
            radius=self.radius,
            placement=self.placement(dimension),
            invert=self.invert,
        )

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the capsule in a scene of 2 or 3 dimensions."""
        errors = super().find_errors(dimension)
        if self.start == self.end:
            errors.append(
                CrossKeyError(("to",), self.end, 'must differ from "from"; use a sphere otherwise')
            )
        return errors


class PlaneTable(Shape):
    """Half space on the side of a plane opposite to its normal."""

    shape: Literal["plane"] = "plane"
    point: Vector = Field(description="point of the plane [m]")
    normal: Vector = Field(description="outward normal of any length")

    def to_geometry(self, folder: Path, dimension: int) -> Geometry:
        """Return the half space on the side opposite to the normal."""
        from warp_lcp.grid import signed_distance

        return signed_distance.Plane(
            point=self.point,
            normal=self.normal,
            placement=self.placement(dimension),
            invert=self.invert,
        )

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the plane in a scene of 2 or 3 dimensions."""
        errors = super().find_errors(dimension)
        if not any(self.normal):
            errors.append(CrossKeyError(("normal",), self.normal, "must not be zero"))
        return errors


class MeshTable(Shape):
    """Interior of a closed triangle surface; in 2-D its cut by the plane z = 0.

    An open surface with a thickness is a wall.
    """

    shape: Literal["mesh"] = "mesh"
    file: str = Field(
        min_length=1, description=f"OBJ, STL or PLY file, or built-in, such as {BUILTIN}torus"
    )
    thickness: float | None = Field(
        default=None,
        gt=0.0,
        le=1e9,
        description="thickness of the wall whose middle is an open mesh [m]; without it the mesh "
        "must be closed",
    )

    def to_geometry(self, folder: Path, dimension: int) -> Geometry:
        """Return the inside of the mesh."""
        from warp_lcp.grid import signed_distance

        return signed_distance.TriangleMesh.from_file(
            self.file,
            folder=folder,
            placement=self.placement(dimension),
            invert=self.invert,
            thickness=self.thickness,
        )

    def bounds(self, dimension: int) -> np.ndarray | None:
        """Return None: the size is only in the file."""
        return None


SHAPES = (BoxTable, SphereTable, CapsuleTable, PlaneTable, MeshTable)


@cache
def shaped(properties: type[Properties], shape: type[Shape]) -> type[Properties]:
    """Return the table of a shape with properties, such as SolidBox.

    SolidBox has the keys of SolidProperties and BoxTable. Like a written class it is a name of the
    module of its properties, by which it is pickled.
    """
    name = properties.__name__.removesuffix("Properties") + shape.__name__.removesuffix("Table")
    kind = (shape.__doc__ or "").partition("\n")[0]
    table: Any = create_model(
        name,
        __base__=(properties, shape),
        __module__=properties.__module__,
        __doc__=f"{properties.noun}: {kind[0].lower()}{kind[1:]}",
    )
    setattr(sys.modules[properties.__module__], name, table)
    return table


if TYPE_CHECKING:
    ShapeUnion = Annotated[Properties, "of any shape"]
else:

    class ShapeUnion:
        """Union of the tables of all shapes with the same properties, chosen by the key `shape`."""

        def __class_getitem__(cls, properties: type[Shape]) -> Any:
            """Return the union: `OfAnyShape[SolidProperties]`."""
            tables = tuple(shaped(properties, shape) for shape in SHAPES)
            return Annotated[reduce(operator.or_, tables), Field(discriminator="shape")]


class SolidProperties(Shape):
    """Properties of a solid besides its shape.

    Solids with more properties have a class derived from this one.
    """

    noun: ClassVar[str] = "Solid"
    rubs: ClassVar[bool] = False  # whether the material has friction with solids at rest
    wall: Wall | None = Field(default=None, description="boundary condition; default: domain.wall")
    slip_length: float | None = Field(
        default=None,
        ge=0,
        allow_inf_nan=True,
        description="slip length of viscous liquid [m]; inf: free slip; default: "
        "viscosity.slip_length",
    )
    motion: Motion | None = Field(default=None, description="prescribed motion; default: at rest")
    mass: float | None = Field(
        default=None, ge=1e-18, description="mass of a rigid body [kg; kg/m in 2-D]"
    )
    density: float | None = Field(
        default=None, ge=1e-18, description="density of a rigid body, instead of mass [kg/m^3]"
    )
    velocity: Vector | None = Field(
        default=None, description="initial velocity of a body [m/s]; default: 0"
    )
    angular_velocity: Angles | None = Field(
        default=None,
        description="initial [degrees/s]: a number in 2-D, [x, y, z] in 3-D; default: 0",
    )
    friction: WallFriction | None = Field(
        default=None,
        description=f"friction coefficient against sand, bodies and walls: {FRICTIONS}; "
        f"default: domain.friction, in liquids {BODY_FRICTION:g}",
    )
    restitution: Part = Field(default=0.0, description="coefficient of restitution")
    drag: NonNegative | None = Field(
        default=None, description="drag coefficient c_f in a liquid; default: wall_drag.coefficient"
    )

    @property
    def is_body(self) -> bool:
        """Return whether it is a rigid body."""
        return self.mass is not None or self.density is not None

    @property
    def moves(self) -> bool:
        """Return whether it moves."""
        return self.is_body or self.motion is not None

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the solid in a scene of 2 or 3 dimensions."""
        moves = self.motion.find_errors(dimension) if self.motion else []
        errors = super().find_errors(dimension) + [
            CrossKeyError(("motion", *c.place), c.value, c.message) for c in moves
        ]
        if self.drag is not None and self.rubs:
            errors.append(CrossKeyError(("drag",), self.drag, "is for liquids; sand uses friction"))
        return errors + (self._body_errors() if self.is_body else self._still_errors())

    def _body_errors(self) -> list[CrossKeyError]:
        """Return errors of a rigid body."""
        key = "mass" if self.mass is not None else "density"
        errors = []
        if self.mass is not None and self.density is not None:
            errors.append(
                CrossKeyError(
                    ("density",), self.density, "cannot be combined with mass: give one of them"
                )
            )
        if self.motion is not None:
            errors.append(
                CrossKeyError(
                    ("motion",),
                    None,
                    f"cannot be combined with {key}: a rigid body is moved by forces",
                )
            )
        if self.invert:
            errors.append(
                CrossKeyError(
                    ("invert",),
                    True,
                    f"cannot be combined with {key}: the outside of a shape has no mass",
                )
            )
        if self.shape == "plane":
            errors.append(
                CrossKeyError(
                    (key,), getattr(self, key), "not for a plane: a half space has no mass"
                )
            )
        return errors

    def _still_errors(self) -> list[CrossKeyError]:
        """Return errors of keys that need a rigid body."""
        body_keys: dict[str, object] = {
            "velocity": self.velocity,
            "angular_velocity": self.angular_velocity,
            "restitution": self.restitution or None,
        }
        message = "needs mass or density, which make the solid a rigid body"
        errors = [
            CrossKeyError((name,), value, message)
            for name, value in body_keys.items()
            if value is not None
        ]
        if self.friction is not None and not self.rubs:
            errors.append(
                CrossKeyError(
                    ("friction",), self.friction, f"{message}: a liquid has no friction with solids"
                )
            )
        return errors


class MaterialProperties(Shape):
    """Properties of a material besides its shape."""

    velocity: Vector | None = Field(default=None, description="initial velocity [m/s]; default: 0")


class LiquidProperties(MaterialProperties):
    """Properties of a liquid besides its shape."""

    noun: ClassVar[str] = "Liquid"
    viscosity: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="viscosity [Pa s]; default: viscosity.value",
    )


class Schedule(Table):
    """Times at which a source or a drain runs."""

    begin: NonNegative = Field(alias="start", default=0.0, description="start time [s]")
    stop: float | None = Field(default=None, description="end time [s]; default: never")

    def schedule_errors(self) -> list[CrossKeyError]:
        """Return errors of the times."""
        if self.stop is not None and self.stop <= self.begin:
            return [
                CrossKeyError(("stop",), self.stop, f"must be later than start = {self.begin:g}")
            ]
        return []


class SourceProperties(Schedule, Shape):
    """Properties of a source besides its shape."""

    noun: ClassVar[str] = "Source"
    velocity: Vector = Field(description="inflow velocity [m/s]")
    viscosity: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="viscosity [Pa s]; default: viscosity.value",
    )

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the source in a scene of 2 or 3 dimensions."""
        errors = super().find_errors(dimension) + self.schedule_errors()
        if not any(self.velocity):
            errors.append(
                CrossKeyError(
                    ("velocity",), self.velocity, "must not be zero: nothing would come out"
                )
            )
        return errors


class DrainProperties(Schedule, Shape):
    """Properties of a drain besides its shape."""

    noun: ClassVar[str] = "Drain"

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the drain in a scene of 2 or 3 dimensions."""
        return super().find_errors(dimension) + self.schedule_errors()


Solid = ShapeUnion[SolidProperties]
Liquid = ShapeUnion[LiquidProperties]
Source = ShapeUnion[SourceProperties]
Drain = ShapeUnion[DrainProperties]
