"""Hinges between bodies as rows of a velocity problem: five equations, limits of the angle, a motor of limited torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from warp_lcp.rigid.body import RigidBody
from warp_lcp.rigid.contacts import contact_frames, jacobian

WORLD = -1  # in the place of a body: the hinge is fixed in space
NEAR_LIMIT = 0.2  # [rad]: a limit that is farther away has no row


@dataclass(frozen=True)
class Hinge:
    """Two bodies that turn about a common axis.

    The angle is that of `first` relative to `second`, 0 as the scene places them.

    Args:
        first: a body.
        second: another one, or WORLD.
        anchor: point of the axis as the scene places it [m].
        axis: along it, of any length.
        limits: least and largest angle [rad]; infinite for none.
        motor_speed: angular velocity that the motor wants [rad/s].
        motor_torque: the most that it can do [N m]; 0 for no motor.

    Raises:
        ValueError: the bodies are the same, limits are crossed, or the torque is negative.
    """

    first: int
    second: int
    anchor: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float] = (-np.inf, np.inf)
    motor_speed: float = 0.0
    motor_torque: float = 0.0

    def __post_init__(self) -> None:
        """Check, and give the axis unit length."""
        if self.first == self.second or self.first < 0:
            raise ValueError(f"first = {self.first}, second = {self.second}: must be two bodies, or a body and WORLD")
        if not self.limits[0] <= self.limits[1]:
            raise ValueError(f"limits = {self.limits}: must be in order, in rad")
        if not self.motor_torque >= 0:
            raise ValueError(f"motor_torque = {self.motor_torque}: must be >= 0, in N m")
        object.__setattr__(self, "axis", np.asarray(self.axis, dtype=np.float64) / np.linalg.norm(self.axis))

    @property
    def pair(self) -> tuple[int, int]:
        """The bodies, the smaller index first."""
        return min(self.first, self.second), max(self.first, self.second)

    def side(self, bodies: Sequence[RigidBody], number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return how a body, or WORLD, carries the hinge now: the arm of the anchor [m], the anchor [m], and the rotation."""
        if number == WORLD:
            return self.anchor, self.anchor, np.eye(3)
        body = bodies[number]
        arm = body.rotation @ (self.anchor - body.properties.center)
        return arm, body.position + arm, body.rotation

    def angle(self, bodies: Sequence[RigidBody]) -> float:
        """Return the angle of first relative to second [rad], in (-pi, pi]."""
        R, S = (self.side(bodies, number)[2] for number in (self.first, self.second))
        zero = contact_frames(self.axis[None], 3)[0, 1]  # a direction across the axis that is the same for both at angle 0
        mine, other = R @ zero, S @ zero
        return float(np.arctan2(np.cross(other, mine) @ (R @ self.axis), other @ mine))

    def rows(self, bodies: Sequence[RigidBody], dt: float, rate: float) -> HingeRows:
        """Return its rows for a time step [s] in which `rate` of its error is removed.

        y = J v' + c: anchors' relative velocity and the angular velocity across the axis are equations (y = 0, x free); the angle's rate
        plus its distance to a limit over dt is >= 0 where x > 0; the motor's y is the rate less the wanted one, |x| <= torque dt.
        """
        (arm, anchor, R), (other_arm, other_anchor, S) = (self.side(bodies, number) for number in (self.first, self.second))
        apart, axis, other_axis = anchor - other_anchor, R @ self.axis, S @ self.axis
        arm, other_arm = arm - 0.5 * apart, other_arm + 0.5 * apart  # one point for both impulses: they keep the angular momentum
        linear = [np.concatenate([e, np.cross(arm, e), -e, -np.cross(other_arm, e)]) for e in np.eye(3)]
        across = contact_frames(axis[None], 3)[0, 1:]
        turn = np.array([np.concatenate([np.zeros(3), d, np.zeros(3), -d]) for d in (*across, axis)])
        error = np.concatenate([apart, -across @ np.cross(axis, other_axis)])
        rows, bias = [*linear, *turn[:2]], list(rate / dt * error)
        low, high = [-np.inf] * 5, [np.inf] * 5
        angle = self.angle(bodies)
        for side, limit in ((1.0, self.limits[0]), (-1.0, self.limits[1])):
            distance = side * (angle - limit)
            if distance <= NEAR_LIMIT:
                rows.append(side * turn[2])
                bias.append(distance / dt if distance > 0 else rate * distance / dt)
                low.append(0.0)
                high.append(np.inf)
        if self.motor_torque > 0:
            rows.append(turn[2])
            bias.append(-self.motor_speed)
            low.append(-self.motor_torque * dt)
            high.append(self.motor_torque * dt)
        m, n, each = len(rows), len(bodies), np.array(rows)[:, None]
        second = np.full(m, n if self.second == WORLD else self.second)
        J = jacobian(np.full(m, self.first), second, each[..., :6], each[..., 6:], n)
        return HingeRows(J, np.array(bias), np.array(low), np.array(high))


@dataclass(frozen=True, eq=False)
class HingeRows:
    """A hinge's m rows: J for the velocities of all bodies, shape (m, 6n); c, and bounds of the impulses, shape (m,)."""

    J: csr_array
    bias: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
