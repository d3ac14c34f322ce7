"""Shapes as signed distances on the device.

Box, sphere, capsule, plane, triangle mesh and unions, for solids and regions of material.

A 2-D scene is the plane z = 0 of these shapes: its callers pass points with z = 0. Boxes given with
two coordinates are infinite in z, spheres and capsules lie at z = 0 (discs and stadiums there), and
a mesh is cut by the plane z = 0. For a mesh the sign is that of the cut, and the distance is that
to the surface in space, never more than that to the cut.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Protocol, Self, runtime_checkable

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.motion import Pose, Vector, checked_vector, in_space, keep_checked, unit
from warp_lcp.grid.signed_distance_kernels import (
    ShapeFrame,
    box_distance,
    capsule_distance,
    least_distance,
    mesh_distance,
    mesh_surface_distance,
    plane_distance,
    sphere_distance,
)
from warp_lcp.grid.triangle_mesh import ClosedSurface, load_surface
from warp_lcp.settings import Positive, checked


@runtime_checkable
class Geometry(Protocol):
    """Region of space with a signed distance, negative inside."""

    def signed_distance(
        self, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)
    ) -> None:
        """Write the signed distance [m] of points [m], shape (m,), into `out`.

        2-D callers pass z = 0.
        """

    def bounds(self) -> np.ndarray | None:
        """Return the bounding box [m], shape (2, 3); None if the region is unbounded."""

    def moved(self, pose: Pose) -> Geometry:
        """Return the region moved by a pose; surface data is shared."""


def _rotation_about(axis: int, degrees: float) -> np.ndarray:
    """Return the matrix that turns counterclockwise about a coordinate axis."""
    angle = np.deg2rad(degrees)
    # Whole quarter turns stay exact, so that the faces of a turned box stay on the grid's faces.
    quarters = degrees / 90.0
    cosine, sine = np.cos(angle), np.sin(angle)
    if quarters == int(quarters):
        cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    i, j = ((1, 2), (2, 0), (0, 1))[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cosine
    matrix[j, i], matrix[i, j] = sine, -sine
    return matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class Placement:
    """Placement of a shape: p = scale * rotation @ q + translation.

    q are the shape's own coordinates, p those of the domain.

    Args:
        scale: uniform factor, > 0.
        rotation: proper rotation matrix, shape (3, 3).
        translation: [m], shape (3,).

    Raises:
        ValueError: a value is not finite, the scale is not positive, or the matrix is not a
            rotation.
    """

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Check the values and store them as float64."""
        object.__setattr__(self, "scale", checked("scale", self.scale, Positive))
        keep_checked(self, 1e-5)

    @classmethod
    def from_degrees(
        cls, scale: float, rotate: float | Vector, translate: Vector, dimension: int
    ) -> Placement:
        """Return the placement described by a scene.

        Args:
            scale: uniform factor, > 0.
            rotate: angles [degrees] about x, then y, then z in 3-D; one angle (or a sequence of
                one), about z, in 2-D.
            translate: [m], `dimension` numbers.
            dimension: 2 or 3.

        Raises:
            ValueError: a value is not finite, or there are too few or too many.
        """
        angles = [float(angle) for angle in np.atleast_1d(np.asarray(rotate, dtype=np.float64))]
        wanted = {2: 1, 3: 3}.get(dimension)
        if wanted is None:
            raise ValueError(f"dimension must be 2 or 3, not {dimension}")
        if len(angles) != wanted or not np.isfinite(angles).all():
            meaning = (
                "one finite angle in degrees, about z"
                if dimension == 2
                else "three finite angles in degrees, about x, y and z"
            )
            raise ValueError(f"rotate needs {meaning}, not {rotate}")
        if len(translate) != dimension:
            raise ValueError(f"translate needs {dimension} numbers, not {len(translate)}")
        if dimension == 2:
            angles = [0.0, 0.0, *angles]
        x, y, z = (_rotation_about(axis, angle) for axis, angle in enumerate(angles))
        return cls(
            scale=scale,
            rotation=z @ y @ x,
            translation=in_space(checked_vector("translate", translate)),
        )

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return points, shape (m, 3), transformed from the shape to the domain [m]."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.translation

    def about(self, point: Vector) -> Placement:
        """Return this placement with scale and rotation about a point [m].

        Instead of the origin; two or three coordinates.
        """
        center = in_space(checked_vector("about", point))
        return replace(
            self, translation=self.translation + center - self.scale * self.rotation @ center
        )

    def moved(self, pose: Pose) -> Placement:
        """Return this placement followed by a pose."""
        rotation, translation = pose.rotation @ self.rotation, pose.apply(self.translation)
        return Placement(scale=self.scale, rotation=rotation, translation=translation)


@dataclass(frozen=True, kw_only=True)
class _Shape(ABC):
    """Common parts of shapes: placement, inversion and the launch of the kernel."""

    placement: Placement = field(default_factory=Placement)
    invert: bool = False

    kernel: ClassVar[wp.Kernel]
    cost: ClassVar[int] = 8  # work of a point, in cells of a usual pass

    def signed_distance(
        self, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)
    ) -> None:
        """Write the distance to the surface, negative inside (outside if inverted).

        Args:
            points: [m], shape (m,), on any device; a 2-D caller passes z = 0.
            out: [m], shape (m,), on the same device.

        Raises:
            ValueError: the arrays differ in length.
        """
        if points.shape != out.shape:
            raise ValueError(f"out has shape {out.shape}, points have {points.shape}")
        self._measure(self.kernel, points, out)

    def _measure(self, kernel: wp.Kernel, points: wp.array, out: wp.array) -> None:
        inputs = [points, self.frame(), *self.parameters(points.device), out]
        launch_list(kernel, points.shape[0], inputs, device=points.device, cost=self.cost)

    def frame(self) -> ShapeFrame:
        """Return the placement of the shape, as kernels take it."""
        placement, frame = self.placement, ShapeFrame()
        translation = placement.translation + placement.scale * placement.rotation @ self.origin()
        frame.inverse_rotation, frame.translation = (
            wp.mat33(placement.rotation.T),
            wp.vec3(*translation),
        )
        frame.scale, frame.sign = placement.scale * self.unit_length(), -1.0 if self.invert else 1.0
        return frame

    def bounds(self) -> np.ndarray | None:
        """Return the corners [m] of a box around the region, shape (2, 3).

        Returns None if the region is unlimited or inverted.
        """
        return None if self._bounds is None else self._bounds.copy()

    @cached_property
    def _bounds(self) -> np.ndarray | None:
        if self.invert:
            return None
        corners, margin = self.hull()
        if not len(corners):
            return None
        placed = self.placement.apply(corners)
        margin *= self.placement.scale
        return np.stack([placed.min(axis=0) - margin, placed.max(axis=0) + margin])

    def moved(self, pose: Pose) -> Self:
        """Return the shape moved by a pose [m].

        The surface of a mesh and its device data are shared.
        """
        return replace(self, placement=self.placement.moved(pose))

    def origin(self) -> np.ndarray:
        """Return the origin of the kernel's coordinates, in the shape's coordinates."""
        return np.zeros(3)

    def unit_length(self) -> float:
        """Return the unit length of the kernel, in the shape's coordinates."""
        return 1.0

    @abstractmethod
    def parameters(self, device: wp.Device) -> list[object]:
        """Return the kernel's arguments after the placement."""

    @abstractmethod
    def hull(self) -> tuple[np.ndarray, float]:
        """Return points, shape (m, 3), and a margin around them that cover the shape.

        There are no points if nothing covers it.
        """


@dataclass(frozen=True, kw_only=True)
class Box(_Shape):
    """Box between two corners; infinite in z if they have two coordinates.

    Args:
        lower: low corner [m], 2 or 3 numbers.
        upper: high corner [m], as many.
        placement: placement of the shape.
        invert: make it everything but the box.

    Raises:
        ValueError: a corner is not finite, or lower < upper does not hold everywhere.
    """

    lower: Vector
    upper: Vector

    kernel: ClassVar[wp.Kernel] = box_distance

    def __post_init__(self) -> None:
        """Check that low is below high."""
        lower, upper = checked_vector("min", self.lower), checked_vector("max", self.upper)
        if len(lower) != len(upper):
            raise ValueError(f"a box's min has {len(lower)} numbers and its max {len(upper)}")
        if not all(a < b for a, b in zip(lower, upper, strict=True)):
            raise ValueError(
                f"a box's min must be less than its max in every direction, not {list(lower)} and "
                f"{list(upper)}"
            )
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    def origin(self) -> np.ndarray:
        """Return the origin of the kernel's coordinates, in the shape's coordinates."""
        return 0.5 * (in_space(self.lower) + in_space(self.upper))

    def half_extents(self) -> np.ndarray:
        """Return half the sides, shape (3,).

        In the shape's coordinates; infinite along z if the corners have two.
        """
        half = 0.5 * (np.asarray(self.upper) - np.asarray(self.lower))
        return np.array([*half, np.inf][:3])

    def parameters(self, device: wp.Device) -> list[object]:
        """Return the kernel's arguments after the placement."""
        return [wp.vec3(*self.half_extents())]

    def bounds(self) -> np.ndarray | None:
        """Return the bounding box [m], shape (2, 3); None if inverted.

        Infinite in z in 2-D.
        """
        result = super().bounds()
        if result is not None and len(self.lower) == 2:
            result[:, 2] = -np.inf, np.inf
        return result

    def hull(self) -> tuple[np.ndarray, float]:
        """Return points, shape (m, 3), and a margin around them that cover the shape."""
        half = np.where(np.isfinite(self.half_extents()), self.half_extents(), 0.0)
        signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
        return self.origin() + signs * half, 0.0


@dataclass(frozen=True, kw_only=True)
class Sphere(_Shape):
    """Sphere; in 2-D a disc.

    Args:
        center: [m], 2 or 3 numbers.
        radius: [m], > 0.
        placement: placement of the shape.
        invert: make it everything but the sphere.

    Raises:
        ValueError: a value is not finite or the radius is not positive.
    """

    center: Vector
    radius: float

    kernel: ClassVar[wp.Kernel] = sphere_distance

    def __post_init__(self) -> None:
        """Check that center and radius are finite."""
        object.__setattr__(self, "center", checked_vector("center", self.center))
        object.__setattr__(self, "radius", checked("radius", self.radius, Positive))

    def origin(self) -> np.ndarray:
        """Return the origin of the kernel's coordinates, in the shape's coordinates."""
        return in_space(self.center)

    def parameters(self, device: wp.Device) -> list[object]:
        """Return the kernel's arguments after the placement."""
        return [self.radius]

    def hull(self) -> tuple[np.ndarray, float]:
        """Return points, shape (m, 3), and a margin around them that cover the shape."""
        return self.origin()[None], self.radius


@dataclass(frozen=True, kw_only=True)
class Capsule(_Shape):
    """Capsule: all points within a radius of a segment.

    Args:
        start: one end of the segment [m], 2 or 3 numbers.
        end: the other end [m], as many.
        radius: [m], > 0.
        placement: placement of the shape.
        invert: make it everything but the capsule.

    Raises:
        ValueError: a value is not finite, the radius is not positive, or the ends coincide.
    """

    start: Vector
    end: Vector
    radius: float

    kernel: ClassVar[wp.Kernel] = capsule_distance

    def __post_init__(self) -> None:
        """Check that the ends are two points."""
        start, end = checked_vector("from", self.start), checked_vector("to", self.end)
        if len(start) != len(end):
            raise ValueError(f"a capsule's from has {len(start)} numbers and its to {len(end)}")
        if start == end:
            raise ValueError(f"a capsule's ends coincide at {list(start)}: use a sphere")
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "end", end)
        object.__setattr__(self, "radius", checked("radius", self.radius, Positive))

    def origin(self) -> np.ndarray:
        """Return the origin of the kernel's coordinates, in the shape's coordinates."""
        return in_space(self.start)

    def axis(self) -> np.ndarray:
        """Return the vector from one end of the segment to the other, shape (3,).

        In the shape's coordinates.
        """
        return np.asarray(in_space(self.end) - in_space(self.start))

    def parameters(self, device: wp.Device) -> list[object]:
        """Return the kernel's arguments after the placement."""
        return [wp.vec3(*self.axis()), self.radius]

    def hull(self) -> tuple[np.ndarray, float]:
        """Return points, shape (m, 3), and a margin around them that cover the shape."""
        return np.stack([in_space(self.start), in_space(self.end)]), self.radius


@dataclass(frozen=True, kw_only=True)
class Plane(_Shape):
    """Half space on the side of a plane opposite its normal.

    Args:
        point: a point of the plane [m], 2 or 3 numbers.
        normal: direction out of the material, as many numbers, of any length but 0.
        placement: placement of the shape.
        invert: put the material on the normal's side.

    Raises:
        ValueError: a value is not finite or the normal is zero.
    """

    point: Vector
    normal: Vector

    kernel: ClassVar[wp.Kernel] = plane_distance

    def __post_init__(self) -> None:
        """Check the point, and give the normal unit length."""
        point, normal = checked_vector("point", self.point), checked_vector("normal", self.normal)
        if len(point) != len(normal):
            raise ValueError(
                f"a plane's point has {len(point)} numbers and its normal {len(normal)}"
            )
        object.__setattr__(self, "point", point)
        object.__setattr__(self, "normal", unit("a plane's normal", normal))

    def origin(self) -> np.ndarray:
        """Return the origin of the kernel's coordinates, in the shape's coordinates."""
        return in_space(self.point)

    def parameters(self, device: wp.Device) -> list[object]:
        """Return the kernel's arguments after the placement."""
        return [wp.vec3(*in_space(self.normal))]

    def hull(self) -> tuple[np.ndarray, float]:
        """Return points, shape (m, 3), and a margin around them that cover the shape."""
        return np.empty((0, 3)), 0.0


@dataclass(frozen=True, kw_only=True)
class TriangleMesh(_Shape):
    """Interior of a closed triangle surface.

    The distance is the one to the closest triangle; the sign comes from the winding number, summed
    over the triangles.

    Args:
        surface: the checked surface, in the mesh's own coordinates.
        placement: placement of the shape.
        invert: make it everything but the inside.
    """

    surface: ClosedSurface

    kernel: ClassVar[wp.Kernel] = mesh_distance
    cost: ClassVar[int] = 500

    @classmethod
    def from_file(
        cls,
        file: str,
        *,
        folder: Path | None = None,
        placement: Placement | None = None,
        invert: bool = False,
        thickness: float | None = None,
    ) -> TriangleMesh:
        """Read an OBJ, STL or PLY file, or a built-in mesh.

        Built-in: `builtin:torus`, `builtin:knot`.

        Args:
            file: path, relative to `folder`, or `builtin:` and a name.
            folder: where relative paths start; the working directory without it.
            placement: placement of the shape.
            invert: make it everything but the inside.
            thickness: the file is an open mesh, the middle of a wall of this thickness [m] as
                placed.

        Raises:
            ValueError: the file is missing or not a closed surface; the message names the file and
                what to do. With `thickness`, it is a closed surface.
        """
        place = placement or Placement()
        wall = None if thickness is None else thickness / place.scale
        return cls(surface=load_surface(file, folder, wall), placement=place, invert=invert)

    @property
    def volume(self) -> float:
        """Volume inside the surface as placed [m^3]."""
        return self.surface.volume * self.placement.scale**3

    def distance_to_surface(
        self, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)
    ) -> None:
        """Write the unsigned distance to the closest triangle.

        For points whose sign is known: a fifth of the work of `signed_distance`.

        Args:
            points: [m], shape (m,), on any device.
            out: [m], shape (m,), on the same device.
        """
        self._measure(mesh_surface_distance, points, out)

    def thin_fraction(self, thickness: float, device: wp.Device) -> float:
        """Return the fraction of the surface where the solid is thin.

        Thinner than `thickness` [m], by area.
        """
        return self.surface.thin_fraction(thickness / self.placement.scale, device)

    def thin_part(self, thickness: float, device: wp.Device) -> wp.Mesh:
        """Return the part of the surface where the solid is thinner than `thickness` [m]."""
        return self.surface.thin_part(thickness / self.placement.scale, device)

    def origin(self) -> np.ndarray:
        """Return the origin of the kernel's coordinates, in the shape's coordinates."""
        return self.surface.center

    def unit_length(self) -> float:
        """Return the unit length of the kernel, in the shape's coordinates."""
        return self.surface.size

    def parameters(self, device: wp.Device) -> list[object]:
        """Return the kernel's arguments after the placement."""
        return [self.surface.on_device(device).id]

    def hull(self) -> tuple[np.ndarray, float]:
        """Return points, shape (m, 3), and a margin around them that cover the shape."""
        return self.surface.vertices, 0.0


@dataclass(frozen=True, kw_only=True)
class Union:
    """Union of regions.

    The distance is exact outside, and inside a lower bound where regions overlap.

    Args:
        parts: the regions, at least one.
    """

    parts: tuple[Geometry, ...]

    def signed_distance(
        self, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)
    ) -> None:
        """Write the smallest signed distance [m] to the parts, as for `Geometry`."""
        self.parts[0].signed_distance(points, out)
        other = wp.empty_like(out) if len(self.parts) > 1 else out
        for part in self.parts[1:]:
            part.signed_distance(points, other)
            launch_list(least_distance, points.shape[0], [other, out], device=points.device)

    def bounds(self) -> np.ndarray | None:
        """Return the bounding box [m], shape (2, 3); None if a part is unbounded."""
        boxes = [box for part in self.parts if (box := part.bounds()) is not None]
        return (
            np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])
            if len(boxes) == len(self.parts)
            else None
        )

    def moved(self, pose: Pose) -> Union:
        """Return the union moved by a pose."""
        return Union(parts=tuple(part.moved(pose) for part in self.parts))
