"""Renderer-independent description of a picture: meshes, camera and ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import warp as wp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from warp_lcp.grid.motion import Pose
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.surface_mesh import SurfaceMesh
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.render.actors import BODY_COLORS, WHITEWATER_RADIUS, is_round
from warp_lcp.render.grains import placed_grains
from warp_lcp.render.image_content import RenderError, VisiblePart
from warp_lcp.render.photo.meshes import (
    FINE_GRAINS,
    Distance,
    clipped_convex,
    closed_liquid,
    creased,
    grain_mesh,
    grain_poses,
    smooth_normals,
)
from warp_lcp.render.recording import Recording, spread
from warp_lcp.render.solid_meshes import nearest_distance, prescribed_solids
from warp_lcp.rigid.outline import body_surface
from warp_lcp.scene.camera import VIEW_ANGLE, Viewpoint, view_of_points, viewpoint
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.shapes import BoxTable, PlaneTable, Solid
from warp_lcp.simulation import Points, Surface

FRAMING_FRAMES = 8  # evenly spaced frames that determine the view
FRAMING_SHARE = 0.5  # percent of a frame's points that may lie outside the picture at each side
FRAMING_POINTS = 4000  # approximate limit for a frame
TOWARD = np.array([0.5, 0.42, 1.0]) / np.linalg.norm([0.5, 0.42, 1.0])  # direction to the camera

# Absorption over the domain's longest side, for red, green and blue: the transmittance is exp(-a).
# The real value, 0.35/m and less, would leave a tank of one meter without color.
ABSORPTION = {"water": np.array([2.6, 0.75, 0.42]), "syrup": np.array([2.0, 12.0, 60.0])}
SYRUP = 1.0  # viscosity [Pa s] from which a liquid has the color of honey
# Reflectances of grains.
SANDS = np.array([[0.62, 0.45, 0.27], [0.72, 0.58, 0.40], [0.45, 0.31, 0.19], [0.80, 0.72, 0.60]])
SAND_SHARES = np.array([0.45, 0.30, 0.15, 0.10])
SOLID = np.array([0.36, 0.38, 0.41])
PALE = np.array([0.82, 0.80, 0.76])  # reflectance of every other wedge of balls
WEDGES = 6
FOAM = np.array([0.92, 0.93, 0.94])  # reflectance of spray, foam and bubbles


class SurfaceFinish(StrEnum):
    """Surface finish: reflection and transmission of light."""

    LIQUID = "liquid"  # smooth dielectric, index of refraction 1.33, absorbing inside
    MATTE = "matte"  # diffuse
    SATIN = "satin"  # diffuse below a rough clear coat


@dataclass(frozen=True, eq=False)
class PhotoMesh:
    """Triangles of one material.

    Args:
        name: name of the mesh.
        points: [m], shape (n, 3).
        corners: point indices of the triangles, shape (m, 3), counterclockwise seen from outside.
        finish: finish of the surface.
        color: reflectance, or absorption of a liquid [1/m]; linear Rec. 709, shape (3,), or
            reflectances at the points, shape (n, 3).
        normals: unit normals at the points, shape (n, 3); None for flat triangles.
        velocity: velocities of the points [m/s], shape (n, 3); None at rest.
    """

    name: str
    points: np.ndarray
    corners: np.ndarray
    finish: SurfaceFinish
    color: np.ndarray
    normals: np.ndarray | None = None
    velocity: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class PhotoScene:
    """Content of a picture.

    Args:
        meshes: meshes of material, bodies and solids.
        view: the camera.
        ground: height of the ground [m].
        size: size of the domain [m].
    """

    meshes: Sequence[PhotoMesh]
    view: Viewpoint
    ground: float
    size: np.ndarray


class PhotoScenes:
    """Contents of the pictures of a run, by frame.

    If the frames of a liquid have only particles, a surface is built around them, unless particles
    are requested.

    Args:
        recording: frames of a 3-D run.
        aspect: width over height of the picture.
        beads: show a liquid's particles as beads if the frames have no surface.

    Raises:
        RenderError: the run is 2-D, or has no frame that can be read; or its particles exist only
            near a surface that is not in the frames.
    """

    def __init__(self, recording: Recording, aspect: float, *, beads: bool = False) -> None:
        scene = recording.scene
        if scene.dimension != 3:
            raise RenderError(
                "--look photo: draws 3-D runs; this one is 2-D, which --look quick draws"
            )
        self.recording, self._scene = recording, scene
        # Settings of the material.
        particles = scene.particles if isinstance(scene, ParticleScene) else None
        self._wrapped = scene.palette == "water" and particles is not None and not beads
        banded = particles is not None and particles.narrow_band is not None
        if self._wrapped and recording.show is VisiblePart.PARTICLES and banded:
            raise RenderError(
                "--look photo: a run with a narrow band of particles needs output.surface = true; "
                "--show particles draws beads"
            )
        self._spacing = recording.particle_spacing()
        self.view = framed(recording, aspect)
        self._prescribed = [
            (
                solid,
                solid.to_geometry(Path(), 3),
                solid.motion.to_motion(3) if solid.motion else None,
            )
            for solid in prescribed_solids(scene)
        ]
        self._bodies = [solid.to_geometry(Path(), 3) for solid in scene.solid if solid.is_body]

    def frame(self, number: int) -> PhotoScene:
        """Return the content of the picture of a frame.

        Raises:
            RenderError: the frame cannot be read.
        """
        time = self._scene.time.frame_time(number)
        bodies = self.recording.bodies(number)
        meshes = self._solid_meshes(time)
        if bodies is not None:
            meshes += body_meshes(
                bodies, [body_surface(geometry, 3).points for geometry in self._bodies]
            )
        if self.recording.show in (VisiblePart.SURFACE, VisiblePart.BOTH):
            meshes += self._material(self.recording.surface(number), self._distance(time, bodies))
        elif (
            self.recording.show is VisiblePart.PARTICLES
            and self._wrapped
            and isinstance(self._scene, ParticleScene)
        ):
            meshes += self._material(
                particle_surface(self._scene, self.recording.particles(number)),
                self._distance(time, bodies),
            )
        elif self.recording.show is VisiblePart.PARTICLES:
            meshes += self._grains(number)
        meshes += self._whitewater(number)
        return PhotoScene(meshes, self.view, 0.0, np.array(self._scene.domain.size))

    def _material(self, surface: Surface, distance: Distance | None) -> list[PhotoMesh]:
        """Return a liquid's surface, closed against walls and solids, or sand's surface."""
        if not len(surface.corners):
            return []
        if self._scene.palette == "sand":
            normals = smooth_normals(surface.points, surface.corners)
            return [
                PhotoMesh(
                    "sand",
                    surface.points,
                    surface.corners,
                    SurfaceFinish.MATTE,
                    SANDS[0],
                    normals,
                    surface.fields.get("velocity"),
                )
            ]
        points, corners, normals, velocity = closed_liquid(
            surface, self._scene.domain.size, self._scene.spacing, distance
        )
        absorption = liquid_absorption(self._scene)
        return [
            PhotoMesh(
                "liquid",
                points,
                corners,
                SurfaceFinish.LIQUID,
                absorption,
                normals,
                velocity if velocity.any() else None,
            )
        ]

    def _grains(self, number: int) -> list[PhotoMesh]:
        """Return particles as grains, in one mesh."""
        particles = self.recording.particles(number)
        if not len(particles.points):
            return []
        centers, seeds, radius = placed_grains(
            np.asarray(particles.points, dtype=np.float64), self._spacing, self._scene.domain.size
        )
        each, seeds = centers.shape[1], seeds.ravel()
        fine = len(seeds) <= FINE_GRAINS
        points, corners, own = grain_mesh(centers.reshape(-1, 3), radius, seeds, 1 if fine else 0)
        velocity = particles.fields.get("velocity")
        moved = None if velocity is None else np.asarray(velocity, dtype=np.float32)[own // each]
        color = (
            grain_colors(seeds)[own] if self._scene.palette == "sand" else liquid_beads(self._scene)
        )
        normals = smooth_normals(points, corners).astype(np.float32) if fine else None
        return [PhotoMesh("grains", points, corners, SurfaceFinish.MATTE, color, normals, moved)]

    def _whitewater(self, number: int) -> list[PhotoMesh]:
        """Return spray, foam and bubbles as white beads, in one mesh."""
        particles = self.recording.whitewater(number)
        if particles is None or not len(particles.points):
            return []
        seeds = np.arange(len(particles.points))
        radius = WHITEWATER_RADIUS * self._scene.spacing
        points, corners, own = grain_mesh(
            np.asarray(particles.points, dtype=np.float64), radius, seeds, 0
        )
        velocity = particles.fields.get("velocity")
        moved = None if velocity is None else np.asarray(velocity, dtype=np.float32)[own]
        return [PhotoMesh("whitewater", points, corners, SurfaceFinish.MATTE, FOAM, velocity=moved)]

    def _solid_meshes(self, time: float) -> list[PhotoMesh]:
        """Return the prescribed solids, cut at the domain; containers are invisible."""
        meshes = []
        margin = 1e-2 * self._scene.spacing
        low, high = np.full(3, -margin), np.array(self._scene.domain.size) + margin
        for number, (solid, geometry, motion) in enumerate(self._prescribed):
            pose = motion.pose(time) if motion else Pose.identity()
            if solid.invert and not isinstance(solid, PlaneTable):
                continue
            rows = _halfspaces(solid, pose)
            if rows is not None:
                found = clipped_convex(rows, low, high)
                if found is None:
                    continue
                points, corners = found
            else:
                outline = body_surface(geometry.moved(pose), 3)
                points, corners = outline.points, outline.corners
            points, corners, normals = creased(points, corners)
            meshes.append(
                PhotoMesh(f"solid_{number}", points, corners, SurfaceFinish.MATTE, SOLID, normals)
            )
        return meshes

    def _distance(self, time: float, bodies: Surface | None) -> Distance | None:
        """Return the signed distance to solids and bodies that a liquid may touch.

        None without any.
        """
        placed = [
            (geometry, motion.pose(time) if motion else Pose.identity())
            for _, geometry, motion in self._prescribed
        ]
        if bodies is not None:
            of_point = np.asarray(bodies.fields["body"]).ravel()
            for number, geometry in enumerate(self._bodies):
                now, first = bodies.points[of_point == number], body_surface(geometry, 3).points
                if len(now) == len(first):
                    placed.append((geometry, rigid_pose(first, now)))
        if not placed:
            return None
        return lambda points: nearest_distance(
            placed, wp.array(points, dtype=wp.vec3, device="cpu")
        )


def particle_surface(scene: ParticleScene, particles: Points) -> Surface:
    """Return the surface around a liquid's particles, as with `output.surface`.

    With the velocity of the nearest particle.
    """
    grid = StaggeredGrid(scene.cell_counts, scene.spacing, 3, "cpu")
    at = np.asarray(particles.points, dtype=np.float64)
    at = at[((at >= 0.0) & (at <= scene.domain.size)).all(axis=1)]
    output = scene.output
    wrap = SurfaceMesh(
        grid,
        per_axis=scene.particles.per_axis,
        resolution=output.surface_resolution,
        smoothing=output.surface_smoothing,
    )
    mesh = wrap.find(wp.array(at, dtype=wp.vec3, device="cpu"))
    points, corners, fields = mesh.points.numpy(), mesh.corners.numpy(), {}
    if len(points) and "velocity" in particles.fields:
        fields["velocity"] = particles.fields["velocity"][
            cKDTree(particles.points).query(points)[1]
        ]
    return Surface("surface", points, corners, fields)


def framed(recording: Recording, aspect: float) -> Viewpoint:
    """Return the scene's camera, or the nearest one that shows the whole run.

    The run's part is that of material and bodies in all frames.
    """
    scene = recording.scene
    if scene.camera.position is not None:
        return viewpoint(scene, aspect)
    low, high = scene.seen
    groups = []
    for number in spread(recording.numbers, FRAMING_FRAMES):
        if recording.show is VisiblePart.PARTICLES:
            groups.append(recording.particles(number).points)
        elif recording.show is not VisiblePart.BODIES:
            groups.append(recording.surface(number).points)
        if (bodies := recording.bodies(number)) is not None:
            groups.append(bodies.points)
    points = np.concatenate(
        [main_part(points) for points in groups if len(points)] or [np.stack([low, high])]
    )
    return view_of_points(
        np.clip(points, low, high), TOWARD, scene.camera.field_of_view or VIEW_ANGLE, aspect
    )


def main_part(points: np.ndarray) -> np.ndarray:
    """Return a sample of a frame's points, without single drops and grains."""
    low, high = np.percentile(points, [FRAMING_SHARE, 100.0 - FRAMING_SHARE], axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    return inside[:: len(inside) // FRAMING_POINTS + 1] if len(inside) else points[:1]


def body_meshes(bodies: Surface, at_first: Sequence[np.ndarray]) -> list[PhotoMesh]:
    """Return rigid bodies, each in a color of its own.

    Balls have wedges of two colors, which show their rotation.

    Args:
        bodies: surfaces with the field `body` and possibly `velocity`.
        at_first: points of each body as placed in the scene.
    """
    of_point, velocity = np.asarray(bodies.fields["body"]).ravel(), bodies.fields.get("velocity")
    meshes = []
    for body in np.unique(of_point):
        point_indices = np.flatnonzero(of_point == body)
        corners = bodies.corners[of_point[bodies.corners[:, 0]] == body]
        local = np.searchsorted(point_indices, corners)
        points, triangles, normals = creased(
            np.asarray(bodies.points[point_indices], dtype=np.float64), local
        )
        color = linear_color(BODY_COLORS[body % len(BODY_COLORS)])
        first = at_first[body] if body < len(at_first) else points[:0]
        if len(first) == len(point_indices) and is_round(first, local):
            middle = first[local].mean(axis=1) - 0.5 * (first.min(axis=0) + first.max(axis=0))
            wedge = (
                np.floor(np.arctan2(middle[:, 2], middle[:, 1]) / (2.0 * np.pi) * WEDGES).astype(
                    int
                )
                % 2
            )
            color = np.repeat(np.where(wedge[:, None] == 0, color, PALE), 3, axis=0)
        moved = (
            None if velocity is None else np.asarray(velocity)[point_indices][local].reshape(-1, 3)
        )
        meshes.append(
            PhotoMesh(f"body_{body}", points, triangles, SurfaceFinish.SATIN, color, normals, moved)
        )
    return meshes


def rigid_pose(first: np.ndarray, now: np.ndarray) -> Pose:
    """Return the rigid motion between two sets of points [m], by least squares.

    Rotation and translation from the first to the current points (Kabsch).
    """
    middle, there = first.mean(axis=0), now.mean(axis=0)
    turn = Rotation.align_vectors(now - there, first - middle)[0].as_matrix()
    return Pose.about(middle, turn, there - middle)


def grain_colors(seeds: np.ndarray) -> np.ndarray:
    """Return reflectances of grains by their seeds, shape (n, 3).

    Four tones of sand, lighter and darker.
    """
    tone = grain_poses(seeds)[3]
    kind = np.minimum(np.searchsorted(np.cumsum(SAND_SHARES), tone, side="right"), len(SANDS) - 1)
    shade = 0.8 + 0.35 * (37.0 * tone % 1.0)
    return np.clip(SANDS[kind] * shade[:, None], 0.0, 0.9)


def liquid_absorption(scene: Scene) -> np.ndarray:
    """Return a liquid's absorption [1/m]: that of water, or of syrup if viscous."""
    viscosity = getattr(scene, "viscosity", None)
    kind = "syrup" if viscosity is not None and viscosity.value >= SYRUP else "water"
    return ABSORPTION[kind] / max(scene.domain.size)


def liquid_beads(scene: Scene) -> np.ndarray:
    """Return the reflectance of a liquid's particles drawn as beads."""
    return np.exp(-liquid_absorption(scene) * max(scene.domain.size))


def linear_color(text: str) -> np.ndarray:
    """Return scene-linear Rec. 709 of an sRGB color such as `#e07a3f` (IEC 61966-2-1)."""
    code = np.array([int(text[place : place + 2], 16) for place in (1, 3, 5)]) / 255.0
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def _halfspaces(solid: Solid, pose: Pose) -> np.ndarray | None:
    """Return a box or a half-space as rows (n, d) of n x + d <= 0.

    None for other shapes.
    """
    placement = solid.placement(3).moved(pose)
    if isinstance(solid, PlaneTable):
        normal = (
            placement.rotation
            @ np.array(solid.normal)
            / np.linalg.norm(solid.normal)
            * (-1.0 if solid.invert else 1.0)
        )
        return np.append(normal, -normal @ placement.apply(np.array(solid.point)))[None]
    if isinstance(solid, BoxTable):
        normals = np.concatenate([placement.rotation.T, -placement.rotation.T])
        low, high = placement.apply(np.array([solid.min, solid.max], dtype=np.float64))
        return np.column_stack(
            [normals, -np.concatenate([placement.rotation.T @ high, -placement.rotation.T @ low])]
        )
    return None
