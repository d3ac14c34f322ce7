"""USD stages of a run's frames.

Needs the extra `usd`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy.spatial.transform import Rotation

from warp_lcp.grid.motion import Motion
from warp_lcp.render.actors import BODY_COLORS, SURFACES, WHITEWATER, WHITEWATER_RADIUS
from warp_lcp.render.image_content import WITH_PARTICLES, WITH_SURFACE
from warp_lcp.render.recording import Recording, ids_of
from warp_lcp.render.solid_meshes import SOLID, prescribed_solids
from warp_lcp.rigid.outline import body_surface
from warp_lcp.scene.shapes import PlaneTable
from warp_lcp.simulation import Points, Surface

if TYPE_CHECKING:
    from pxr import Gf, Usd, UsdGeom, Vt

TEXT = ".usda"
SUFFIXES = (".usdc", TEXT, ".usd")
LINE_WIDTH = 0.1  # of outlines in 2-D, in cells
DISPLAY_GAMMA = 2.2  # colors of USD are linear


def load() -> type[Exception]:
    """Import USD; return the type of its errors.

    Raises:
        ImportError: it is not installed.
    """
    from pxr import Tf, Usd, UsdGeom  # noqa: F401

    return cast(type[Exception], Tf.ErrorException)


def cause(error: Exception) -> str:
    """Return the reason in an error of USD."""
    return str(error.args[0].commentary)


class UsdStage:
    """USD stage that grows by frames, with one frame at a time in memory.

    Frames that have been added are on the disk.

    Args:
        folder: folder for the new file.
        recording: frames of the run.
        numbers: numbers of the frames to add.
    """

    def __init__(self, folder: Path, recording: Recording, numbers: Sequence[int]) -> None:
        """Write the data that all frames share."""
        from pxr import Tf, Usd, UsdGeom

        scene, crate = recording.scene, folder / "frames.usdc"
        self._crate, self._recording, self._dimension = crate, recording, scene.dimension
        self._time, self._rate, self._always = (
            scene.time,
            scene.time.frames_per_second,
            Usd.TimeCode.Default(),
        )
        self._stage = stage = Usd.Stage.CreateNew(str(crate))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(self._rate)
        stage.SetFramesPerSecond(self._rate)
        stage.SetStartTimeCode(self._code(numbers[0]))
        stage.SetEndTimeCode(self._code(numbers[-1]))
        self._root = f"/{Tf.MakeValidIdentifier(scene.scene.name)}"
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, self._root).GetPrim())
        color = SURFACES[scene.palette]["color"]
        self._line_width = LINE_WIDTH * scene.spacing if self._dimension == 2 else 0.0
        self._spacing = recording.particle_spacing()
        self._surface = self._shape("surface", color) if recording.show in WITH_SURFACE else None
        if self._surface is not None and self._dimension == 3:
            self._surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        self._particles = (
            self._points("particles", color, self._spacing)
            if recording.show in WITH_PARTICLES
            else None
        )
        self._whitewater = self._whitewater_points(numbers[0])
        self._moving = self._solids()
        self._bodies: dict[int, tuple[np.ndarray, UsdGeom.XformOp]] = {}

    def add(self, number: int) -> None:
        """Add a frame.

        Raises:
            RenderError: the frame cannot be read.
        """
        code = self._code(number)
        if self._surface is not None:
            surface = self._recording.surface(number)
            self._set_shape(
                self._surface, surface.points, surface.corners, code, surface.fields.get("velocity")
            )
            if self._dimension == 3:
                self._surface.GetNormalsAttr().Set(_vectors(vertex_normals(surface)), code)
        if self._particles is not None:
            particles = sorted_by_id(self._recording.particles(number))
            _set_points(
                self._particles,
                particles.points,
                code,
                particles.fields.get("velocity"),
                self._spacing,
            )
            if self._recording.scene.output.ids:
                self._set_ids(self._particles, particles, code)
        self._set_whitewater(number, code)
        if (bodies := self._recording.bodies(number)) is not None:
            self._set_bodies(bodies, code)
        for motion, place in self._moving:
            pose = motion.pose(self._time.frame_time(number))
            place.Set(_matrix(pose.rotation, pose.translation), code)
        self._stage.Save()

    def saved_as(self, suffix: str) -> Path:
        """Close the stage; return its file.

        If the suffix is that of text, the file is converted.
        """
        file = self._crate
        if suffix == TEXT:
            file = file.with_suffix(suffix)
            self._stage.GetRootLayer().Export(str(file))
        self._stage = None
        return file

    def _code(self, number: int) -> float:
        """Return the time code of a frame.

        It is its number, or slightly less for the last frame of a run that ends between two frames.
        """
        return round(self._time.frame_time(number) * self._rate, 6)

    def _solids(self) -> list[tuple[Motion, UsdGeom.XformOp]]:
        """Write the prescribed solids; return motions and transforms of moving ones."""
        moving = []
        for number, solid in enumerate(prescribed_solids(self._recording.scene)):
            if isinstance(solid, PlaneTable):  # is unbounded
                continue
            outline = body_surface(solid.to_geometry(Path(), self._dimension), self._dimension)
            shape = self._shape(f"solid_{number}", SOLID)
            self._set_shape(shape, outline.points, outline.corners, self._always)
            if solid.invert:  # a container is seen from inside
                shape.CreateOrientationAttr("leftHanded")
            if solid.motion:
                moving.append((solid.motion.to_motion(self._dimension), shape.AddTransformOp()))
        return moving

    def _set_bodies(self, bodies: Surface, code: float) -> None:
        """Place rigid bodies; each shape is stored once, relative to its center."""
        for one in split_bodies(bodies):
            if one.number not in self._bodies:
                color = BODY_COLORS[one.number % len(BODY_COLORS)]
                shape = self._shape(f"body_{one.number}", color)
                self._set_shape(shape, one.points, one.corners, self._always)
                self._bodies[one.number] = one.points, shape.AddTransformOp()
            at_first, place = self._bodies[one.number]
            place.Set(_matrix(one.rotation_from(at_first), one.middle), code)

    def _shape(self, name: str, color: str) -> UsdGeom.Mesh | UsdGeom.BasisCurves:
        """Define a mesh of triangles, in 2-D curves of one segment each."""
        from pxr import UsdGeom

        path = f"{self._root}/{name}"
        if self._dimension == 3:
            shape = UsdGeom.Mesh.Define(self._stage, path)
            shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        else:
            shape = UsdGeom.BasisCurves.Define(self._stage, path)
            shape.CreateTypeAttr(UsdGeom.Tokens.linear)
            _set_width(shape, self._line_width)
        shape.CreateDisplayColorAttr(_color(color))
        return shape

    def _whitewater_points(self, number: int) -> UsdGeom.Points | None:
        """Define spray, foam and bubbles, if a frame has them, with `kind` and `age` [s]."""
        from pxr import Sdf, UsdGeom

        if self._recording.whitewater(number) is None:
            return None
        width = 2.0 * WHITEWATER_RADIUS * self._recording.scene.spacing
        points = self._points("whitewater", WHITEWATER[0], width)
        values = UsdGeom.PrimvarsAPI(points)
        for name, kind in (
            ("kind", Sdf.ValueTypeNames.IntArray),
            ("age", Sdf.ValueTypeNames.FloatArray),
        ):
            values.CreatePrimvar(name, kind, UsdGeom.Tokens.vertex)
        return points

    def _set_whitewater(self, number: int, code: float) -> None:
        """Set spray, foam and bubbles of a frame: `kind` is 0, 1 or 2."""
        from pxr import UsdGeom, Vt

        found = self._recording.whitewater(number)
        if self._whitewater is None or found is None:
            return
        width = 2.0 * WHITEWATER_RADIUS * self._recording.scene.spacing
        velocity = found.fields.get("velocity")
        _set_points(self._whitewater, found.points, code, velocity, width)
        values, count = UsdGeom.PrimvarsAPI(self._whitewater), len(found.points)
        kinds = np.asarray(found.fields.get("kind", np.zeros(count)))
        ages = np.asarray(found.fields.get("age", np.zeros(count)), dtype=np.float32)
        values.GetPrimvar("kind").Set(_integers(kinds), code)
        values.GetPrimvar("age").Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(ages)), code)

    def _points(self, name: str, color: str, width: float) -> UsdGeom.Points:
        """Define points of one width [m]."""
        from pxr import UsdGeom

        points = UsdGeom.Points.Define(self._stage, f"{self._root}/{name}")
        _set_width(points, width)
        points.CreateDisplayColorAttr(_color(color))
        return points

    def _set_ids(self, prim: UsdGeom.Points, particles: Points, code: float) -> None:
        """Set ids and ages [s] of particles; none in a frame that was written without."""
        from pxr import Sdf, UsdGeom, Vt

        ids = ids_of(particles)
        ids = np.zeros(0, dtype=np.int64) if ids is None else ids
        ages = particles.fields.get("age", np.zeros(0))
        prim.GetIdsAttr().Set(Vt.Int64Array.FromNumpy(np.ascontiguousarray(ids)), code)
        kind, place = Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex
        age = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("age", kind, place)
        age.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(ages, dtype=np.float32)), code)

    def _set_shape(
        self,
        shape: UsdGeom.Mesh | UsdGeom.BasisCurves,
        points: np.ndarray,
        corners: np.ndarray,
        when: Usd.TimeCode | float,
        velocity: np.ndarray | None = None,
    ) -> None:
        counts = _integers(np.full(len(corners), corners.shape[1]))
        if self._dimension == 3:
            shape.GetFaceVertexCountsAttr().Set(counts, when)
            shape.GetFaceVertexIndicesAttr().Set(_integers(corners.ravel()), when)
        else:
            ends = corners.ravel()
            points, velocity = points[ends], None if velocity is None else velocity[ends]
            shape.GetCurveVertexCountsAttr().Set(counts, when)
        _set_points(shape, points, when, velocity, self._line_width)


def sorted_by_id(particles: Points) -> Points:
    """Return particles in the order of their ids; unchanged if they have none.

    Programs that interpolate points between frames pair them by their index. In this order a
    particle keeps its index while none comes or goes.
    """
    ids = ids_of(particles)
    if ids is None:
        return particles
    order = np.argsort(ids, kind="stable")
    fields = {name: values[order] for name, values in particles.fields.items()}
    return Points(particles.name, particles.points[order], fields)


def vertex_normals(surface: Surface) -> np.ndarray:
    """Return unit normals at the points of a triangle surface, shape (n, 3).

    Area-weighted means over the adjacent triangles.
    """
    a, b, c = np.moveaxis(surface.points[surface.corners], 1, 0)
    twice_area = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = [
        np.bincount(surface.corners.ravel(), weights=of, minlength=len(surface.points))
        for of in twice_area.T
    ]
    normals = np.stack(sums, axis=-1)
    return np.asarray(
        normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    )


def _set_points(
    prim: UsdGeom.PointBased,
    points: np.ndarray,
    when: Usd.TimeCode | float,
    velocity: np.ndarray | None,
    width: float,
) -> None:
    """Set points [m], velocities [m/s] and extent of a prim at a time code."""
    prim.GetPointsAttr().Set(_vectors(points), when)
    if velocity is not None:
        prim.GetVelocitiesAttr().Set(_vectors(velocity), when)
    extent = (
        [points.min(axis=0) - 0.5 * width, points.max(axis=0) + 0.5 * width]
        if len(points)
        else np.zeros((2, 3))
    )
    prim.GetExtentAttr().Set(_vectors(np.asarray(extent)), when)


def _set_width(prim: UsdGeom.Points | UsdGeom.Curves, width: float) -> None:
    """Set one width [m] for all points of curves or of a point cloud."""
    from pxr import UsdGeom

    prim.CreateWidthsAttr([width])
    prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)


def _vectors(values: np.ndarray) -> Vt.Vec3fArray:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(np.nan_to_num(values), dtype=np.float32))


def _integers(values: np.ndarray) -> Vt.IntArray:
    from pxr import Vt

    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, dtype=np.int32))


@dataclass(frozen=True)
class PlacedBody:
    """Surface of a rigid body in a frame.

    Args:
        number: number of the body.
        points: positions relative to the middle [m], shape (n, 3).
        corners: indices of points, shape (m, 3), in 2-D (m, 2).
        middle: mean of the positions [m].
    """

    number: int
    points: np.ndarray
    corners: np.ndarray
    middle: np.ndarray

    def rotation_from(self, at_first: np.ndarray) -> np.ndarray:
        """Return the rotation, a matrix, from points of an earlier frame to these."""
        return np.asarray(Rotation.align_vectors(self.points, at_first)[0].as_matrix())


def split_bodies(bodies: Surface) -> Iterator[PlacedBody]:
    """Yield the rigid bodies of a frame."""
    of_point = np.asarray(bodies.fields["body"]).ravel()
    for body in np.unique(of_point):
        of_body = of_point == body
        middle = bodies.points[of_body].mean(axis=0)
        corners = bodies.corners[of_body[bodies.corners[:, 0]]]
        of_points = (np.cumsum(of_body) - 1)[corners]
        yield PlacedBody(int(body), bodies.points[of_body] - middle, of_points, middle)


def _matrix(rotation: np.ndarray, translation: np.ndarray) -> Gf.Matrix4d:
    """Return a transform as a USD matrix, for row vectors."""
    from pxr import Gf

    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = rotation.T, translation
    return Gf.Matrix4d(matrix.tolist())


def _color(code: str) -> Vt.Vec3fArray:
    """Return a color such as #4aa9ee as a USD color."""
    parts = [int(code[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    return _vectors(np.array([parts]) ** DISPLAY_GAMMA)
