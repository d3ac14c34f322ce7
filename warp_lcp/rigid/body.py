"""Rigid body: state, time integration, and motion of its solid."""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from warp_lcp.grid.motion import Pose
from warp_lcp.rigid.mass_properties import MassProperties
from warp_lcp.settings import NonNegative, Part, checked

SAME_TURN = 1e-15  # [rad]: half a step's turn that no longer changes
SMALL_TURN = 1e-5  # [rad]: its third power is nothing beside 1
MOST_ROUNDS = 60  # of the fixed point; a step turns a body by far less than a radian, and each round by a factor of that less


class RigidBody:
    """Rigid body moved by forces.

    Velocities follow from the momenta, which only impulses change.

    Args:
        properties: mass, center and inertia as the scene places the body.
        name: what messages call it.
        friction: Coulomb's coefficient, >= 0.
        restitution: the part of the speed of an impact that comes back, in [0, 1].
        velocity: of the center of mass at the start [m/s], shape (3,).
        angular_velocity: at the start [rad/s], shape (3,).

    Attributes:
        position: of the center of mass [m], shape (3,).
        rotation: from where the scene placed it, shape (3, 3).
        momentum: [kg m/s], shape (3,).
        angular_momentum: about the center of mass, in the world's axes [kg m^2/s], shape (3,).
        angle: by how much it has turned about z [rad], as many turns as they are; of meaning in 2-D.
        time: of the state [s].
        hold: matrix from an impulse to the part left by contacts, shape (k, k); None: identity. See `RigidBodies.begin_step`.
        given: impulses since `hold` was set, as they were given, shape (6,): force and torque.

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
        """Place the body where the scene does."""
        self.friction, self.restitution = checked("friction", friction, NonNegative), checked("restitution", restitution, Part)
        self.properties, self.name = properties, name
        self.position, self.rotation = properties.center.copy(), np.eye(3)
        self.momentum = properties.mass * _three(velocity)
        self.angular_momentum = properties.inertia @ _three(angular_velocity)
        self.angle, self.time = 0.0, 0.0
        self.hold: np.ndarray | None = None
        self.given = np.zeros(6)

    @property
    def velocity(self) -> np.ndarray:
        """Velocity of the center of mass [m/s], shape (3,)."""
        return self.momentum / self.properties.mass

    @property
    def angular_velocity(self) -> np.ndarray:
        """Angular velocity in the world's axes [rad/s], shape (3,)."""
        return self._spin(self.rotation)

    @property
    def inertia(self) -> np.ndarray:
        """Inertia tensor about the center of mass, current orientation [kg m^2].

        Shape (3, 3).
        """
        return cast(np.ndarray, self.rotation @ self.properties.inertia @ self.rotation.T)

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy of translation and rotation [J]."""
        return 0.5 * float(self.momentum @ self.velocity + self.angular_momentum @ self.angular_velocity)

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
        """Return the velocity per impulse, shape (k, k), positive semi-definite.

        Symmetric.

        That is block diag(1/m, I^-1), less what contacts with walls take while they hold the body (between `RigidBodies.begin_step` and
        `end_step`): 0 along directions in which it cannot move.
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
        self.momentum = self.momentum + self.properties.mass * dt * np.asarray(gravity, dtype=np.float64)

    def apply_impulse(self, impulse: np.ndarray) -> None:
        """Apply an impulse and an angular impulse, less the part that walls take.

        Shape (k,) [N s, N m s].
        """
        impulse = np.asarray(impulse, dtype=np.float64)
        self.given = self.given + in_space(impulse)
        self.push(impulse if self.hold is None else self.hold @ impulse)

    def push(self, impulse: np.ndarray) -> None:
        """Apply an impulse and an angular impulse without regard to contacts.

        Shape (k,) [N s, N m s].
        """
        six = in_space(impulse)
        self.momentum = self.momentum + six[:3]
        self.angular_momentum = self.angular_momentum + six[3:]

    def advance(self, dt: float) -> None:
        """Move along the velocities for dt [s]; momenta are constant."""
        self.position, self.rotation = self.after(dt)
        self.angle += dt * float(self.angular_velocity[2])
        self.time += dt

    def shift(self, way: np.ndarray) -> None:
        """Move by a small displacement (m, rad), shape (k,), without velocity."""
        six = in_space(way)
        self.position = self.position + six[:3]
        self.rotation = rotation_by(six[3:]) @ self.rotation
        self.angle += float(six[5])

    def after(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position [m] and rotation after dt [s] at the present momenta.

        The turn is about the angular velocity in the middle of the step, whose inertia is that of half the turn (the implicit midpoint
        rule on rotations): angular momentum is kept exactly, and the energy of a free rotation does not drift, as the rule is its own
        inverse backwards in time.
        """
        half = 0.5 * dt * self.angular_velocity
        for _ in range(MOST_ROUNDS):
            before = half
            half = 0.5 * dt * self._spin(rotation_by(half) @ self.rotation)
            if np.abs(half - before).max() <= SAME_TURN:
                break
        u, _, vt = np.linalg.svd(rotation_by(2.0 * half) @ self.rotation)  # the nearest rotation: rounding does not pile up
        return self.position + dt * self.velocity, u @ vt

    def state(self) -> np.ndarray:
        """Return the complete state, shape (20,)."""
        return np.concatenate(
            [self.position, self.rotation.ravel(), self.momentum, self.angular_momentum, [self.angle, self.time]]
        )  # fmt: skip

    def restore(self, state: np.ndarray) -> None:
        """Restore `state`; no contact holds the body."""
        self.position, self.rotation = state[:3].copy(), state[3:12].reshape(3, 3).copy()
        self.momentum, self.angular_momentum = state[12:15].copy(), state[15:18].copy()
        self.angle, self.time = float(state[18]), float(state[19])
        self.release()

    def momenta(self) -> tuple[np.ndarray, ...]:
        """Return the momenta, for `restore_momenta`."""
        return self.momentum, self.angular_momentum, self.given

    def restore_momenta(self, kept: tuple[np.ndarray, ...]) -> None:
        """Restore the momenta: undo all impulses since `momenta`."""
        self.momentum, self.angular_momentum, self.given = kept

    def release(self) -> None:
        """Reset contacts that hold the body and the impulses received."""
        self.hold, self.given = None, np.zeros(6)

    def _spin(self, rotation: np.ndarray) -> np.ndarray:
        """Return R I^-1 R' L [rad/s]."""
        return cast(np.ndarray, rotation @ (self.properties.inverse_inertia @ (rotation.T @ self.angular_momentum)))


class BodyMotion:
    """Motion of a body's solid; implements `warp_lcp.grid.motion.Motion`.

    Args:
        body: which.
    """

    def __init__(self, body: RigidBody) -> None:
        self.body = body

    def pose(self, time: float) -> Pose:
        """Return the pose at a time [s].

        At the time of the body's state its pose, later the one after the present velocities.
        """
        body = self.body
        position, rotation = (body.position, body.rotation) if time == body.time else body.after(time - body.time)
        center = body.properties.center
        return Pose.about(center, rotation, position - center)

    def velocity_field(self) -> tuple[np.ndarray, np.ndarray]:
        """Return turn, shape (3, 3) [1/s], and shift, shape (3,) [m/s].

        The body's point x moves at turn x + shift now.
        """
        turn = _cross(*self.body.angular_velocity)
        return turn, self.body.velocity - turn @ self.body.position


AXES = [0, 1, 2]
PLANAR = [0, 1, 5]  # vx, vy, wz among the six


def in_space(values: np.ndarray) -> np.ndarray:
    """Return a vector of three (2-D) or six entries as one of six."""
    if len(values) == 6:
        return np.asarray(values, dtype=np.float64)
    six = np.zeros(6)
    six[PLANAR] = values
    return six


def rotation_by(vector: np.ndarray) -> np.ndarray:
    """Return the matrix of a rotation by |vector| [rad] about a vector.

    Not SciPy's `Rotation.from_rotvec`: the results of runs depend on the last bits.
    """
    x, y, z = vector.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    K = _cross(x, y, z)
    if angle < SMALL_TURN:
        return cast(np.ndarray, np.eye(3) + K + 0.5 * K @ K)
    return cast(np.ndarray, np.eye(3) + math.sin(angle) / angle * K + 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2 * K @ K)


def _cross(x: float, y: float, z: float) -> np.ndarray:
    """Return the matrix of the cross product with a vector."""
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _three(vector: np.ndarray | None) -> np.ndarray:
    return np.zeros(3) if vector is None else np.array(vector, dtype=np.float64)
