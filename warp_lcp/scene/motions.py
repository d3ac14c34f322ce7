"""Motions of a scene file: movement of a solid relative to its placement."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from warp_lcp.scene.table import Angles, CrossKeyError, Table, Vector, counted
from warp_lcp.settings import Positive

if TYPE_CHECKING:
    from warp_lcp.grid import motion

Axis = Annotated[list[float], Field(min_length=3, max_length=3)]
CENTER = "point of the axis [m]"
AXIS = "direction of the axis, 3-D only"


class PrescribedMotion(Table):
    """Motion given as a function of time, relative to the placed shape.

    In the domain's coordinates.
    """

    @abstractmethod
    def to_motion(self, dimension: int) -> motion.Motion:
        """Return the motion as poses over time.

        Args:
            dimension: 2 or 3.

        Raises:
            ValueError: a value is not allowed.
        """

    def find_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the motion in a scene of 2 or 3 dimensions."""
        errors = self._size_errors(dimension)
        if errors:
            return errors
        try:
            self.to_motion(dimension)
        except ValueError as error:
            errors.append(CrossKeyError((), None, str(error)))
        return errors

    def _size_errors(self, dimension: int) -> list[CrossKeyError]:
        """Return errors of the number of entries, and missing or superfluous keys."""
        return [
            CrossKeyError((name,), value, f"must have {dimension} entries in {dimension}-D")
            for name, value in self
            if name in ("velocity", "center", "amplitude")
            and value is not None
            and len(value) != dimension
        ]


class TranslationMotion(PrescribedMotion):
    """Constant velocity between two times."""

    kind: Literal["translation"] = "translation"
    velocity: Vector = Field(description="velocity [m/s]")
    start: float = Field(default=0.0, description="start time [s]")
    stop: float | None = Field(default=None, description="end time [s]; default: never")

    def to_motion(self, dimension: int) -> motion.Motion:
        """Return the translation over time."""
        from warp_lcp.grid import motion

        return motion.Translation(
            velocity=self.velocity, start=self.start, stop=_or_never(self.stop)
        )


class RotationMotion(PrescribedMotion):
    """Constant angular velocity about a fixed axis between two times."""

    kind: Literal["rotation"] = "rotation"
    rate: float = Field(description="angular velocity [degrees/s], counterclockwise about the axis")
    center: Vector = Field(description=CENTER)
    axis: Axis | None = Field(default=None, description=AXIS)
    start: float = Field(default=0.0, description="start time [s]")
    stop: float | None = Field(default=None, description="end time [s]; default: never")

    def to_motion(self, dimension: int) -> motion.Motion:
        """Return the rotation over time."""
        from warp_lcp.grid import motion

        return motion.Rotation(
            rate=self.rate,
            center=self.center,
            axis=_or_z(self.axis),
            start=self.start,
            stop=_or_never(self.stop),
        )

    def _size_errors(self, dimension: int) -> list[CrossKeyError]:
        return super()._size_errors(dimension) + _axis_errors(self.axis, dimension)


class SinusoidMotion(PrescribedMotion):
    """Translation, rotation or both, times sin(360 degrees time / period + phase)."""

    kind: Literal["sinusoid"] = "sinusoid"
    period: Positive = Field(description="period [s]")
    amplitude: Vector | None = Field(
        default=None, description="amplitude of the translation along each axis [m]"
    )
    phase: float = Field(
        default=0.0, description="[degrees]; at time 0, 0 is the middle, -90 an end"
    )
    angle: float | None = Field(default=None, description="amplitude of the rotation [degrees]")
    center: Vector | None = Field(default=None, description=CENTER)
    axis: Axis | None = Field(default=None, description=AXIS)

    def to_motion(self, dimension: int) -> motion.Motion:
        """Return translation and rotation over time."""
        from warp_lcp.grid import motion

        zeros = [0.0] * dimension
        return motion.Sinusoid(
            period=self.period,
            amplitude=self.amplitude or zeros,
            phase=self.phase,
            angle=self.angle or 0.0,
            center=self.center or zeros,
            axis=_or_z(self.axis),
        )

    def _size_errors(self, dimension: int) -> list[CrossKeyError]:
        errors = super()._size_errors(dimension)
        if self.angle is not None:
            errors += _center_errors(self.center, "angle") + _axis_errors(self.axis, dimension)
        elif self.amplitude is None:
            errors.append(CrossKeyError((), None, "a sinusoid needs amplitude, angle or both"))
        else:
            errors += [
                CrossKeyError((name,), value, "has no effect without angle")
                for name, value in (("center", self.center), ("axis", self.axis))
                if value is not None
            ]
        return errors


class KeyframesMotion(PrescribedMotion):
    """Poses at given times; at rest before the first and after the last."""

    kind: Literal["keyframes"] = "keyframes"
    times: list[float] = Field(min_length=2, description="increasing times [s]")
    translate: list[Vector] | None = Field(default=None, description="translation at each time [m]")
    rotate: list[Angles] | None = Field(
        default=None,
        description="rotation at each time [degrees]: a number in 2-D, [x, y, z] in 3-D",
    )
    center: Vector | None = Field(default=None, description="fixed point of the rotation [m]")
    interpolation: Literal["linear", "smooth"] = Field(
        default="linear", description="linear, or smooth: no jumps of velocity"
    )

    def to_motion(self, dimension: int) -> motion.Motion:
        """Return translation and rotation over time."""
        from warp_lcp.grid import motion

        rotate = (
            None
            if self.rotate is None
            else [angles[0] for angles in self.rotate]
            if dimension == 2
            else self.rotate
        )
        return motion.Keyframes(
            times=self.times,
            translate=self.translate,
            rotate=rotate,
            center=self.center or [0.0] * dimension,
            smooth=self.interpolation == "smooth",
        )

    def _size_errors(self, dimension: int) -> list[CrossKeyError]:
        errors = super()._size_errors(dimension)
        if not (np.diff(self.times) > 0.0).all():
            errors.append(CrossKeyError(("times",), self.times, "must increase"))
        if self.translate is None and self.rotate is None:
            errors.append(CrossKeyError((), None, "keyframes need translate, rotate or both"))
        if self.rotate is not None:
            errors += _center_errors(self.center, "rotate")
        elif self.center is not None:
            errors.append(CrossKeyError(("center",), self.center, "has no effect without rotate"))
        for name, rows, width in (
            ("translate", self.translate, dimension),
            ("rotate", self.rotate, 1 if dimension == 2 else 3),
        ):
            if rows is not None and len(rows) != len(self.times):
                errors.append(
                    CrossKeyError(
                        (name,), rows, f"must have {len(self.times)} entries, one for each time"
                    )
                )
            errors += [
                CrossKeyError((name, index), row, f"must {counted(width)} in {dimension}-D")
                for index, row in enumerate(rows or ())
                if len(row) != width
            ]
        return errors


Motion = Annotated[
    TranslationMotion | RotationMotion | SinusoidMotion | KeyframesMotion,
    Field(discriminator="kind"),
]


def _or_never(stop: float | None) -> float:
    return np.inf if stop is None else stop


def _or_z(axis: list[float] | None) -> list[float]:
    return axis or [0.0, 0.0, 1.0]


def _axis_errors(axis: list[float] | None, dimension: int) -> list[CrossKeyError]:
    if dimension == 2:
        return (
            []
            if axis is None
            else [
                CrossKeyError(("axis",), axis, "must be left out in 2-D, where solids turn about z")
            ]
        )
    return (
        [
            CrossKeyError(
                ("axis",), None, "is missing: the direction to turn about, such as [0.0, 1.0, 0.0]"
            )
        ]
        if axis is None
        else []
    )


def _center_errors(center: list[float] | None, key: str) -> list[CrossKeyError]:
    return (
        [
            CrossKeyError(
                ("center",), None, f"is missing: the point [m] to turn about, since there is {key}"
            )
        ]
        if center is None
        else []
    )
