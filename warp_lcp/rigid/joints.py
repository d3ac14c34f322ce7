"""Joints as rows of a velocity problem: equations, angle limits, motors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from warp_lcp.rigid.body import PLANAR, RigidBody
from warp_lcp.rigid.contacts import contact_frames, jacobian

JointKind = Literal["ball", "hinge", "fixed"]
WORLD = -1  # body number of space, for joints fixed in space
MOST_ANGLE = np.pi  # [rad]: angles are known up to a whole turn


@dataclass(frozen=True, eq=False)
class Joint:
    """Joint of two bodies at a point.

    A ball joint allows rotation about the point, a hinge about an axis, a fixed joint none. A
    hinge's angle is that of `first` relative to `second`, 0 in the initial pose. In the plane the
    axis is z, and a hinge is used as a ball joint.

    Args:
        first: a body.
        second: another body, or WORLD.
        anchor: the point as placed in the scene [m], shape (3,).
        axis: axis of a hinge, of any length, shape (3,).
        limits: least and largest angle of a hinge [rad]; infinite without limits, else within half
            a turn.
        motor_speed: target angular velocity of a hinge's motor [rad/s].
        motor_torque: largest torque of the motor [N m]; 0: no motor.
        kind: "ball", "hinge" or "fixed".

    Raises:
        ValueError: the bodies are the same, limits are crossed or too wide, the torque is negative
            or infinite, there is no axis, or a joint other than a hinge has limits or a motor.
    """

    first: int
    second: int
    anchor: np.ndarray
    axis: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 1.0)
    limits: tuple[float, float] = (-np.inf, np.inf)
    motor_speed: float = 0.0
    motor_torque: float = 0.0
    kind: JointKind = "hinge"

    def __post_init__(self) -> None:
        """Check the values, and normalize the axis."""
        if self.first == self.second or self.first < 0:
            raise ValueError(
                f"first = {self.first}, second = {self.second}: must be two bodies, or a body and "
                "WORLD"
            )
        if self.kind not in get_args(JointKind):
            raise ValueError(
                f"kind = {self.kind!r}: must be one of {', '.join(get_args(JointKind))}"
            )
        low, high = self.limits
        if not low <= high or any(
            np.isfinite(side) and abs(side) > MOST_ANGLE for side in self.limits
        ):
            raise ValueError(
                f"limits = {self.limits}: must be in order and within half a turn, in rad"
            )
        if not 0.0 <= self.motor_torque < np.inf:
            raise ValueError(f"motor_torque = {self.motor_torque}: must be >= 0 and finite, in N m")
        if self.kind != "hinge" and (self.motor_torque > 0.0 or np.isfinite(self.limits).any()):
            raise ValueError(f"kind = {self.kind!r}: only hinges have limits and motors")
        length = float(np.linalg.norm(self.axis))
        if not 0.0 < length < np.inf:
            raise ValueError(f"axis = {self.axis}: must be finite and not zero")
        object.__setattr__(self, "axis", np.asarray(self.axis, dtype=np.float64) / length)

    @property
    def pair(self) -> tuple[int, int]:
        """Pair of bodies, the smaller index first."""
        return min(self.first, self.second), max(self.first, self.second)

    def row_count(self, dimension: int) -> int:
        """Return the number of rows.

        It is the dimension (the common point) + locked rotations (0, 2 or 3 in 3-D; 0 or 1 in 2-D)
        + finite limits + 1 with a motor.
        """
        turns = (
            {"ball": 0, "hinge": 2, "fixed": 3}
            if dimension == 3
            else {"ball": 0, "hinge": 0, "fixed": 1}
        )
        return (
            dimension
            + turns[self.kind]
            + int(np.isfinite(self.limits).sum())
            + int(self.motor_torque > 0.0)
        )

    def side(
        self, bodies: Sequence[RigidBody], number: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return arm [m], anchor [m] and rotation of the joint on a body or WORLD."""
        if number == WORLD:
            return self.anchor, self.anchor, np.eye(3)
        body = bodies[number]
        arm = body.rotation @ (self.anchor - body.properties.center)
        return arm, body.position + arm, body.rotation

    def angle(self, bodies: Sequence[RigidBody]) -> float:
        """Return the hinge angle of the first body relative to the second [rad].

        In (-pi, pi], about the axis of the hinge.
        """
        R, S = (self.side(bodies, number)[2] for number in (self.first, self.second))
        # A direction perpendicular to the axis, equal for both bodies at angle 0.
        zero = contact_frames(np.asarray(self.axis)[None], 3)[0, 1]
        mine, other = R @ zero, S @ zero
        return float(np.arctan2(np.cross(other, mine) @ (R @ self.axis), other @ mine))

    def held(self, bodies: Sequence[RigidBody], dimension: int) -> np.ndarray:
        """Return the axes without relative rotation, shape (d, 3)."""
        if self.kind == "fixed":
            return np.eye(3) if dimension == 3 else np.eye(3)[2:]
        if self.kind == "ball" or dimension == 2:
            return np.zeros((0, 3))
        axis = self.side(bodies, self.first)[2] @ self.axis
        return contact_frames(axis[None], 3)[0, 1:]

    def errors(
        self, bodies: Sequence[RigidBody], locked_axes: np.ndarray, dimension: int
    ) -> np.ndarray:
        """Return the position errors of the rows (m, rad).

        Errors of equations, distances to limits, 0 for a motor.

        Point: p_first - p_second [m]. Fixed: e / 2 along the locked axes, with e the vector of
        R S' - S R' [rad]. Hinge: -(R a) x (S a) along them [rad]. Limits: angle - low and
        high - angle [rad].

        Args:
            bodies: all bodies in their current state.
            locked_axes: directions of `locked_axes`, from when the rows were built.
            dimension: 2 or 3.
        """
        (_, anchor, R), (_, other_anchor, S) = (
            self.side(bodies, number) for number in (self.first, self.second)
        )
        if self.kind == "fixed":  # R S' = 1 + [e]x for a small relative rotation e
            T = R @ S.T
            turned = locked_axes @ (
                0.5 * np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
            )
        else:
            turned = -locked_axes @ np.cross(R @ self.axis, S @ self.axis)
        angle = self.angle(bodies) if np.isfinite(self.limits).any() else 0.0
        distances = [
            side * (angle - limit)
            for side, limit in zip((1.0, -1.0), self.limits, strict=True)
            if np.isfinite(limit)
        ]
        return np.concatenate(
            [
                (anchor - other_anchor)[:dimension],
                turned,
                distances,
                [0.0] if self.motor_torque > 0.0 else [],
            ]
        )

    def rows(self, bodies: Sequence[RigidBody], dt: float, dimension: int = 3) -> JointRows:
        """Return the rows for the impulses over a time [s].

        With y = J v' + c: the anchors' relative velocity and the angular velocity about
        `locked_axes` directions are equations (y = 0, x free). For a limit, the angle's rate plus
        its distance to the limit over the step is >= 0, complementary to x >= 0. For a motor, y is
        the rate less the target rate, with |x| <= torque dt.
        """
        (arm, anchor, R), (other_arm, other_anchor, _) = (
            self.side(bodies, number) for number in (self.first, self.second)
        )
        apart, locked_axes, axis = (
            anchor - other_anchor,
            self.held(bodies, dimension),
            R @ self.axis,
        )
        # Both impulses act at one point, which conserves angular momentum.
        arm, other_arm = arm - 0.5 * apart, other_arm + 0.5 * apart
        linear = [
            np.concatenate([e, np.cross(arm, e), -e, -np.cross(other_arm, e)])
            for e in np.eye(3)[:dimension]
        ]
        sides = [
            side for side, limit in zip((1.0, -1.0), self.limits, strict=True) if np.isfinite(limit)
        ]
        motor = [axis] if self.motor_torque > 0.0 else []
        turns = [
            np.concatenate([np.zeros(3), d, np.zeros(3), -d])
            for d in (*locked_axes, *(side * axis for side in sides), *motor)
        ]
        each, equations = np.array([*linear, *turns])[:, None], len(linear) + len(locked_axes)
        columns = np.arange(6) if dimension == 3 else np.array(PLANAR)
        torque = [self.motor_torque * dt] * len(motor)
        m, n = len(each), len(bodies)
        return JointRows(
            sources=((self, locked_axes),),
            first=np.full(m, self.first),
            second=np.full(m, n if self.second == WORLD else self.second),
            one=each[..., columns],
            other=each[..., 6 + columns],
            error=self.errors(bodies, locked_axes, dimension),
            wanted=np.array([0.0] * (m - len(motor)) + [self.motor_speed] * len(motor)),
            lower=np.array(
                [-np.inf] * equations + [0.0] * len(sides) + [-value for value in torque]
            ),
            upper=np.array([np.inf] * (equations + len(sides)) + torque),
        )


@dataclass(frozen=True, eq=False)
class JointRows:
    """Rows of joints in a velocity problem y = J v' + c.

    m rows; a body has q velocities.

    Args:
        sources: the joints, each with the directions of its `Joint.held`.
        first: body of each row, shape (m,).
        second: the other body, the number of bodies for WORLD.
        one: rows for the first body, shape (m, 1, q).
        other: rows for the second body.
        error: error as of `Joint.errors`, shape (m,).
        wanted: target speed of a motor [rad/s], 0 for other rows.
        lower: least impulse [N s, N m s], -inf for equations, 0 for limits, finite for motors.
        upper: largest impulse.
    """

    sources: tuple[tuple[Joint, np.ndarray], ...]
    first: np.ndarray
    second: np.ndarray
    one: np.ndarray
    other: np.ndarray
    error: np.ndarray
    wanted: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.error)

    @classmethod
    def joined(cls, several: Sequence[JointRows]) -> JointRows:
        """Return the rows of several joints (at least one) as one object."""
        names = ("first", "second", "one", "other", "error", "wanted", "lower", "upper")
        arrays = {name: np.concatenate([vars(rows)[name] for rows in several]) for name in names}
        return cls(sources=tuple(source for rows in several for source in rows.sources), **arrays)

    def where(self, chosen: np.ndarray) -> JointRows:
        """Return selected rows, by a mask."""
        names = ("first", "second", "one", "other", "error", "wanted", "lower", "upper")
        return JointRows(self.sources, *(vars(self)[name][chosen] for name in names))

    @property
    def equations(self) -> np.ndarray:
        """Mask of rows that are equations, shape (m,)."""
        return np.isneginf(self.lower)

    @property
    def motors(self) -> np.ndarray:
        """Mask of rows of motors, shape (m,)."""
        return np.isfinite(self.upper)

    def jacobian(self, bodies: int) -> csr_array:
        """Return J for the velocities of all bodies, shape (m, bodies q)."""
        return jacobian(self.first, self.second, self.one, self.other, bodies)

    def bias(self, dt: float, rate: float = 1.0) -> np.ndarray:
        """Return c for a step of dt [s], shape (m,).

        Error to remove, distance to limits, minus the speed of a motor.

        Args:
            dt: time step [s].
            rate: fraction of an error that the step removes, in [0, 1].
        """
        part = np.where(~self.equations & (self.error > 0.0), 1.0, rate)
        return part * self.error / dt - self.wanted

    def errors(self, bodies: Sequence[RigidBody], dimension: int) -> np.ndarray:
        """Return the current errors of the rows, shape (m,)."""
        return np.concatenate(
            [joint.errors(bodies, held, dimension) for joint, held in self.sources]
        )


def joined_pairs(joints: Sequence[Joint], bodies: int) -> frozenset[tuple[int, int]]:
    """Return the pairs of bodies that do not collide, the smaller index first.

    These are bodies of a joint, and bodies of a group that fixed joints connect rigidly. Joints to
    WORLD, and other joints to a body of a group, do not exclude collisions with the rest of the
    group.

    Args:
        joints: all joints.
        bodies: number of bodies.
    """
    firm = [joint.pair for joint in joints if joint.kind == "fixed" and joint.second != WORLD]
    links = coo_array(
        (np.ones(len(firm)), np.array(firm, dtype=int).reshape(-1, 2).T), shape=(bodies, bodies)
    )
    piece = connected_components(links, directed=False)[1]
    i, j = np.nonzero(np.triu(piece[:, None] == piece, 1))
    return frozenset(joint.pair for joint in joints) | frozenset(
        zip(i.tolist(), j.tolist(), strict=True)
    )
