"""Rigid body: state, time integration, and motion of its solid."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from operator import is_
from pathlib import Path
from typing import cast, overload

import numpy as np

from warp_lcp.grid.motion import Pose
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.host_kernel import HostKernel
from warp_lcp.rigid.mass_properties import MassProperties
from warp_lcp.settings import NonNegative, Part, checked

# Limit of the fixed-point iteration. A step rotates a body by far less than a radian, and each
# round reduces the error by that angle.
MOST_ROUNDS = 60
STATE, VALUES = 20, 26  # numbers of a body's state, and with the impulses received
# Columns of the state.
POSITION, ROTATION, MOMENTUM, SPINNING = slice(0, 3), slice(3, 12), slice(12, 15), slice(15, 18)
ANGLE, TIME, GIVEN = 18, 19, slice(20, 26)
UNIT, EPSILON = np.eye(3), float(np.finfo(np.float64).eps)
# v @ CROSS are the entries of the matrix of v x.
CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1).reshape(3, 9)
NO_TIMES = np.zeros(0)
AXES = [0, 1, 2]
PLANAR = [0, 1, 5]  # vx, vy, wz among the six
KERNELS = KernelFile(Path(__file__).parent / "headers/motion.h", {"MOST_ROUNDS": MOST_ROUNDS})
ADVANCE, POSES = (
    HostKernel(KERNELS[f"warp_lcp.rigid.motion.{name}"]) for name in ("advance", "poses")
)


def _part(columns: slice, shape: tuple[int, ...] = (-1,)) -> property:
    """Return the property of a vector or matrix in a body's values.

    It is read as a copy, and written by assignment.
    """

    def read(body: RigidBody) -> np.ndarray:
        part = body.values[columns].reshape(shape).copy()
        part.flags.writeable = False
        return part

    def write(body: RigidBody, new: np.ndarray) -> None:
        body.values[columns] = np.ravel(new)

    return property(read, write)


def _number(column: int) -> property:
    """Return the property of a number in a body's values."""

    def write(body: RigidBody, new: float) -> None:
        body.values[column] = new

    return property(lambda body: float(body.values[column]), write)


class RigidBody:
    """Rigid body moved by forces.

    Velocities follow from the momenta, which only impulses change.

    Args:
        properties: mass, center and inertia of the body as placed in the scene.
        name: name in messages.
        friction: Coulomb's coefficient, >= 0.
        restitution: ratio of the speeds after and before an impact, in [0, 1].
        velocity: initial velocity of the center of mass [m/s], shape (3,).
        angular_velocity: initial angular velocity [rad/s], shape (3,).

    Attributes:
        values: all variables except `hold`, shape (26,); a row of `BodyStates` if the body belongs
            to one. The attributes below return copies, which must not be modified; assign a new
            value.
        position: position of the center of mass [m], shape (3,).
        rotation: rotation relative to the scene's placement, shape (3, 3).
        momentum: [kg m/s], shape (3,).
        angular_momentum: about the center of mass, in the world's axes [kg m^2/s], shape (3,).
        angle: rotation angle about z [rad], including full turns; meaningful in 2-D.
        time: time of the state [s].
        hold: matrix that maps an impulse to the part that contacts do not absorb, shape (k, k);
            None for the identity. See `RigidBodies.begin_step`.
        given: sum of the impulses since `hold` was set, including the parts that contacts absorb,
            shape (6,): [N s, N m s].

    Raises:
        ValueError: friction or restitution is out of range.
    """

    def __init__(
        self,
        properties: MassProperties,
        *,
        name: str,
        friction: float = 0.5,
        restitution: float = 0.0,
        velocity: np.ndarray | None = None,
        angular_velocity: np.ndarray | None = None,
    ) -> None:
        """Place the body as in the scene."""
        self.friction, self.restitution = (
            checked("friction", friction, NonNegative),
            checked("restitution", restitution, Part),
        )
        self.properties, self.name = properties, name
        self.values = np.zeros(VALUES)
        self.states: BodyStates | None = None  # the `BodyStates` of which `values` is a row
        self.position, self.rotation = properties.center, np.eye(3)
        self.momentum = properties.mass * _three(velocity)
        self.angular_momentum = properties.inertia @ _three(angular_velocity)
        self.hold: np.ndarray | None = None

    position = _part(POSITION)
    rotation = _part(ROTATION, (3, 3))
    momentum = _part(MOMENTUM)
    angular_momentum = _part(SPINNING)
    angle = _number(ANGLE)
    time = _number(TIME)
    received_impulse = _part(GIVEN)

    @property
    def velocity(self) -> np.ndarray:
        """Velocity of the center of mass [m/s], shape (3,)."""
        return self.momentum / self.properties.mass

    @property
    def angular_velocity(self) -> np.ndarray:
        """Angular velocity in the world's axes [rad/s], shape (3,)."""
        return spins(self.rotation, self.properties.inverse_inertia, self.angular_momentum)

    @property
    def inertia(self) -> np.ndarray:
        """Inertia tensor about the center of mass, current orientation [kg m^2].

        Shape (3, 3).
        """
        return cast(np.ndarray, self.rotation @ self.properties.inertia @ self.rotation.T)

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy of translation and rotation [J]."""
        return 0.5 * float(
            self.momentum @ self.velocity + self.angular_momentum @ self.angular_velocity
        )

    def potential_energy(self, gravity: np.ndarray) -> float:
        """Return the potential energy [J], 0 at the origin.

        Gravity [m/s^2] has shape (3,).
        """
        return -self.properties.mass * float(self.position @ gravity)

    def free_inverse_mass(self, dimension: int) -> np.ndarray:
        """Return block diag(1/m, I^-1), shape (k, k).

        k = 3 in 2-D (vx, vy, wz), 6 in 3-D (vx, vy, vz, wx, wy, wz).
        """
        result, R = np.zeros((6, 6)), self.rotation
        result[AXES, AXES] = 1.0 / self.properties.mass
        turned = R @ self.properties.inverse_inertia @ R.T
        result[3:, 3:] = 0.5 * (turned + turned.T)
        return result if dimension == 3 else result[PLANAR][:, PLANAR]

    def inverse_mass(self, dimension: int) -> np.ndarray:
        """Return the velocity per impulse, shape (k, k).

        Symmetric and positive semi-definite: block diag(1/m, I^-1), without the directions that
        contacts with walls block while they support the body (between `RigidBodies.begin_step` and
        `end_step`). It is 0 along directions in which the body cannot move.
        """
        free = self.free_inverse_mass(dimension)
        if self.hold is None:
            return free
        held = free @ self.hold
        return cast(np.ndarray, 0.5 * (held + held.T))

    def velocities(self, dimension: int) -> np.ndarray:
        """Return (vx, vy, wz) in 2-D, (vx, vy, vz, wx, wy, wz) in 3-D [m/s, rad/s]."""
        both = np.concatenate([self.velocity, self.angular_velocity])
        return both if dimension == 3 else both[PLANAR]

    def accelerate(self, gravity: np.ndarray, dt: float) -> None:
        """Apply gravity [m/s^2], shape (3,), for dt [s]."""
        self.momentum = self.momentum + self.properties.mass * dt * np.asarray(
            gravity, dtype=np.float64
        )

    def apply_impulse(self, impulse: np.ndarray) -> None:
        """Apply an impulse and an angular impulse, without the part that walls absorb.

        Shape (k,) [N s, N m s].
        """
        impulse = np.asarray(impulse, dtype=np.float64)
        self.received_impulse = self.received_impulse + in_space(impulse)
        self.push(impulse if self.hold is None else self.hold @ impulse)

    def push(self, impulse: np.ndarray) -> None:
        """Apply an impulse and an angular impulse regardless of contacts.

        Shape (k,) [N s, N m s].
        """
        six = in_space(impulse)
        self.momentum = self.momentum + six[:3]
        self.angular_momentum = self.angular_momentum + six[3:]

    def advance(self, dt: float) -> None:
        """Move along the velocities for dt [s]; momenta are constant."""
        advance_states(
            self.values[None], np.array([self.properties.mass]), self.properties.inverse_inertia, dt
        )

    def shift(self, way: np.ndarray) -> None:
        """Move by a small displacement (m, rad), shape (k,), without velocity."""
        shift_states(self.values[None], in_space(way)[None])

    def after(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position [m] and rotation after dt [s] at the present momenta."""
        later = copy(self)
        later.values = self.values.copy()
        later.advance(dt)
        return later.position, later.rotation

    def state(self) -> np.ndarray:
        """Return the complete state, shape (20,)."""
        return self.values[:STATE].copy()

    def restore(self, state: np.ndarray) -> None:
        """Restore `state`, without contacts that support the body."""
        self.values[:STATE] = state
        self.release()

    def release(self) -> None:
        """Remove the supports of the body, and reset the impulses received."""
        self.hold, self.received_impulse = None, np.zeros(6)


class BodyStates(Sequence[RigidBody]):
    """States of several bodies in one array.

    Args:
        bodies: the bodies, whose states become rows of the array. A body belongs to one
            `BodyStates` at a time, the last one created.

    Attributes:
        values: values of all bodies, shape (n, 26); its views below have shapes (n, 3), (n, 3, 3),
            (n,) and (n, 6).
        mass: masses at the creation of the object [kg], shape (n,).
        center: centers of mass as placed in the scene [m], shape (n, 3).
        inverse_inertia: inverse inertias as placed in the scene [1/(kg m^2)], shape (n, 3, 3).
    """

    def __init__(self, bodies: Sequence[RigidBody]) -> None:
        self._bodies = tuple(bodies)
        self.values = np.array([body.values for body in bodies]).reshape(-1, VALUES)
        for body, row in zip(self._bodies, self.values, strict=True):
            body.values, body.states = row, self
        each = [body.properties for body in bodies]
        self.mass = np.array([properties.mass for properties in each])
        self.center = np.array([properties.center for properties in each]).reshape(-1, 3)
        self.inverse_inertia = np.array(
            [properties.inverse_inertia for properties in each]
        ).reshape(-1, 3, 3)
        self.position, self.momentum, self.angular_momentum = (
            self.values[:, part] for part in (POSITION, MOMENTUM, SPINNING)
        )
        self.rotation, self.received_impulse = (
            self.values[:, ROTATION].reshape(-1, 3, 3),
            self.values[:, GIVEN],
        )
        self.angle, self.time = self.values[:, ANGLE], self.values[:, TIME]

    @classmethod
    def of(cls, bodies: Sequence[RigidBody]) -> BodyStates:
        """Return bodies with their states in one array; no copy if they already are."""
        return bodies if isinstance(bodies, cls) else cls(bodies)

    def __len__(self) -> int:
        """Return the number of bodies."""
        return len(self._bodies)

    @overload
    def __getitem__(self, number: int) -> RigidBody: ...

    @overload
    def __getitem__(self, number: slice) -> tuple[RigidBody, ...]: ...

    def __getitem__(self, number: int | slice) -> RigidBody | tuple[RigidBody, ...]:
        """Return a body, or several."""
        return self._bodies[number]

    def copied(self) -> BodyStates:
        """Return copies of the bodies, for trial motions."""
        return BodyStates([copy(body) for body in self])

    def velocities(self) -> np.ndarray:
        """Return linear and angular velocities [m/s, rad/s], shape (n, 6)."""
        spin = spins(self.rotation, self.inverse_inertia, self.angular_momentum)
        return np.concatenate([self.momentum / self.mass[:, None], spin], axis=1)

    def momenta(self) -> np.ndarray:
        """Return momenta, angular momenta and impulses received, shape (n, 12), a copy."""
        return np.concatenate([self.momentum, self.angular_momentum, self.received_impulse], axis=1)

    def restore_momenta(self, momenta: np.ndarray) -> None:
        """Restore `momenta`: undo all impulses since then."""
        self.momentum[:], self.angular_momentum[:] = momenta[:, :3], momenta[:, 3:6]
        self.received_impulse[:] = momenta[:, 6:]

    def inverse_masses(self, dimension: int) -> np.ndarray:
        """Return `RigidBody.inverse_mass` of all, shape (n, k, k).

        It is block diag(1/m, R I^-1 R') times the matrix `hold` of supported bodies, symmetrized
        against rounding.
        """
        if dimension == 2:
            # The last row of R I^-1 R', of which a plane needs only zz.
            across = self.rotation[:, 2:]
            result = np.zeros((len(self), 3, 3))
            result[:, 0, 0] = result[:, 1, 1] = 1.0 / self.mass
            result[:, 2, 2] = (across @ self.inverse_inertia @ across.swapaxes(-1, -2))[:, 0, 0]
        else:
            turned = self.rotation @ self.inverse_inertia @ self.rotation.swapaxes(-1, -2)
            result = np.zeros((len(self), 6, 6))
            result[:, AXES, AXES] = 1.0 / self.mass[:, None]
            result[:, 3:, 3:] = 0.5 * (turned + turned.swapaxes(-1, -2))
        for free, body in zip(result, self, strict=True):
            if body.hold is not None:
                held = free @ body.hold
                free[:] = 0.5 * (held + held.T)
        return result

    def apply_impulses(self, impulses: np.ndarray) -> None:
        """Apply impulses, without the parts that walls absorb.

        Shape (n, k) [N s, N m s]; as `RigidBody.apply_impulse` of each body.
        """
        self.received_impulse += in_space(impulses)
        if all(body.hold is None for body in self._bodies):
            self.push(impulses)
            return
        held = [
            impulse if body.hold is None else body.hold @ impulse
            for body, impulse in zip(self, impulses, strict=True)
        ]
        self.push(np.array(held).reshape(impulses.shape))

    def push(self, impulses: np.ndarray) -> None:
        """Add impulses [N s] and angular impulses [N m s], shape (n, k)."""
        six = in_space(impulses)
        self.momentum += six[:, :3]
        self.angular_momentum += six[:, 3:]

    def advance(self, dt: float) -> None:
        """Move all bodies along their velocities for dt [s]."""
        advance_states(self.values, self.mass, self.inverse_inertia, dt)

    def shift(self, ways: np.ndarray) -> None:
        """Move bodies by small displacements (m, rad), shape (n, k), without velocity."""
        shift_states(self.values, in_space(ways))

    def restore(self, states: np.ndarray) -> None:
        """Restore states, shape (n, 20), without supports."""
        self.values[:, :STATE] = states
        self.release()

    def release(self) -> None:
        """Remove the supports of all bodies, and reset the impulses received."""
        self.received_impulse[:] = 0.0
        for body in self:
            body.hold = None


class BodyMotion:
    """Motion of a body's solid; implements `warp_lcp.grid.motion.Motion`.

    Args:
        body: the body.
    """

    def __init__(self, body: RigidBody) -> None:
        self.body = body

    def pose(self, time: float) -> Pose:
        """Return the pose at a time [s].

        At the time of the body's state it is the current pose; later it is the one at the current
        velocities.
        """
        body = self.body
        position, rotation = (
            (body.position, body.rotation) if time == body.time else body.after(time - body.time)
        )
        center = body.properties.center
        return Pose.about(center, rotation, position - center)

    @staticmethod
    def poses_of(motions: Sequence[BodyMotion], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations, shape (m, n, 3, 3), and translations, shape (m, n, 3) [m].

        Poses of n bodies at m times [s], see `pose`.
        """
        n, m = len(motions), len(times)
        reals = _moved(motions, times)
        begin, middle, end = 39 * n + m, 39 * n + m + 9 * m * n, 39 * n + m + 12 * m * n
        return reals[begin:middle].reshape(m, n, 3, 3).copy(), reals[middle:end].reshape(
            m, n, 3
        ).copy()

    @staticmethod
    def velocity_fields_of(motions: Sequence[BodyMotion]) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity fields: rotation (n, 3, 3) [1/s], shift (n, 3) [m/s].

        The current velocity of a body's point x is rotation x + shift.
        """
        n = len(motions)
        reals = _moved(motions, NO_TIMES)
        return reals[39 * n : 48 * n].reshape(n, 3, 3).copy(), reals[48 * n : 51 * n].reshape(
            n, 3
        ).copy()


def _moved(motions: Sequence[BodyMotion], times: np.ndarray) -> np.ndarray:
    """Run the kernel `poses`, and return its memory.

    Rotations and translations at m times start at 39 n + m, followed by rotation rates and shifts.
    """
    n, m = len(motions), len(times)
    reals, _ = POSES.run(
        (*_held(motions), times), (), tasks=n, work=12 * n * (m + 1), count=n, times=m
    )
    return reals


def _held(motions: Sequence[BodyMotion]) -> tuple[np.ndarray, ...]:
    """Return values, masses, inverse inertias and centers of the bodies."""
    bodies, states = [motion.body for motion in motions], motions[0].body.states
    if states is not None and len(states) == len(bodies) and all(map(is_, bodies, states)):
        return states.values, states.mass, states.inverse_inertia, states.center
    each, values = [body.properties for body in bodies], np.array([body.values for body in bodies])
    return (
        values,
        np.array([of.mass for of in each]),
        np.array([of.inverse_inertia for of in each]),
        np.array([of.center for of in each]),
    )


def in_space(values: np.ndarray) -> np.ndarray:
    """Return vectors of 3 (2-D) or 6 entries as vectors of 6, shape (..., k)."""
    values = np.asarray(values, dtype=np.float64)
    if values.shape[-1] == 6:
        return values
    six = np.zeros((*values.shape[:-1], 6))
    six[..., PLANAR] = values
    return six


def spins(rotation: np.ndarray, inverse_inertia: np.ndarray, momentum: np.ndarray) -> np.ndarray:
    """Return angular velocities R I^-1 R' L [rad/s], shape (..., 3)."""
    return np.asarray(
        rotation @ (inverse_inertia @ (rotation.swapaxes(-1, -2) @ momentum[..., None]))
    )[..., 0]


def advance_states(
    values: np.ndarray, mass: np.ndarray, inverse_inertia: np.ndarray, dt: float | np.ndarray
) -> None:
    """Move bodies along their velocities for dt [s]; `values` are updated.

    The rotation is about the angular velocity in the middle of the step, with the inertia after
    half of the rotation (the implicit midpoint rule on rotations). Angular momentum is conserved
    exactly, and the energy of a free rotation does not drift, since the rule is symmetric in time.
    With w = R I^-1 R' L it is the fixed point of h <- dt/2 w(exp(h) R), iterated for each body
    separately.

    Args:
        values: rows of `RigidBody.values`, shape (n, 26).
        mass: [kg], shape (n,).
        inverse_inertia: shape (n, 3, 3), or (3, 3) for all.
        dt: time [s], or one for each, shape (n,).
    """
    count = len(values)
    inverse = (
        inverse_inertia
        if inverse_inertia.ndim == 3
        else np.broadcast_to(inverse_inertia, (count, 3, 3))
    )
    each = dt if isinstance(dt, np.ndarray) else np.full(count, dt)
    reals, _ = ADVANCE.run((values, mass, inverse, each), (), tasks=count, count=count)
    values[:] = reals[: values.size].reshape(values.shape)


def shift_states(values: np.ndarray, ways: np.ndarray) -> None:
    """Move bodies by small displacements (m, rad), shape (n, 6), without velocity."""
    values[:, POSITION] += ways[:, :3]
    values[:, ROTATION] = (
        rotation_by(ways[:, 3:]) @ values[:, ROTATION].reshape(-1, 3, 3)
    ).reshape(-1, 9)
    values[:, ANGLE] += ways[:, 5]


def rotation_by(vector: np.ndarray) -> np.ndarray:
    """Return matrices of rotations by |v| [rad] about vectors v, shape (..., 3).

    With K x = v x x the matrix is 1 + sin(a) / a K + (sin(a/2) / (a/2))^2 K^2 / 2, a = |v|. It
    equals SciPy's `Rotation.from_rotvec` to rounding.
    """
    angle = np.sqrt(np.square(vector).sum(axis=-1))[..., None, None] / np.pi
    K = cross_matrix(vector)
    return np.asarray(UNIT + _sinc(angle) * K + (0.5 * _sinc(0.5 * angle) ** 2 * K) @ K)


def _sinc(x: np.ndarray) -> np.ndarray:
    """Return sin(pi x) / (pi x).

    As `np.sinc`, whose type checks take as long as the sine.
    """
    y = np.pi * x
    y = np.where(y, y, EPSILON)
    return np.asarray(np.sin(y) / y)


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors, shapes (..., 3).

    As `np.linalg.norm`, whose checks take longer.
    """
    return np.asarray(np.sqrt(np.add.reduce(np.square(vectors), axis=-1)))


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the matrices of the cross product with vectors, shape (..., 3)."""
    return (vector @ CROSS).reshape(*vector.shape, 3)


def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return cross products of vectors, shapes (..., 3).

    As `np.cross`, whose checks take ten times as long.
    """
    result = np.empty(np.broadcast_shapes(one.shape, other.shape))
    for axis, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        result[..., axis] = one[..., j] * other[..., k] - one[..., k] * other[..., j]
    return result


def _three(vector: np.ndarray | None) -> np.ndarray:
    return np.zeros(3) if vector is None else np.array(vector, dtype=np.float64)
