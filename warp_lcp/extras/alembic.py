"""Alembic archives of a run's frames.

Needs the extra `alembic` (alembic3d). Alembic reports a full disk when it writes, but aborts the
process when it then closes the archive. So an archive that fails stays open until the process ends,
and space for the bytes that closing writes is reserved from the start.
"""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from warp_lcp.extras.usd import LINE_WIDTH, split_bodies, vertex_normals
from warp_lcp.grid.motion import Motion
from warp_lcp.render.actors import WHITEWATER_RADIUS
from warp_lcp.render.image_content import WITH_PARTICLES, WITH_SURFACE, RenderError
from warp_lcp.render.recording import Recording
from warp_lcp.render.solid_meshes import prescribed_solids
from warp_lcp.rigid.outline import body_surface
from warp_lcp.scene.shapes import PlaneTable
from warp_lcp.simulation import Points

if TYPE_CHECKING:
    import imath
    from alembic3d.Abc import OArchive
    from alembic3d.AbcGeom import (
        OCurves,
        OFloatGeomParam,
        OFloatGeomParamSample,
        OObject,
        OPolyMesh,
        OXform,
    )

SUFFIXES = (".abc",)
CLOSING_BYTES = 2**16, 2**11  # written when an archive is closed, at most: in all, and per frame
STATIC = 0  # number of the time sampling of what does not move
MOST_IDS = 2**31
NUMBERS = ("age", "kind")  # fields of points that are written, one number a point
ArrayT = TypeVar("ArrayT")


def load() -> type[Exception]:
    """Import Alembic; return the type of its errors.

    Raises:
        ImportError: it is not installed.
    """
    import alembic3d  # noqa: F401
    import imath  # noqa: F401

    return RuntimeError


def cause(error: Exception) -> str:
    """Return the reason in an error of Alembic: the last line that is not its own."""
    line = str(error).strip().splitlines()[-1]
    return "no space left, or a failing disk" if "iostream" in line else line


class AlembicArchive:
    """Alembic archive that grows by frames, with one frame at a time in memory.

    Its objects are named as the prims of a `UsdStage`. `particles` have ids: those of the frames,
    in their order, or the numbers of the points in each frame.

    Args:
        folder: folder for the new file.
        recording: frames of the run.
        numbers: numbers of the frames to add.
    """

    def __init__(self, folder: Path, recording: Recording, numbers: Sequence[int]) -> None:
        """Write the data that all frames share.

        Raises:
            RuntimeError: the disk is full.
        """
        scene = recording.scene
        self._recording, self._dimension, self._time = recording, scene.dimension, scene.time
        self._file, self._reserve = folder / "frames.abc", folder / "reserve"
        self._reserve.write_bytes(bytes(CLOSING_BYTES[0] + CLOSING_BYTES[1] * len(numbers)))
        self._line_width = LINE_WIDTH * scene.spacing
        self._archive: OArchive | None = None
        self._top: OObject | None = None
        self._surface: OPolyMesh | OCurves | None = None
        self._particles: PointsObject | None = None
        self._whitewater: PointsObject | None = None
        # Transforms, and shapes in them, which are closed with the archive.
        self._rigid: list[OXform | OPolyMesh | OCurves] = []
        self._moving: list[tuple[Motion, OXform]] = []
        self._bodies: dict[int, tuple[np.ndarray, OXform]] = {}
        self._added = 0
        try:
            self._begin(numbers)
        except RuntimeError:
            self._leak()
            raise

    def _begin(self, numbers: Sequence[int]) -> None:
        """Create the archive and its objects, and write the solids."""
        from alembic3d import Abc

        recording, scene = self._recording, self._recording.scene
        rate, folder = scene.time.frames_per_second, str(self._file.parent)
        self._archive = Abc.CreateArchiveWithInfo(str(self._file), rate, "warp_lcp", folder)
        self._samples = self._archive.addTimeSampling(_sampling(recording, numbers))
        self._top = self._archive.getTop()
        if recording.show in WITH_SURFACE:
            self._surface = self._shape(self._top, "surface", self._samples)
        if recording.show in WITH_PARTICLES:
            self._particles = PointsObject(
                self._top, "particles", self._samples, recording.particle_spacing()
            )
        if recording.whitewater(numbers[0]) is not None:
            width = 2.0 * WHITEWATER_RADIUS * scene.spacing
            self._whitewater = PointsObject(self._top, "whitewater", self._samples, width)
        self._add_solids()

    def add(self, number: int) -> None:
        """Add a frame.

        Raises:
            RenderError: the frame cannot be read.
        """
        try:
            self._add(number)
        except RuntimeError:
            self._leak()
            raise

    def _add(self, number: int) -> None:
        if self._surface is not None:
            surface = self._recording.surface(number)
            velocity = surface.fields.get("velocity")
            normals = vertex_normals(surface) if self._dimension == 3 else None
            self._set_shape(self._surface, surface.points, surface.corners, velocity, normals)
        if self._particles is not None:
            self._particles.set(self._recording.particles(number))
        if self._whitewater is not None:
            whitewater = self._recording.whitewater(number)
            # Each frame needs a sample: the times of samples are those of the frames in order.
            nothing = Points("whitewater", np.zeros((0, 3), dtype=np.float32), {})
            self._whitewater.set(nothing if whitewater is None else whitewater)
        self._set_bodies(number)
        for motion, place in self._moving:
            pose = motion.pose(self._time.frame_time(number))
            _set_place(place, pose.rotation, np.asarray(pose.translation))
        self._added += 1

    def saved_as(self, suffix: str) -> Path:
        """Close the archive; return its file."""
        self._reserve.unlink()
        self._surface = self._particles = self._whitewater = None
        self._top = self._archive = None
        self._moving, self._bodies, self._rigid = [], {}, []
        gc.collect()
        return self._file

    def _leak(self) -> None:
        """Keep all objects until the process ends, since closing would abort it."""
        points = [
            one
            for of in (self._particles, self._whitewater)
            if of is not None
            for one in of.objects
        ]
        objects = (self._surface, *points, self._top, self._archive)
        for one in (*objects, *self._rigid):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(one))

    def _add_solids(self) -> None:
        """Write the prescribed solids."""
        for number, solid in enumerate(prescribed_solids(self._recording.scene)):
            if isinstance(solid, PlaneTable):  # is unbounded
                continue
            outline = body_surface(solid.to_geometry(Path(), self._dimension), self._dimension)
            corners = outline.corners[:, ::-1] if solid.invert else outline.corners
            samples = self._samples if solid.motion else STATIC
            place = self._add_rigid(f"solid_{number}", samples, outline.points, corners)
            if solid.motion:
                self._moving.append((solid.motion.to_motion(self._dimension), place))

    def _set_bodies(self, number: int) -> None:
        """Place rigid bodies; each shape is stored once, relative to its center."""
        bodies, present = self._recording.bodies(number), set()
        for one in () if bodies is None else split_bodies(bodies):
            present.add(one.number)
            if one.number not in self._bodies:
                name = f"body_{one.number}"
                place = self._add_rigid(name, self._samples, one.points, one.corners)
                self._bodies[one.number] = one.points, place
                for _ in range(self._added):  # earlier frames without it
                    _set_place(place, one.rotation_from(one.points), one.middle)
            at_first, place = self._bodies[one.number]
            _set_place(place, one.rotation_from(at_first), one.middle)
        for body in self._bodies.keys() - present:
            self._bodies[body][1].getSchema().setFromPrevious()

    def _add_rigid(
        self, name: str, samples: int, points: np.ndarray, corners: np.ndarray
    ) -> OXform:
        """Return a new transform with a rigid shape."""
        from alembic3d import AbcGeom

        place = AbcGeom.OXform(self._top, name, samples)
        self._rigid.append(place)
        shape = self._shape(place, "shape", STATIC)
        self._rigid.append(shape)
        self._set_shape(shape, points, corners)
        return place

    def _shape(self, parent: OObject, name: str, samples: int) -> OPolyMesh | OCurves:
        """Return a new mesh of triangles, in 2-D curves of one segment each."""
        from alembic3d import AbcGeom

        kind = AbcGeom.OPolyMesh if self._dimension == 3 else AbcGeom.OCurves
        return kind(parent, name, samples)

    def _set_shape(
        self,
        shape: OPolyMesh | OCurves,
        points: np.ndarray,
        corners: np.ndarray,
        velocity: np.ndarray | None = None,
        normals: np.ndarray | None = None,
    ) -> None:
        """Add a sample of points [m], corners, velocities [m/s] and normals.

        Corners of Alembic's faces are clockwise, seen from outside.
        """
        from alembic3d import AbcGeom

        held = HeldArrays()
        counts = held.integers(np.full(len(corners), corners.shape[1]))
        if self._dimension == 3:
            indices = held.integers(corners[:, ::-1].ravel())
            sample = AbcGeom.OPolyMeshSchemaSample(held.vectors(points), indices, counts)
            if normals is not None:
                scope = AbcGeom.GeometryScope.kVertexScope
                sample.setNormals(AbcGeom.ON3fGeomParamSample(held.vectors(normals), scope))
        else:
            ends = corners.ravel()
            points, velocity = points[ends], None if velocity is None else velocity[ends]
            linear = AbcGeom.CurveType.kLinear
            sample = AbcGeom.OCurvesSchemaSample(held.vectors(points), counts, linear)
            sample.setWidths(held.constant(self._line_width))
        if velocity is not None:
            sample.setVelocities(held.vectors(velocity))
        shape.getSchema().set(sample)


class PointsObject:
    """Points of an archive, such as particles.

    Args:
        parent: object above it.
        name: name of the object.
        samples: number of its time sampling.
        width: width of the points [m].
    """

    def __init__(self, parent: OObject, name: str, samples: int, width: float) -> None:
        from alembic3d import AbcGeom

        self._samples, self._width = samples, width
        self._points = AbcGeom.OPoints(parent, name, samples)
        self._numbers: dict[str, OFloatGeomParam] = {}

    @property
    def objects(self) -> tuple[object, ...]:
        """Alembic's objects, which write when they are closed."""
        return self._points, *self._numbers.values()

    def set(self, points: Points) -> None:
        """Add a sample: positions [m], ids, velocities [m/s] and numbers that the frame has.

        Ids are the numbers of the points in a frame without `id`. A number that the first frame
        lacks is not written.

        Raises:
            RenderError: an id has more than 31 bits.
        """
        from alembic3d import AbcGeom

        ids = points.fields.get("id", np.arange(len(points.points))).ravel()
        if len(ids) and ids.max() >= MOST_IDS:
            raise RenderError(f"ids of particles exceed {MOST_IDS - 1}: export USD")
        order = np.argsort(ids, kind="stable")  # programs pair points of two frames by their index
        held = HeldArrays()
        positions, numbers = held.vectors(points.points[order]), held.integers(ids[order])
        sample = AbcGeom.OPointsSchemaSample(positions, numbers)
        sample.setWidths(held.constant(self._width))
        if (velocity := points.fields.get("velocity")) is not None:
            sample.setVelocities(held.vectors(velocity[order]))
        schema, scope = self._points.getSchema(), AbcGeom.GeometryScope.kVaryingScope
        is_first = schema.getNumSamples() == 0
        schema.set(sample)
        if is_first:
            for name in (name for name in NUMBERS if name in points.fields):
                arguments = (schema.getArbGeomParams(), name, False, scope, 1, self._samples)
                self._numbers[name] = AbcGeom.OFloatGeomParam(*arguments)
        for name, param in self._numbers.items():
            values = np.asarray(points.fields.get(name, np.zeros(len(ids)))).ravel()
            param.set(AbcGeom.OFloatGeomParamSample(held.floats(values[order]), scope))


def _sampling(recording: Recording, numbers: Sequence[int]) -> object:
    """Return the times of frames [s]: evenly spaced, unless the run ends between two frames."""
    from alembic3d.AbcCoreAbstract import AcyclicFlag, TimeSampling, TimeSamplingType, TimeVector

    times = [recording.scene.time.frame_time(number) for number in numbers]
    interval = 1.0 / recording.scene.time.frames_per_second
    if np.allclose(np.diff(times), interval, rtol=1e-6):
        return TimeSampling(interval, times[0])
    listed = TimeVector()
    listed.extend(times)
    return TimeSampling(TimeSamplingType(AcyclicFlag.kAcyclic), listed)


def _set_place(place: OXform, rotation: np.ndarray, translation: np.ndarray) -> None:
    """Add a sample of a transform, a matrix for row vectors."""
    import imath
    from alembic3d import AbcGeom

    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = rotation.T, translation
    sample = AbcGeom.XformSample()
    sample.setMatrix(imath.M44d(*matrix.ravel().tolist()))
    place.getSchema().set(sample)


class HeldArrays:
    """Arrays of one sample, in the types of Alembic.

    Samples of alembic3d point to the memory of the arrays that they are made of, but do not keep
    them. So this object must live until the sample is written.
    """

    def __init__(self) -> None:
        self._arrays: list[object] = []

    def vectors(self, values: np.ndarray) -> imath.V3fArray:
        """Return vectors in float32; values that are not finite become 0."""
        import imath

        source = self._held(np.ascontiguousarray(np.nan_to_num(values), dtype=np.float32))
        return self._held(imath.V3fArrayFromBuffer(source))

    def integers(self, values: np.ndarray) -> imath.IntArray:
        """Return integers of 32 bits."""
        import imath

        source = self._held(np.ascontiguousarray(values, dtype=np.int32))
        return self._held(imath.IntArrayFromBuffer(source))

    def floats(self, values: np.ndarray) -> imath.FloatArray:
        """Return numbers in float32."""
        import imath

        source = self._held(np.ascontiguousarray(values, dtype=np.float32))
        return self._held(imath.FloatArrayFromBuffer(source))

    def constant(self, value: float) -> OFloatGeomParamSample:
        """Return one number for all points."""
        from alembic3d import AbcGeom

        scope = AbcGeom.GeometryScope.kConstantScope
        return AbcGeom.OFloatGeomParamSample(self.floats(np.array([value])), scope)

    def _held(self, array: ArrayT) -> ArrayT:
        self._arrays.append(array)
        return array
