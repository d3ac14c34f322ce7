"""Domain and solids of a run's images, at the time of a frame.

Needs the extra `render`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar, cast

import numpy as np
import warp as wp

from warp_lcp.grid.motion import Pose
from warp_lcp.grid.signed_distance import Geometry, TriangleMesh
from warp_lcp.render.actors import MeshStyle, StyledMesh
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.shapes import (
    BoxTable,
    CapsuleTable,
    MeshTable,
    PlaneTable,
    Shape,
    Solid,
    SphereTable,
)
from warp_lcp.simulation import Surface

if TYPE_CHECKING:
    import pyvista

PreparedT = TypeVar("PreparedT")

OUTLINE_POINTS = 1500  # sample points of 2-D solids along the longest side: about a pixel
TOUCHING = 0.75
# Extent of the white frame, relative to the longest side; position of lines, relative to `front`.
AROUND, LINE_FRONT = 20.0, 1.2
FLAT_SOLID, SOLID, EDGE = "#bfc3c8", "#cdd1d5", "#6b7075"


class SolidDrawer(Protocol[PreparedT]):
    """Draws the domain, and solids that it has prepared."""

    def domain(self) -> list[StyledMesh]:
        """Return the domain."""

    def prepared(self, solid: Shape) -> PreparedT:
        """Return the form of a solid that `meshes` draws."""

    def meshes(self, solids: Sequence[tuple[PreparedT, Pose]]) -> list[StyledMesh]:
        """Return solids with their poses."""


class FlatSolids:
    """Domain and solids in 2-D: a white frame, and filled solids.

    Solids fill the region of negative signed distance. Both lie in front of the particles and hide
    the parts of their discs beyond a wall, which would look like a saw.

    Args:
        size: size of the domain [m].
        line_width: width of the domain's edges [pixels].
        front: distance of walls in front of the particles [m].
    """

    def __init__(self, size: Sequence[float], line_width: float, front: float) -> None:
        """Choose the sample points of distances."""
        import pyvista

        self.size, self.line_width, self.front = size, line_width, front
        self._step = max(size) / OUTLINE_POINTS
        counts = [math.ceil(side / self._step) + 1 for side in size]
        spacing = [side / (count - 1) for side, count in zip(size, counts, strict=True)]
        self._plane = pyvista.ImageData(dimensions=(*counts, 1), spacing=(*spacing, 1.0))
        self._points = wp.array(self._plane.points, dtype=wp.vec3, device="cpu")

    def domain(self) -> list[StyledMesh]:
        """Return the frame around the domain, and its edges."""
        import pyvista

        (right, top), far, z = self.size, AROUND * max(self.size), self.front
        boxes = [
            (-far, 0.0, -far, far),
            (right, far, -far, far),
            (0.0, right, -far, 0.0),
            (0.0, right, top, far),
        ]
        corners = [np.array([[a, c, z], [b, c, z], [b, d, z], [a, d, z]]) for a, b, c, d in boxes]
        around = pyvista.PolyData.from_regular_faces(
            np.concatenate(corners), np.arange(16).reshape(4, 4)
        )
        z *= LINE_FRONT
        edges = pyvista.Rectangle(
            [(0.0, 0.0, z), (right, 0.0, z), (right, top, z)]
        ).extract_all_edges()
        return [
            (around, {"color": "white", "lighting": False}),
            (edges, {"color": EDGE, "line_width": self.line_width, "lighting": False}),
        ]

    def prepared(self, solid: Shape) -> Geometry:
        """Return the geometry of a solid."""
        return solid.to_geometry(Path(), 2)

    def meshes(self, solids: Sequence[tuple[Geometry, Pose]]) -> list[StyledMesh]:
        """Return the region of negative distance to the nearest solid, and its outline."""
        nearest = nearest_distance(solids, self._points)
        if nearest.min() >= 0.0:
            return []
        self._plane["distance"] = np.minimum(nearest, 1e3 * self._step)
        inside = self._plane.clip_scalar(scalars="distance", value=0.0).translate(
            (0.0, 0.0, self.front)
        )
        line = self._plane.contour([0.0], scalars="distance").translate(
            (0.0, 0.0, LINE_FRONT * self.front)
        )
        edge: MeshStyle = {"color": EDGE, "line_width": 0.75 * self.line_width, "lighting": False}
        return [(inside, {"color": FLAT_SOLID, "lighting": False}), (line, edge)]


class RoomSolids:
    """Domain and solids in 3-D: edges of a box, and surfaces of solids.

    Containers (inverted shapes) have translucent far sides.

    Args:
        size: size of the domain [m].
        line_width: width of the domain's edges [pixels].
    """

    def __init__(self, size: Sequence[float], line_width: float) -> None:
        self.size, self.line_width = np.array(size), line_width

    def domain(self) -> list[StyledMesh]:
        """Return the edges of the domain."""
        import pyvista

        x, y, z = self.size
        edges = pyvista.Box((0.0, x, 0.0, y, 0.0, z)).extract_all_edges()
        line: MeshStyle = {"color": EDGE, "line_width": 0.6 * self.line_width, "lighting": False}
        return [(edges, line)]

    def prepared(self, solid: Shape) -> Outline:
        """Return the surface of a solid, in its own coordinates."""
        return Outline(solid)

    def meshes(self, solids: Sequence[tuple[Outline, Pose]]) -> list[StyledMesh]:
        """Return the surfaces of solids, and the edges of containers."""
        meshes: list[StyledMesh] = []
        for outline, pose in solids:
            mesh = outline.inside(self.size, pose)
            looks: MeshStyle = {"color": SOLID, "smooth_shading": True, "split_sharp_edges": True}
            if outline.shape.invert and not isinstance(outline.shape, PlaneTable):
                # Containers end at the walls of the domain.
                mesh = _clipped(mesh, self.size, closed=False)
                line: MeshStyle = {
                    "color": EDGE,
                    "line_width": 0.5 * self.line_width,
                    "lighting": False,
                }
                meshes += [
                    (mesh, {"ambient": 0.3, "opacity": 0.3, "culling": "front", **looks}),
                    (mesh.extract_feature_edges(30.0), line),
                ]
            else:
                meshes.append((mesh, {"ambient": 0.5, **looks}))
        return meshes


class Outline:
    """Surface of a 3-D shape, as pyvista's PolyData.

    Inverted shapes have the surface of their complement.

    Args:
        shape: the shape, in 3-D.

    Raises:
        TypeError: shapes of this kind cannot be drawn.
    """

    def __init__(self, shape: Shape) -> None:
        """Build the surface in the shape's own coordinates."""
        import pyvista

        self.shape = shape
        match shape:
            case PlaneTable():
                mesh = pyvista.PolyData()  # depends on the domain
            case BoxTable():
                mesh = pyvista.Box(np.stack([shape.min, shape.max], axis=-1).ravel())
            case SphereTable():
                mesh = pyvista.Sphere(
                    radius=shape.radius, center=shape.center, theta_resolution=96, phi_resolution=64
                )
            case CapsuleTable():
                start, end = np.array(shape.start), np.array(shape.end)
                mesh = pyvista.Capsule(
                    center=0.5 * (start + end),
                    direction=end - start,
                    radius=shape.radius,
                    cylinder_length=float(np.linalg.norm(end - start)),
                    resolution=64,
                )
            case MeshTable():
                solid = cast(TriangleMesh, shape.to_geometry(Path(), 3)).surface
                mesh = pyvista.PolyData.from_regular_faces(solid.vertices, solid.triangles)
            case _:
                raise TypeError(f"a {type(shape).__name__} cannot be drawn")
        self.mesh = mesh.triangulate().clean() if mesh.n_points else mesh

    def inside(self, size: np.ndarray, pose: Pose) -> pyvista.DataSet:
        """Return the placed surface, cut at the domain's walls unless inverted.

        Args:
            size: size of the domain [m], shape (3,).
            pose: pose relative to the shape's placement.
        """
        import pyvista

        placement = self.shape.placement(3).moved(pose)
        if isinstance(self.shape, PlaneTable):
            normal = (
                placement.rotation
                @ np.array(self.shape.normal)
                * (-1.0 if self.shape.invert else 1.0)
            )
            domain = pyvista.Box(np.stack([np.zeros(3), size], axis=-1).ravel()).clean()
            return domain.clip_closed_surface(
                normal=-normal, origin=placement.apply(np.array(self.shape.point))
            )
        mesh = self.mesh.copy()
        mesh.points = placement.apply(mesh.points)
        return mesh if self.shape.invert else _clipped(mesh, size)


def prescribed_solids(scene: Scene) -> list[Solid]:
    """Return the solids with prescribed motion, without rigid bodies.

    Positions of rigid bodies are only in frames.
    """
    return [solid for solid in scene.solid if not solid.is_body]


def nearest_distance(solids: Sequence[tuple[Geometry, Pose]], points: wp.array) -> np.ndarray:
    """Return the signed distance from points [m] to the nearest solid [m].

    On the CPU; infinite without solids.
    """
    nearest = np.full(len(points), np.inf, dtype=np.float32)
    distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
    for solid, pose in solids:
        solid.moved(pose).signed_distance(points, distance)
        np.minimum(nearest, distance.numpy(), out=nearest)
    return nearest


def apart(surface: Surface, solids: Sequence[tuple[Geometry, Pose]], spacing: float) -> Surface:
    """Return a liquid's surface without the parts that touch solids.

    The sides of solids would be visible twice through the liquid.

    Args:
        surface: closed triangles, whose normals point out of the liquid.
        solids: the solids and their poses.
        spacing: cell size [m]; a surface within `TOUCHING` cells of a solid touches it.
    """
    corners = surface.points[surface.corners]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    middle = corners.mean(axis=1)
    distance, ahead = (
        nearest_distance(
            solids, wp.array(middle + step * spacing * normal, dtype=wp.vec3, device="cpu")
        )
        for step in (0.0, TOUCHING)
    )
    touches = (distance < TOUCHING * spacing) & (ahead < distance - 0.5 * TOUCHING * spacing)
    return replace(surface, corners=surface.corners[~touches])


def _clipped(mesh: pyvista.PolyData, size: np.ndarray, *, closed: bool = True) -> pyvista.PolyData:
    """Cut a surface at the domain's walls; a closed one is closed again there."""
    for axis in range(3):
        for end, sign in ((0.0, 1.0), (size[axis], -1.0)):
            if mesh.n_points and (sign * (mesh.points[:, axis] - end)).min() < -1e-6 * size[axis]:
                normal, origin = sign * np.eye(3)[axis], end * np.eye(3)[axis]
                mesh = (
                    mesh.clip_closed_surface(normal=normal, origin=origin)
                    if closed
                    else mesh.clip(-normal, origin=origin)
                )
    return mesh
