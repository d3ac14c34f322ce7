"""Prescribed motions of solids.

A motion is a pose over time, relative to the placement in the scene.

All motions are functions of time alone, in float64: a solid that turns for a million steps does not
drift, and a resumed run has the same poses. Points and directions are those of the domain [m]; two
coordinates mean z = 0, and a 2-D scene turns about z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.spatial import transform

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.host_kernel import HostKernel

Vector = Sequence[float] | np.ndarray

# Largest error of R R' - 1 of a pose; products of a few rotations stay near 1e-15.
ROTATION_ERROR = 1e-9
# [m/s] or [degrees/s], between keyframes of a smooth motion, whose cubics use squares and higher
# powers.
FASTEST = 1e18
SPEED_SAMPLES = 4  # parts of a time span in which the top speed is evaluated
TOP_SPEED = HostKernel(
    KernelFile(Path(__file__).parent / "headers/moving_solids.h")["warp_lcp.grid.motion.top_speed"]
)
PARTS = np.arange(SPEED_SAMPLES + 1.0)
UNLIMITED = np.array([[-np.inf], [np.inf]]) * np.ones(3)  # bounds of an unbounded solid
SAME_AXIS = 1e-9  # 1 - cosine of the angle between two axes that count as one


class RigidTransform(Protocol):
    """A rotation and a translation, of a frozen dataclass."""

    @property
    def rotation(self) -> np.ndarray:
        """Rotation matrix, shape (3, 3)."""

    @property
    def translation(self) -> np.ndarray:
        """[m], shape (3,)."""


def keep_checked(frozen: RigidTransform, error: float) -> None:
    """Check `rotation` and `translation` of a frozen dataclass; store them as float64.

    Args:
        frozen: the dataclass.
        error: largest error of R R' - 1.

    Raises:
        ValueError: a value is not finite, or the matrix is not a rotation.
    """
    rotation, translation = (
        np.array(of, dtype=np.float64) for of in (frozen.rotation, frozen.translation)
    )
    if rotation.shape != (3, 3):
        raise ValueError(f"rotation must be a 3 x 3 matrix, not of shape {rotation.shape}")
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() < error or np.linalg.det(rotation) < 0.0:
        raise ValueError("rotation must be a proper rotation matrix (orthogonal, determinant 1)")
    if translation.shape != (3,) or not np.isfinite(translation).all():
        raise ValueError(f"translation must be 3 finite numbers, not {translation.tolist()}")
    for name, array in (("rotation", rotation), ("translation", translation)):
        array.flags.writeable = False
        object.__setattr__(frozen, name, array)


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid transformation: p becomes rotation @ p + translation.

    Args:
        rotation: proper rotation matrix, shape (3, 3).
        translation: [m], shape (3,).

    Raises:
        ValueError: a value is not finite, or the matrix is not a rotation.
    """

    rotation: np.ndarray
    translation: np.ndarray

    def __post_init__(self) -> None:
        """Check the values and store them as float64."""
        keep_checked(self, ROTATION_ERROR)

    @classmethod
    def identity(cls) -> Pose:
        """Return the identity."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def about(cls, center: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> Pose:
        """Return a rotation about a center [m], shape (3,), followed by a shift [m].

        The shift has shape (3,).
        """
        return cls(rotation, center - rotation @ center + shift)

    @classmethod
    def _of(cls, rotation: np.ndarray, translation: np.ndarray) -> Pose:
        """Return a pose without checks, which take ten times as long as making it.

        The values follow from poses that have been checked.
        """
        made = object.__new__(cls)
        for name, array in (("rotation", rotation), ("translation", translation)):
            array.flags.writeable = False
            object.__setattr__(made, name, array)
        return made

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return transformed points [m], shape (..., 3)."""
        return cast(np.ndarray, np.asarray(points) @ self.rotation.T + self.translation)

    def after(self, other: Pose) -> Pose:
        """Return the composition: (a.after(b)).apply(p) = a.apply(b.apply(p))."""
        return Pose._of(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def inverse(self) -> Pose:
        """Return the inverse transformation."""
        return Pose._of(np.array(self.rotation.T), -self.rotation.T @ self.translation)


@runtime_checkable
class Motion(Protocol):
    """Motion of a solid: pose over time."""

    def pose(self, time: float) -> Pose:
        """Return the pose at `time` [s], relative to the placement in the scene."""


@runtime_checkable
class RigidMotion(Motion, Protocol):
    """Motion of a body moved by forces: its velocity is part of a state."""

    @staticmethod
    def poses_of(motions: Sequence[Motion], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations, shape (m, n, 3, 3), and translations, shape (m, n, 3) [m].

        Poses of n such motions at m times [s].
        """

    @staticmethod
    def velocity_fields_of(motions: Sequence[Motion]) -> tuple[np.ndarray, np.ndarray]:
        """Return turns, shape (n, 3, 3) [1/s], and shifts, shape (n, 3) [m/s].

        A point x of a solid moves at turn x + shift.
        """


@dataclass(frozen=True, kw_only=True)
class Translation:
    """Constant velocity between two times, at rest before and after.

    Args:
        velocity: [m/s], 2 or 3 numbers.
        start: [s].
        stop: [s], > start; infinity: never.

    Raises:
        ValueError: a value is not finite, or start < stop does not hold.
    """

    velocity: Vector
    start: float = 0.0
    stop: float = math.inf

    def __post_init__(self) -> None:
        """Check the values, and bring the velocity into space."""
        object.__setattr__(self, "velocity", _in_space("velocity", self.velocity))
        _check_interval(self.start, self.stop)

    def pose(self, time: float) -> Pose:
        """Return the pose at `time` [s]."""
        return Pose(np.eye(3), _elapsed(time, self.start, self.stop) * np.asarray(self.velocity))


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """Constant rotation about a fixed axis between two times, else at rest.

    Args:
        rate: [degrees/s], counterclockwise seen from the axis's tip.
        center: a point of the axis [m], 2 or 3 numbers.
        axis: its direction, 3 numbers of any length but 0. Default: z.
        start: [s].
        stop: [s], > start; infinity: never.

    Raises:
        ValueError: a value is not finite, the axis is zero, or start < stop does not hold.
    """

    rate: float
    center: Vector
    axis: Vector = (0.0, 0.0, 1.0)
    start: float = 0.0
    stop: float = math.inf

    def __post_init__(self) -> None:
        """Check the values, and give the axis unit length."""
        _check_finite("rate", self.rate)
        object.__setattr__(self, "center", _in_space("center", self.center))
        object.__setattr__(self, "axis", unit("axis", _in_space("axis", self.axis)))
        _check_interval(self.start, self.stop)

    def pose(self, time: float) -> Pose:
        """Return the pose at `time` [s]."""
        degrees = self.rate * _elapsed(time, self.start, self.stop)
        return Pose.about(
            np.asarray(self.center), _turn(np.asarray(self.axis), degrees), np.zeros(3)
        )


@dataclass(frozen=True, kw_only=True)
class Sinusoid:
    """Oscillation about the placement in the scene.

    sin(2 pi time / period + phase) times an amplitude, of a shift, an angle or both.

    With phase 0 the solid passes its middle at time 0, at full speed; with -90 degrees it starts at
    rest at the far end.

    Args:
        period: [s], > 0.
        amplitude: amplitude of the shift [m], 2 or 3 numbers. Default: 0.
        phase: [degrees].
        angle: amplitude of the angle [degrees].
        center: a point of the axis of the swing [m], 2 or 3 numbers; it moves with the shift.
        axis: direction of that axis, 3 numbers of any length but 0. Default: z.

    Raises:
        ValueError: a value is not finite, the period is not positive, or the axis is zero.
    """

    period: float
    amplitude: Vector = (0.0, 0.0, 0.0)
    phase: float = 0.0
    angle: float = 0.0
    center: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check the values, and give the axis unit length."""
        if not (math.isfinite(self.period) and self.period > 0.0):
            raise ValueError(f"period must be a positive number [s], not {self.period}")
        _check_finite("phase", self.phase)
        _check_finite("angle", self.angle)
        object.__setattr__(self, "amplitude", _in_space("amplitude", self.amplitude))
        object.__setattr__(self, "center", _in_space("center", self.center))
        object.__setattr__(self, "axis", unit("axis", _in_space("axis", self.axis)))

    def pose(self, time: float) -> Pose:
        """Return the pose at `time` [s]."""
        swing = math.sin(2.0 * math.pi * time / self.period + math.radians(self.phase))
        rotation = _turn(np.asarray(self.axis), self.angle * swing)
        return Pose.about(np.asarray(self.center), rotation, swing * np.asarray(self.amplitude))


@dataclass(frozen=True, kw_only=True)
class Keyframes:
    """Poses at given times; at rest before the first and after the last.

    Between them shifts and angles are linear in time, or smooth: monotone cubics
    (Fritsch & Carlson 1980) that begin and end at rest and do not overshoot. In 3-D the turn from
    one keyframe to the next is the one about a fixed axis (slerp); when smooth, it comes to rest
    wherever that axis changes.

    Args:
        times: [s], increasing, shape (n,), n >= 2.
        translate: shifts [m], shape (n, 2) or (n, 3). Default: 0.
        rotate: [degrees]: angles about z, shape (n,), as many turns as they say; or angles about
            the fixed axes x, y, z in that order, shape (n, 3), of less than half a turn from one
            keyframe to the next.
        center: the fixed point [m] of the rotations, 2 or 3 numbers; it moves with the shifts.
        smooth: whether velocities are continuous.

    Raises:
        ValueError: times do not increase, a shape does not fit, a value is not finite, or a turn is
            ambiguous.
    """

    times: Vector
    translate: Sequence[Vector] | np.ndarray | None = None
    rotate: Sequence[float] | Sequence[Vector] | np.ndarray | None = None
    center: Vector = (0.0, 0.0, 0.0)
    smooth: bool = False
    _shift: _Curve | None = field(init=False, repr=False, compare=False)
    _turns: _RotationCurve | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the values and build the curves."""
        times = np.array(self.times, dtype=np.float64)
        if times.ndim != 1 or len(times) < 2:
            raise ValueError(f"times must be a list of at least two numbers, not {self.times}")
        if not (np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
            raise ValueError(f"times must be finite and increase, not {times.tolist()}")
        if self.translate is None and self.rotate is None:
            raise ValueError("keyframes need translate, rotate or both")
        shift = turns = None
        if self.translate is not None:
            shift = _Curve(
                times, _rows("translate", self.translate, len(times), (2, 3)), smooth=self.smooth
            )
        if self.rotate is not None:
            angles = np.array(self.rotate, dtype=np.float64)
            angles = _rows(
                "rotate", angles[:, None] if angles.ndim == 1 else angles, len(times), (1, 3)
            )
            turns = _RotationCurve(times, angles, smooth=self.smooth)
        object.__setattr__(self, "center", _in_space("center", self.center))
        object.__setattr__(self, "_shift", shift)
        object.__setattr__(self, "_turns", turns)

    def pose(self, time: float) -> Pose:
        """Return the pose at `time` [s]."""
        shift = np.zeros(3)
        if self._shift:
            value = self._shift.at(time)
            shift[: len(value)] = value
        rotation = self._turns.at(time) if self._turns else np.eye(3)
        return Pose.about(np.asarray(self.center), rotation, shift)


class Motions:
    """Motions of several solids, evaluated together.

    Args:
        motions: motions of n solids.
    """

    def __init__(self, motions: Sequence[Motion]) -> None:
        self.motions = tuple(motions)
        rigid = [isinstance(motion, RigidMotion) for motion in motions]
        kinds = dict.fromkeys(type(motion) for motion in motions if isinstance(motion, RigidMotion))
        of_kind = {
            kind: [n for n, motion in enumerate(motions) if type(motion) is kind] for kind in kinds
        }
        self._groups: list[tuple[type[RigidMotion], list[int], list[Motion]]] = [
            (kind, numbers, [motions[n] for n in numbers]) for kind, numbers in of_kind.items()
        ]
        # The common type of all motions.
        self._alone: type[RigidMotion] | None = (
            next(iter(kinds)) if len(kinds) == 1 and all(rigid) else None
        )
        self._prescribed = [n for n, is_rigid in enumerate(rigid) if not is_rigid]

    def __len__(self) -> int:
        """Return the number of motions."""
        return len(self.motions)

    def poses(self, times: Sequence[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations, shape (m, n, 3, 3), and translations, shape (m, n, 3) [m].

        Args:
            times: m of them [s].
        """
        times = np.asarray(times, dtype=np.float64)
        if self._alone is not None:
            return self._alone.poses_of(self.motions, times)
        rotations, translations = (
            np.empty((len(times), len(self), 3, 3)),
            np.empty((len(times), len(self), 3)),
        )
        for kind, numbers, members in self._groups:
            rotations[:, numbers], translations[:, numbers] = kind.poses_of(members, times)
        for number in self._prescribed:
            for m, time in enumerate(times.tolist()):
                pose = self.motions[number].pose(time)
                rotations[m, number], translations[m, number] = pose.rotation, pose.translation
        return rotations, translations

    def velocity_fields(self, time: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return turns, shape (n, 3, 3) [1/s], and shifts, shape (n, 3) [m/s].

        A point x of a solid moves at turn x + shift: its displacement from `time` on divided by the
        time dt [s] that it takes, or the velocity of the state of a `RigidMotion`.
        """
        if self._alone is not None:
            return self._alone.velocity_fields_of(self.motions)
        turns, shifts = np.empty((len(self), 3, 3)), np.empty((len(self), 3))
        for kind, numbers, members in self._groups:
            turns[numbers], shifts[numbers] = kind.velocity_fields_of(members)
        for number in self._prescribed:
            motion = self.motions[number]
            way = motion.pose(time + dt).after(motion.pose(time).inverse())
            turns[number], shifts[number] = (way.rotation - np.eye(3)) / dt, way.translation / dt
        return turns, shifts

    def top_speed(
        self,
        bounds: Sequence[np.ndarray | None] | np.ndarray,
        size: np.ndarray,
        time: float,
        span: float,
    ) -> float:
        """Return the largest future speed of a point of a solid in the domain [m/s].

        A rigid body is fastest at a corner of a box around it; velocities are means over a few
        parts of the span.

        Args:
            bounds: low and high corner [m] of a box around each solid as it is placed, shape (2,
                3); None: it has no limits. Or these in one array, see `boxes_of`.
            size: sides of the domain [m], shape (3,), z = 0 in 2-D.
            time: [s].
            span: time to look ahead [s], > 0.
        """
        if not self.motions:
            return 0.0
        n, m = len(self), SPEED_SAMPLES
        boxes = bounds if isinstance(bounds, np.ndarray) else boxes_of(bounds)
        times = PARTS * ((time + span - time) / m) + time  # as np.linspace, which is slower
        times[-1] = time + span
        R, t = self.poses(times)
        _, (fastest,) = TOP_SPEED.run((R, t, boxes, size), (), tasks=n, count=n, parts=m, span=span)
        return float(fastest.max())


def boxes_of(bounds: Sequence[np.ndarray | None]) -> np.ndarray:
    """Return boxes, shape (2, 3) each, as one array; None is an unbounded box."""
    return np.array([UNLIMITED if box is None else box for box in bounds]).reshape(-1, 2, 3)


def kinks(motion: Motion) -> tuple[float, ...]:
    """Return the times [s] at which a motion's velocity jumps.

    Only for the motions of this module.
    """
    if isinstance(motion, Keyframes):
        return () if motion.smooth else tuple(float(time) for time in motion.times)
    return (motion.start, motion.stop) if isinstance(motion, Translation | Rotation) else ()


class _Curve:
    """Values over time, constant before the first and after the last.

    Args:
        times: [s], shape (n,).
        values: shape (n, m).
        smooth: monotone cubics instead of lines.
        rests: numbers of keyframes where a smooth curve of monotone values must have slope 0.
    """

    def __init__(
        self, times: np.ndarray, values: np.ndarray, *, smooth: bool, rests: Sequence[int] = ()
    ) -> None:
        self.times, self.values = times, values
        self._spline = None
        if smooth:
            # Slopes of almost 0 give infinite weights; these belong to slopes that are 0.
            with np.errstate(over="ignore", divide="ignore"):
                if (np.abs(np.diff(values, axis=0)) > FASTEST * np.diff(times)[:, None]).any():
                    raise ValueError("times are too close to each other for a smooth motion")
                slopes = PchipInterpolator(times, values).derivative()(times)
            slopes[[0, -1, *rests]] = 0.0  # smaller slopes keep a monotone cubic monotone
            self._spline = CubicHermiteSpline(times, values, slopes)

    def at(self, time: float) -> np.ndarray:
        """Return the values at a time, shape (m,)."""
        if time <= self.times[0] or time >= self.times[-1]:
            return cast(np.ndarray, self.values[0 if time <= self.times[0] else -1])
        if self._spline is not None:
            return cast(np.ndarray, self._spline(time))
        return np.array([np.interp(time, self.times, column) for column in self.values.T])


class _RotationCurve:
    """Rotations over time, constant before the first and after the last.

    Args:
        times: [s], shape (n,).
        angles: [degrees], shape (n, 1) about z or (n, 3) about x, y, z.
        smooth: continuous angular velocities.

    Raises:
        ValueError: half a turn or more from one keyframe to the next, about x, y and z.
    """

    def __init__(self, times: np.ndarray, angles: np.ndarray, *, smooth: bool) -> None:
        self.times = times
        self._slerp = None
        if angles.shape[1] == 1:
            self._angle = _Curve(times, angles, smooth=smooth)
            return
        leaps = np.flatnonzero(np.abs(np.diff(angles, axis=0)).max(axis=1) >= 180.0)
        if len(leaps):
            first, last = angles[leaps[0]].tolist(), angles[leaps[0] + 1].tolist()
            raise ValueError(
                "rotate must change by less than 180 degrees from one keyframe to the next, not "
                f"from {first} to {last}; add one between"
            )
        # Lower case: rotations about fixed axes.
        rotations = transform.Rotation.from_euler("xyz", angles, degrees=True)
        self._slerp = transform.Slerp(np.arange(len(times)), rotations)
        steps = (rotations[1:] * rotations[:-1].inv()).as_rotvec(degrees=True)
        self._size = np.linalg.norm(steps, axis=1)
        axes = steps / np.where(self._size > 0.0, self._size, 1.0)[:, None]
        changes = np.flatnonzero((axes[1:] * axes[:-1]).sum(axis=1) < 1.0 - SAME_AXIS) + 1
        turned = np.concatenate([[0.0], np.cumsum(self._size)])
        self._angle = _Curve(times, turned[:, None], smooth=smooth, rests=changes.tolist())

    def at(self, time: float) -> np.ndarray:
        """Return the rotation matrix at a time, shape (3, 3)."""
        angle = float(self._angle.at(time)[0])
        if self._slerp is None:
            return _turn(np.array([0.0, 0.0, 1.0]), angle)
        step = int(
            np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self._size) - 1)
        )
        size = self._size[step]
        within = (angle - float(self._angle.values[step, 0])) / size if size > 0.0 else 0.0
        return cast(np.ndarray, self._slerp(step + min(max(within, 0.0), 1.0)).as_matrix())


def _turn(axis: np.ndarray, degrees: float) -> np.ndarray:
    """Return the matrix of a turn about a unit axis, shape (3, 3)."""
    return cast(
        np.ndarray,
        transform.Rotation.from_rotvec(
            math.radians(math.remainder(degrees, 360.0)) * axis
        ).as_matrix(),
    )


def _elapsed(time: float, start: float, stop: float) -> float:
    """Return the elapsed time [s] of a motion from `start` to `stop`."""
    return min(max(time, start), stop) - start


def checked_vector(name: str, value: Vector) -> tuple[float, ...]:
    """Return two or three finite numbers as an array.

    Raises:
        ValueError: there are more or fewer, or one is not finite.
    """
    numbers = tuple(float(v) for v in value)
    if len(numbers) not in (2, 3):
        raise ValueError(f"{name} needs 2 or 3 numbers, not {len(numbers)}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be finite, not {list(numbers)}")
    return numbers


def in_space(vector: Vector) -> np.ndarray:
    """Return a point or direction in space; z = 0 in 2-D."""
    return np.array([*vector, 0.0][:3])


def _in_space(name: str, value: Vector) -> tuple[float, ...]:
    return (*checked_vector(name, value), 0.0)[:3]


def unit(name: str, value: Vector) -> tuple[float, ...]:
    """Return a direction scaled to unit length.

    Raises:
        ValueError: it is zero.
    """
    direction = np.array(value)
    largest = np.abs(direction).max()
    if largest == 0.0:
        raise ValueError(f"{name} must not be zero")
    direction /= largest  # first, so that the length neither overflows nor underflows
    return tuple((direction / np.linalg.norm(direction)).tolist())


def _rows(
    name: str, value: Sequence[Vector] | np.ndarray, count: int, widths: tuple[int, ...]
) -> np.ndarray:
    """Return a table of finite numbers with one row a keyframe."""
    try:
        rows = np.array(value, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{name} must have as many numbers at every time") from error
    if rows.ndim != 2 or rows.shape[1] not in widths:
        raise ValueError(
            f"{name} must have {' or '.join(map(str, widths))} numbers at every time, not shape "
            f"{rows.shape}"
        )
    if len(rows) != count:
        raise ValueError(
            f"{name} must have an entry for each of the {count} times, not {len(rows)}"
        )
    if not np.isfinite(rows).all():
        raise ValueError(f"{name} must be finite, not {rows.tolist()}")
    return rows


def _check_finite(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, not {value}")


def _check_interval(start: float, stop: float) -> None:
    _check_finite("start", start)
    if not stop > start:
        raise ValueError(f"stop must be later than start = {start} s, not {stop}")
