"""The solids of a run's images, drawn where they are at a frame's time. Needs the extra `render`."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, cast

import numpy as np
import warp as wp

from warp_lcp.grid.motion import Motion, Pose
from warp_lcp.grid.solids import Geometry
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.shapes import Box, Capsule, Mesh, Plane, Shape, Sphere

OUTLINE_POINTS = 1500  # along the longest side, where 2-D solids are sampled: about a drawn pixel
FLAT_SOLID, SOLID, EDGE, FLOOR = "#bfc3c8", "#cdd1d5", "#6b7075", "#f1f2f3"


class Scenery(ABC):
    """The domain and the solids of a scene on a plotter.

    Args:
        plotter: pyvista's.
        scene: of the run.
        line_width: of the domain's edges [pixels].
    """

    def __init__(self, plotter: Any, scene: Scene, line_width: float) -> None:
        """Draw what stands."""
        self.plotter, self.line_width = plotter, line_width
        self.size = np.array([*scene.domain.size, 0.0][:3])
        self._passing: list[str] = []  # names of what was drawn for a time
        self._draw_domain()
        dimension = scene.dimension
        solids = prescribed_solids(scene)
        self._keep([solid for solid in solids if not solid.motion])
        self._moving = [(solid.motion.to_motion(dimension), self._prepared(solid)) for solid in solids if solid.motion]

    def place(self, time: float) -> None:
        """Draw the solids that move where they are at a time [s]."""
        if not self._moving:
            return
        for name in self._passing:
            self.plotter.remove_actor(name, render=False)
        self._passing.clear()
        self._draw_moving(time)

    @abstractmethod
    def _draw_domain(self) -> None:
        """Draw the edges of the domain."""

    @abstractmethod
    def _keep(self, standing: list[Any]) -> None:
        """Draw the solids that stand, or keep what is needed to draw them with those that move."""

    @abstractmethod
    def _prepared(self, solid: Any) -> Any:
        """Return what is needed to draw a solid that moves."""

    @abstractmethod
    def _draw_moving(self, time: float) -> None:
        """Draw the solids that move."""

    def _add(self, mesh: Any, *, passing: bool = False, **looks: Any) -> None:
        """Draw a mesh, for this time only when it is passing."""
        if not mesh.n_points:
            return
        if passing:
            looks["name"] = f"passing {len(self._passing)}"
            self._passing.append(looks["name"])
        self.plotter.add_mesh(mesh, reset_camera=False, render=False, show_scalar_bar=False, **looks)


class FlatScenery(Scenery):
    """A rectangle; solids are filled where the signed distance to them is negative, a little behind the particles."""

    def _draw_domain(self) -> None:
        import pyvista

        width, height, _ = self.size
        corners = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0], [0, 0, 0]], dtype=np.float64)
        self._add(pyvista.lines_from_points(corners), color=EDGE, line_width=self.line_width, lighting=False)

    def _keep(self, standing: list[Any]) -> None:
        import pyvista

        sides = self.size[:2]
        self._step = max(sides) / OUTLINE_POINTS
        counts = [math.ceil(side / self._step) + 1 for side in sides]
        spacing = [side / (count - 1) for side, count in zip(sides, counts, strict=True)]
        self._plane = pyvista.ImageData(dimensions=(*counts, 1), spacing=(*spacing, 1.0))
        self._points = wp.array(self._plane.points * [1.0, 1.0, 0.0], dtype=wp.vec3, device="cpu")
        self._draw([solid.to_geometry(Path(), 2) for solid in standing], passing=False)

    def _prepared(self, solid: Any) -> Any:
        return solid.to_geometry(Path(), 2)

    def _draw_moving(self, time: float) -> None:
        self._draw([geometry.moved(motion.pose(time)) for motion, geometry in self._moving], passing=True)

    def _draw(self, geometries: list[Geometry], *, passing: bool) -> None:
        """Fill where the distance to the nearest is negative, and draw a line around it."""
        nearest = np.full(len(self._points), np.inf, dtype=np.float32)
        distance = wp.empty(len(nearest), dtype=wp.float32, device="cpu")
        for geometry in geometries:
            geometry.signed_distance(self._points, distance)
            np.minimum(nearest, distance.numpy(), out=nearest)
        if nearest.min() >= 0.0:
            return
        behind = -1e-3 * max(self.size)
        plane = self._plane
        plane.origin = (0.0, 0.0, behind)
        plane["distance"] = np.minimum(nearest, 1e3 * self._step)
        self._add(plane.clip_scalar(scalars="distance", value=0.0), passing=passing, color=FLAT_SOLID, lighting=False)
        if nearest.max() > 0.0:
            line = plane.contour([0.0], scalars="distance").translate((0.0, 0.0, -0.5 * behind))
            self._add(line, passing=passing, color=EDGE, line_width=0.75 * self.line_width, lighting=False)


class RoomScenery(Scenery):
    """A floor and the edges of a box; solids are surfaces, containers (inverted shapes) their translucent far sides."""

    def _draw_domain(self) -> None:
        import pyvista

        x, y, z = self.size
        below = -1e-3 * y
        self._add(pyvista.Rectangle([[0.0, below, 0.0], [x, below, 0.0], [x, below, z]]), color=FLOOR, lighting=False)
        edges = pyvista.Box((0.0, x, 0.0, y, 0.0, z)).extract_all_edges()
        self._add(edges, color=EDGE, line_width=0.6 * self.line_width, lighting=False)

    def _keep(self, standing: list[Any]) -> None:
        for shape in standing:
            self._draw(Outline(shape), Pose.identity(), passing=False)

    def _prepared(self, solid: Any) -> Any:
        return Outline(solid)

    def _draw_moving(self, time: float) -> None:
        for motion, outline in cast(list[tuple[Motion, Outline]], self._moving):
            self._draw(outline, motion.pose(time), passing=True)

    def _draw(self, outline: Outline, pose: Pose, *, passing: bool) -> None:
        mesh = outline.inside(self.size, pose)
        if outline.shape.invert and not isinstance(outline.shape, Plane):
            mesh = _clipped(mesh, self.size, closed=False)  # beyond the walls of the domain there is nothing to contain
            far_side = {"opacity": 0.3, "culling": "front"}
            self._add(mesh, passing=passing, color=SOLID, ambient=0.3, smooth_shading=True, split_sharp_edges=True, **far_side)
            edges = mesh.extract_feature_edges(30.0)
            self._add(edges, passing=passing, color=EDGE, line_width=0.5 * self.line_width, lighting=False)
        else:
            self._add(mesh, passing=passing, color=SOLID, ambient=0.5, smooth_shading=True, split_sharp_edges=True)


class Outline:
    """The surface of a 3-D shape, as pyvista's PolyData. Inverted shapes have the surface of what they leave out.

    Args:
        shape: in 3-D.

    Raises:
        TypeError: there is no drawing of such a shape.
    """

    def __init__(self, shape: Shape) -> None:
        """Make the surface in the shape's own coordinates."""
        import pyvista

        self.shape = shape
        match shape:
            case Plane():
                mesh = pyvista.PolyData()  # depends on the domain
            case Box():
                mesh = pyvista.Box(np.stack([shape.min, shape.max], axis=-1).ravel())
            case Sphere():
                mesh = pyvista.Sphere(radius=shape.radius, center=shape.center, theta_resolution=96, phi_resolution=64)
            case Capsule():
                start, end = np.array(shape.start), np.array(shape.end)
                mesh = pyvista.Capsule(
                    center=0.5 * (start + end), direction=end - start, radius=shape.radius,
                    cylinder_length=float(np.linalg.norm(end - start)), resolution=64,
                )  # fmt: skip
            case Mesh():
                solid = cast(Any, shape.to_geometry(Path(), 3)).surface
                mesh = pyvista.PolyData.from_regular_faces(solid.vertices, solid.triangles)
            case _:
                raise TypeError(f"a {type(shape).__name__} cannot be drawn")
        self.mesh = mesh.triangulate().clean() if mesh.n_points else mesh

    def inside(self, size: np.ndarray, pose: Pose) -> Any:
        """Return the surface where the shape is, cut at the domain's walls unless it is inverted.

        Args:
            size: of the domain [m], shape (3,).
            pose: relative to where the shape is placed.
        """
        import pyvista

        placement = self.shape.placement(3).moved(pose)
        if isinstance(self.shape, Plane):
            normal = placement.rotation @ np.array(self.shape.normal) * (-1.0 if self.shape.invert else 1.0)
            domain = pyvista.Box(np.stack([np.zeros(3), size], axis=-1).ravel()).clean()
            return domain.clip_closed_surface(normal=-normal, origin=placement.apply(np.array(self.shape.point)))
        mesh = self.mesh.copy()
        mesh.points = placement.apply(mesh.points)
        return mesh if self.shape.invert else _clipped(mesh, size)


def prescribed_solids(scene: Scene) -> list[Any]:
    """Return the solids whose places the scene tells; where the others, rigid bodies, are only frames know."""
    return [solid for solid in scene.solid if not solid.is_body]


def _clipped(mesh: Any, size: np.ndarray, *, closed: bool = True) -> Any:
    """Cut a surface at the domain's walls, where it reaches beyond; a closed one is closed again there."""
    for axis in range(3):
        for end, sign in ((0.0, 1.0), (size[axis], -1.0)):
            if mesh.n_points and (sign * (mesh.points[:, axis] - end)).min() < -1e-6 * size[axis]:
                normal, origin = sign * np.eye(3)[axis], end * np.eye(3)[axis]
                mesh = mesh.clip_closed_surface(normal=normal, origin=origin) if closed else mesh.clip(-normal, origin)
    return mesh
