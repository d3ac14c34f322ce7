"""Mass, center of mass and inertia of shapes of uniform density, 2-D and 3-D."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warp_lcp.grid.signed_distance import Box, Capsule, Geometry, Placement, Sphere, TriangleMesh
from warp_lcp.rigid.outline import mesh_outline

ROUND = 1e-9  # relative asymmetry up to which an inertia counts as symmetric
# Fraction of a mesh's surface inside the mesh itself, above which overlaps would weigh too much.
TWICE = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class MassProperties:
    """Mass, center of mass and inertia of a body.

    Args:
        mass: [kg]; 2-D: [kg/m], per meter of depth.
        center: center of mass [m], shape (3,), z = 0 in 2-D.
        inertia: inertia about the center [kg m^2], shape (3, 3), symmetric positive definite; 2-D:
            [kg m], of which only zz is used.

    Raises:
        ValueError: a value is not finite, the mass is not positive or the inertia is not symmetric
            positive definite.
    """

    mass: float
    center: np.ndarray
    inertia: np.ndarray

    @cached_property
    def inverse_inertia(self) -> np.ndarray:
        """I^-1 [1 / (kg m^2)], shape (3, 3)."""
        return np.linalg.inv(self.inertia)

    def __post_init__(self) -> None:
        """Check the values and store them as float64."""
        center, inertia = (
            np.array(self.center, dtype=np.float64),
            np.array(self.inertia, dtype=np.float64),
        )
        if not (math.isfinite(self.mass) and self.mass > 0.0):
            raise ValueError(f"mass = {self.mass}: must be positive and finite")
        if center.shape != (3,) or not np.isfinite(center).all():
            raise ValueError(f"center must be 3 finite numbers, not {center.tolist()}")
        if inertia.shape != (3, 3) or not np.isfinite(inertia).all():
            raise ValueError("inertia must be a finite 3 x 3 matrix")
        if (
            np.abs(inertia - inertia.T).max() > ROUND * np.abs(inertia).max()
            or np.linalg.eigvalsh(inertia)[0] <= 0.0
        ):
            raise ValueError("inertia must be symmetric positive definite")
        for name, array in (("center", center), ("inertia", inertia)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)


def mass_properties(
    geometry: Geometry, dimension: int, *, mass: float | None = None, density: float | None = None
) -> MassProperties:
    """Return the mass properties of a placed shape of uniform density.

    Boxes, spheres and capsules have closed forms. For meshes the integrals of 1, x and x x' are
    exact sums over the tetrahedra between the origin and their triangles, in 2-D over the triangles
    between the origin and the segments of their cut by z = 0.

    Args:
        geometry: a box, sphere, capsule or mesh, not inverted.
        dimension: 2 or 3.
        mass: [kg]; 2-D: [kg/m].
        density: [kg/m^3]; one of mass and density.

    Raises:
        ValueError: both or none of mass and density, a shape without a volume of its own, or a mesh
            whose parts overlap.
    """
    if (mass is None) == (density is None):
        raise ValueError("give either mass or density")
    if not isinstance(geometry, (Box, Sphere, Capsule, TriangleMesh)) or geometry.invert:
        raise ValueError(f"{type(geometry).__name__.lower()}: an unbounded shape has no mass")
    if isinstance(geometry, TriangleMesh):
        volume, center, inertia = _mesh(geometry, dimension)
    else:
        volume, center, inertia = _placed(
            geometry.placement, dimension, *_closed_form(geometry, dimension)
        )
    if not volume > 0.0:
        raise ValueError(
            "the shape has no volume in the plane z = 0"
            if dimension == 2
            else "the shape has no volume"
        )
    uniform = density if density is not None else (mass or 0.0) / volume
    return MassProperties(mass=uniform * volume, center=center, inertia=uniform * inertia)


def _closed_form(
    shape: Box | Sphere | Capsule, dimension: int
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, center and inertia at density 1 in the shape's own coordinates."""
    if isinstance(shape, Box):
        lower, upper = (np.array([*corner, 0.0][:3]) for corner in (shape.lower, shape.upper))
        sides = (upper - lower)[:dimension]
        volume, squares = float(sides.prod()), np.square(sides) * float(sides.prod()) / 12.0
        inertia = np.eye(3) * squares.sum() if dimension == 2 else np.diag(squares.sum() - squares)
        return volume, 0.5 * (lower + upper), inertia
    if isinstance(shape, Sphere):
        r = shape.radius
        volume = math.pi * r**2 if dimension == 2 else 4.0 / 3.0 * math.pi * r**3
        return (
            volume,
            np.array([*shape.center, 0.0][:3]),
            np.eye(3) * volume * r**2 * (0.5 if dimension == 2 else 0.4),
        )
    start, end = (np.array([*point, 0.0][:3]) for point in (shape.start, shape.end))
    length, r, center = float(np.linalg.norm(end - start)), shape.radius, 0.5 * (start + end)
    h = 0.5 * length
    # A rectangle and two half discs, whose centers of mass are 4 r / (3 pi) from their diameters.
    if dimension == 2:
        middle, caps = 2.0 * r * length, math.pi * r**2
        about = middle * (length**2 + 4.0 * r**2) / 12.0 + caps * (
            0.5 * r**2 + h**2 + 8.0 * h * r / (3.0 * math.pi)
        )
        return middle + caps, center, about * np.eye(3)
    # Half balls: 3 r / 8 from the plane of the cut.
    middle, caps = math.pi * r**2 * length, 4.0 / 3.0 * math.pi * r**3
    along = 0.5 * middle * r**2 + 0.4 * caps * r**2
    across = middle * (length**2 / 12.0 + 0.25 * r**2) + caps * (0.4 * r**2 + h**2 + 0.75 * h * r)
    axis = (end - start) / length
    return middle + caps, center, across * np.eye(3) + (along - across) * np.outer(axis, axis)


def _placed(
    placement: Placement, dimension: int, volume: float, center: np.ndarray, inertia: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, center and inertia at density 1 after a placement."""
    scale, R = placement.scale, placement.rotation
    return (
        volume * scale**dimension,
        placement.apply(center[None])[0],
        scale ** (dimension + 2) * R @ inertia @ R.T,
    )


def _mesh(mesh: TriangleMesh, dimension: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, center and inertia at density 1 of a placed mesh.

    In 2-D, of its cut by z = 0.
    """
    if mesh.surface.crossings.doubled > TWICE:
        raise ValueError(
            f"{mesh.surface.name}: about {mesh.surface.crossings.doubled:.0%} of its surface lies "
            "inside itself and would count twice; "
            "unite its parts (in Blender: Boolean, Union)"
        )
    vertices = mesh.placement.apply(mesh.surface.vertices)
    if dimension == 2:
        segments = mesh_outline(mesh)
        if not len(segments):
            return 0.0, np.zeros(3), np.eye(3)
        corners = segments
    else:
        corners = vertices[mesh.surface.triangles]
    # Near the shape: terms would cancel for a distant origin.
    origin = corners.reshape(-1, 3).mean(axis=0)
    corners = corners - origin
    total = corners.sum(axis=1)
    if dimension == 2:
        p, q = corners[:, 0], corners[:, 1]
        parts = 0.5 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    else:
        parts = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    volume = float(parts.sum())
    if not volume > 0.0:
        return 0.0, origin, np.eye(3)
    center = parts @ total / ((dimension + 1) * volume)
    # For a simplex with a corner at the origin: its volume times (sum of v v' + (sum of v)(sum of
    # v)') over (d + 1)(d + 2).
    squares = np.einsum("i,ikj,ikl->jl", parts, corners, corners) + np.einsum(
        "i,ij,il->jl", parts, total, total
    )
    second = squares / ((dimension + 1) * (dimension + 2)) - volume * np.outer(center, center)
    inertia = np.trace(second) * np.eye(3) - (second if dimension == 3 else 0.0)
    return volume, origin + center, 0.5 * (inertia + inertia.T)
