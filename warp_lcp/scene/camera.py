"""Table [camera] of a scene, and the pinhole camera of images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from warp_lcp.scene.table import CrossKeyError, Table, Vector

if TYPE_CHECKING:
    from warp_lcp.scene.scene import Scene

VIEW_ANGLE = 25.0  # degrees, over the height of an image
MARGIN = 1.08  # size of the image relative to its content
# Direction from the domain to the camera.
THREE_QUARTERS = np.array([0.55, 0.5, 1.0]) / np.linalg.norm([0.55, 0.5, 1.0])
Y_AXIS, Z_AXIS = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
ROOM_KEYS, WINDOW_KEYS = ("position", "look_at", "up", "field_of_view"), ("low", "high")


class Camera(Table):
    """[camera]: view of images; default: the whole domain."""

    position: Vector | None = Field(
        default=None, description="position [m], 3-D; default: a view of the whole domain"
    )
    look_at: Vector | None = Field(
        default=None, description="center of the image [m], 3-D; default: the domain's center"
    )
    up: Vector | None = Field(
        default=None, description="up direction of the image, 3-D; default: y"
    )
    field_of_view: float | None = Field(
        default=None,
        ge=1,
        le=120,
        description=f"vertical field of view [degrees], 3-D; default: {VIEW_ANGLE:g}",
    )
    low: Vector | None = Field(
        default=None,
        alias="min",
        description="lower corner of the image [m], 2-D; default: the domain's",
    )
    high: Vector | None = Field(
        default=None,
        alias="max",
        description="upper corner of the image [m], 2-D; default: the domain's",
    )

    def find_errors(self, dimension: int, size: list[float]) -> list[CrossKeyError]:
        """Return errors of the camera in a domain of two or three sides [m]."""
        wrong, right = (ROOM_KEYS, WINDOW_KEYS) if dimension == 2 else (WINDOW_KEYS, ROOM_KEYS)
        errors = []
        for key in wrong:
            if getattr(self, key) is not None:
                allowed = ", ".join(type(self).model_fields[name].alias or name for name in right)
                message = f"cannot be used in {dimension}-D; allowed are {allowed}"
                errors.append(
                    CrossKeyError(
                        (type(self).model_fields[key].alias or key,), getattr(self, key), message
                    )
                )
        for key in right:
            value = getattr(self, key)
            if isinstance(value, list) and len(value) != dimension:
                errors.append(
                    CrossKeyError(
                        (type(self).model_fields[key].alias or key,),
                        value,
                        f"must have {dimension} entries",
                    )
                )
        if errors:
            return errors
        return self._window_errors(size) if dimension == 2 else self._room_errors(size)

    def _window_errors(self, size: list[float]) -> list[CrossKeyError]:
        """Return errors of the window of a 2-D domain."""
        low, high = self.low or [0.0, 0.0], self.high or size
        if all(a < b for a, b in zip(low, high, strict=True)):
            return []
        return [
            CrossKeyError(
                ("max",) if self.high else ("min",),
                self.high or self.low,
                f"min = {low} must be less than max = {high} along both axes",
            )
        ]

    def _room_errors(self, size: list[float]) -> list[CrossKeyError]:
        """Return errors of the view of a 3-D domain."""
        if self.position is None:
            given = [key for key in ("look_at", "up") if getattr(self, key) is not None]
            return [
                CrossKeyError((key,), getattr(self, key), "needs camera.position") for key in given
            ]
        toward = np.subtract(self.position, self.look_at or np.multiply(size, 0.5))
        far = np.linalg.norm(toward)
        if far < 1e-6 * max(size):
            return [
                CrossKeyError(
                    ("position",), self.position, "must not be the point that the camera looks at"
                )
            ]
        up = np.array(self.up or Y_AXIS)
        if np.linalg.norm(np.cross(up, toward)) <= 1e-3 * np.linalg.norm(up) * far:
            return [
                CrossKeyError(
                    ("up",),
                    self.up,
                    "must be given, and not be the direction that the camera looks in"
                    if self.up is None
                    else "must not be zero or the direction that the camera looks in",
                )
            ]
        return []


@dataclass(frozen=True)
class Viewpoint:
    """Pinhole camera.

    Args:
        position: [m], shape (3,).
        focus: point at the center of the image [m], shape (3,).
        up: upward direction of the image, a unit vector, shape (3,).
        angle: view angle over the height of the image [degrees].
        aspect: width of the image over its height.
    """

    position: np.ndarray
    focus: np.ndarray
    up: np.ndarray
    angle: float
    aspect: float

    @property
    def axes(self) -> np.ndarray:
        """Return the image's unit vectors (right, up, forward) as rows, shape (3, 3)."""
        forward = (self.focus - self.position) / np.linalg.norm(self.focus - self.position)
        right = np.cross(forward, self.up)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])


def viewpoint(scene: Scene, aspect: float) -> Viewpoint:
    """Return the viewpoint of images with a given aspect.

    It is that of the scene's [camera], else the nearest one that shows the whole domain.
    """
    camera = scene.camera
    low, high = scene.seen
    if scene.dimension == 2:
        corners = [np.append(camera.low or low[:2], 0.0), np.append(camera.high or high[:2], 0.0)]
        return view_around(corners[0], corners[1], Z_AXIS, VIEW_ANGLE, aspect)
    angle = camera.field_of_view or VIEW_ANGLE
    if camera.position is None:
        return view_around(low, high, THREE_QUARTERS, angle, aspect)
    position, focus = (
        np.array(camera.position),
        np.array(camera.look_at) if camera.look_at else 0.5 * (low + high),
    )
    plain = Viewpoint(position, focus, np.array(camera.up or Y_AXIS), angle, aspect)
    return Viewpoint(position, focus, plain.axes[1], angle, aspect)


def view_around(
    low: np.ndarray, high: np.ndarray, toward: np.ndarray, angle: float, aspect: float
) -> Viewpoint:
    """Return the nearest viewpoint in a direction that shows all of a box [m]."""
    return view_of_points(
        np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3),
        toward,
        angle,
        aspect,
    )


def view_of_points(
    points: np.ndarray, toward: np.ndarray, angle: float, aspect: float
) -> Viewpoint:
    """Return the nearest viewpoint in a direction that shows all points.

    Args:
        points: points that must be visible [m], shape (n, 3).
        toward: unit vector from the points to the camera.
        angle: view angle over the height of the image [degrees].
        aspect: width of the image over its height.
    """
    right = np.cross(Y_AXIS, toward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(toward, right), toward])
    corners = points @ axes.T
    focus = corners.mean(axis=0)
    slope = math.tan(math.radians(angle / 2)) / MARGIN
    # Near points look larger, so the center of the image is not that of the points.
    for _ in range(5):
        x, y, z = (corners - focus).T
        distance = max((z + np.abs(x) / (slope * aspect)).max(), (z + np.abs(y) / slope).max())
        seen = np.stack([x, y]) / (distance - z)
        focus[:2] += 0.5 * (seen.min(axis=1) + seen.max(axis=1)) * distance
    return Viewpoint(focus @ axes + distance * toward, focus @ axes, axes[1], angle, aspect)
