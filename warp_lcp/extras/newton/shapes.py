"""Shapes of a newton model as solids of a liquid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import newton
import numpy as np
from scipy.spatial import ConvexHull

from warp_lcp.grid.motion import Pose
from warp_lcp.grid.signed_distance import (
    Box,
    Capsule,
    Geometry,
    Placement,
    Plane,
    Sphere,
    TriangleMesh,
    Union,
)
from warp_lcp.grid.triangle_mesh import close_surface

SEGMENTS = 64  # segments of round shapes made of triangles: the volume is 0.2 % too small


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the matrix of a quaternion (x, y, z, w), shape (3, 3)."""
    q = np.asarray(quaternion, dtype=np.float64)
    x, y, z, w = q / np.linalg.norm(q)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * (w * K + K @ K)


def pose_of(transform: np.ndarray) -> Pose:
    """Return the pose of a transform: position [m] and quaternion, shape (7,)."""
    return Pose(rotation_of(transform[3:]), np.asarray(transform[:3], dtype=np.float64))


def geometries(model: newton.Model, origin: np.ndarray) -> dict[int, list[Geometry]]:
    """Return the colliding shapes of each body as placed in the model; -1: the world.

    Args:
        model: the newton model.
        origin: origin of the liquid's coordinates in the world [m], shape (3,).

    Raises:
        ValueError: a shape has no inside, or none that a liquid can use.
    """
    arrays = {
        name: getattr(model, f"shape_{name}").numpy()
        for name in ("body", "flags", "type", "scale", "transform")
    }
    transforms = model.body_q.numpy() if model.body_count else np.zeros((0, 7))
    geometries_of: dict[int, list[Geometry]] = {}
    for shape in range(model.shape_count):
        row = {name: array[shape] for name, array in arrays.items()}
        if not row["flags"] & newton.ShapeFlags.COLLIDE_SHAPES:
            continue
        body = int(row["body"])
        pose = pose_of(row["transform"])
        if body >= 0:
            pose = pose_of(transforms[body]).after(pose)
        geometry = _geometry(row, model.shape_source[shape], model.shape_label[shape])
        geometries_of.setdefault(body, []).append(
            geometry.moved(Pose(pose.rotation, pose.translation - origin))
        )
    return geometries_of


def union_of(shapes: list[Geometry]) -> Geometry:
    """Return all shapes of a body as one shape."""
    return shapes[0] if len(shapes) == 1 else Union(parts=tuple(shapes))


def reaches_into(geometry: Geometry, size: np.ndarray) -> bool:
    """Return whether a shape at rest reaches, or may reach, into the domain.

    The domain is a box from the origin to `size` [m]. A floor below the domain does not count.
    """
    slack = 1e-6 * float(size.max())
    bounds = geometry.bounds()
    if bounds is not None:
        return bool((bounds[0] < size - slack).all() and (bounds[1] > slack).all())
    if not isinstance(geometry, Plane):
        return True
    corners = np.stack(np.meshgrid(*([0.0, side] for side in size)), axis=-1).reshape(-1, 3)
    above = (corners - geometry.placement.apply(np.array([geometry.point]))[0]) @ (
        geometry.placement.rotation @ geometry.normal
    )
    return bool(above.min() < -slack)


def _geometry(row: Mapping[str, Any], source: Any, name: str) -> Geometry:
    """Return a shape in its own coordinates."""
    kinds, kind = newton.GeoType, int(row["type"])
    x, y, z = (float(value) for value in row["scale"])
    if kind == kinds.BOX:
        return Box(lower=[-x, -y, -z], upper=[x, y, z])
    if kind == kinds.SPHERE:
        return Sphere(center=[0.0, 0.0, 0.0], radius=x)
    if kind == kinds.CAPSULE and y > 0.0:
        return Capsule(start=[0.0, 0.0, -y], end=[0.0, 0.0, y], radius=x)
    if kind == kinds.CAPSULE:
        return Sphere(center=[0.0, 0.0, 0.0], radius=x)
    if kind == kinds.PLANE and not (x or y):
        return Plane(point=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0])
    mesh_options = {"compute_normals": False, "compute_uvs": False, "compute_inertia": False}
    if kind == kinds.ELLIPSOID:
        return _mesh(
            newton.Mesh.create_ellipsoid(
                x, y, z, num_latitudes=SEGMENTS // 2, num_longitudes=SEGMENTS, **mesh_options
            ),
            name,
        )
    if kind == kinds.CYLINDER:
        mesh = newton.Mesh.create_cylinder(
            x, y, up_axis=newton.Axis.Z, barrel_radius=z, segments=SEGMENTS, **mesh_options
        )
        return _mesh(mesh, name)
    if kind == kinds.CONE:
        return _mesh(
            newton.Mesh.create_cone(x, y, up_axis=newton.Axis.Z, segments=SEGMENTS, **mesh_options),
            name,
        )
    if kind == kinds.MESH:
        return _mesh(source, name, row["scale"])
    if kind == kinds.CONVEX_MESH:
        vertices = np.asarray(source.vertices, dtype=np.float64) * row["scale"]
        return TriangleMesh(
            surface=close_surface(vertices, ConvexHull(vertices).simplices, name),
            placement=Placement(),
        )
    raise ValueError(
        f"{name}: a shape of type {kinds(kind).name} encloses no volume, which a liquid needs"
    )


def _mesh(mesh: newton.Mesh, name: str, scale: np.ndarray | float = 1.0) -> TriangleMesh:
    vertices = np.asarray(mesh.vertices, dtype=np.float64) * scale
    return TriangleMesh(
        surface=close_surface(vertices, np.asarray(mesh.indices).reshape(-1, 3), name),
        placement=Placement(),
    )
