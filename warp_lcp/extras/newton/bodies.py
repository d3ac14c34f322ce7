"""Bodies of a newton model in a liquid.

The newton world handles their contacts and joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import newton
import numpy as np

from warp_lcp.extras.newton.shapes import rotation_of
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import BodyMotion, BodyStates, RigidBody
from warp_lcp.rigid.mass_properties import MassProperties


class WorldBodies(RigidBodies):
    """Bodies of a newton model in a liquid, with the interface of `RigidBodies`.

    A step has no contacts.

    Args:
        model: the newton model.
        origin: origin of the liquid's coordinates in the world [m], shape (3,).
        shapes: shapes of each body by its number in the model.
        first: wall number of the first body; the others follow.

    Attributes:
        indices: numbers of the bodies in the model.
        force: forces besides gravity and liquid [N, N m], about the centers of mass, shape (n, 6).
        impulses: impulses of the liquid since this was set to zero [N s, N m s], shape (n, 6).
    """

    def __init__(
        self, model: newton.Model, origin: np.ndarray, shapes: Mapping[int, Geometry], *, first: int
    ) -> None:
        self.indices, self.dimension = np.array(list(shapes), dtype=int), 3
        self._origin, self._geometries = origin, list(shapes.values())
        self._placed = model.body_q.numpy()[self.indices].astype(np.float64)
        self._turned = [rotation_of(q[3:]) for q in self._placed]
        self.bodies = BodyStates(
            [RigidBody(p, name=model.body_label[body]) for body, p in self._properties(model)]
        )
        self.numbers = list(range(first, first + len(self.bodies)))
        self.motions = [BodyMotion(body) for body in self.bodies]
        self.refresh(model)
        self.contacts, self.contact_residual, self._surfaces = 0, 0.0, None
        self.joints = ()  # joints are part of the newton world
        self.exits = ((), 0)  # the newton world removes bodies
        self._before: np.ndarray | None = None
        self.force, self.impulses = (np.zeros((len(self.bodies), 6)) for _ in range(2))

    def refresh(self, model: newton.Model) -> None:
        """Update masses and inertias from the model.

        Bodies without mass, and kinematic ones, do not respond to impulses.
        """
        kinematic = model.body_flags.numpy()[self.indices] & newton.BodyFlags.KINEMATIC != 0
        self.prescribed = kinematic | (model.body_inv_mass.numpy()[self.indices] == 0.0)
        for body, (_, properties) in zip(self.bodies, self._properties(model), strict=True):
            body.properties = properties
        self.bodies = BodyStates(self.bodies)  # with the new masses
        self._com = model.body_com.numpy()[self.indices].astype(np.float64)

    def requested_state(
        self, poses: np.ndarray, velocities: np.ndarray, forces: np.ndarray | None, dt: float
    ) -> np.ndarray:
        """Return the inputs of a step of dt [s]: poses, and velocities after forces.

        Arguments as of `set_state`.
        """
        placed, moved = (array[self.indices].astype(np.float64) for array in (poses, velocities))
        given = (
            np.zeros_like(moved) if forces is None else dt * forces[self.indices].astype(np.float64)
        )
        for body, turned, q, v, impulse in zip(
            self.bodies, self._turned, placed, moved, given, strict=True
        ):
            rotation = rotation_of(q[3:]) @ turned.T
            v[:3] += impulse[:3] / body.properties.mass
            v[3:] += rotation @ body.properties.inverse_inertia @ rotation.T @ impulse[3:]
        return np.concatenate([placed, moved], axis=1)

    def set_state(
        self, poses: np.ndarray, velocities: np.ndarray, forces: np.ndarray | None, time: float
    ) -> bool:
        """Set the state of the world; return whether a body was moved from outside.

        That is, whether its pose differs from the one after the last step.

        Args:
            poses: poses of all bodies of the model, shape (bodies, 7).
            velocities: velocities of their centers of mass [m/s] and angular [rad/s], shape
                (bodies, 6).
            forces: forces on them [N, N m], shape (bodies, 6).
            time: time of the liquid [s].
        """
        moved = False
        self.force = (
            np.zeros((len(self.bodies), 6))
            if forces is None
            else forces[self.indices].astype(np.float64)
        )
        given = poses[self.indices].astype(np.float64), velocities[self.indices].astype(np.float64)
        for body, turned, com, q, v in zip(
            self.bodies, self._turned, self._com, *given, strict=True
        ):
            R = rotation_of(q[3:])
            position, rotation = q[:3] + R @ com - self._origin, R @ turned.T
            moved |= not (
                np.allclose(position, body.position, rtol=0.0, atol=SAME)
                and np.allclose(rotation, body.rotation, atol=SAME)
            )
            body.position, body.rotation, body.time = position, rotation, time
            body.momentum, body.angular_momentum = (
                body.properties.mass * v[:3],
                body.inertia @ v[3:],
            )
        return moved

    def give(self, poses: np.ndarray, velocities: np.ndarray) -> None:
        """Write the state of the free bodies into arrays as of `set_state` (updated)."""
        for number, index in enumerate(self.indices):
            if not self.prescribed[number]:
                body = self.bodies[number]
                R = body.rotation @ self._turned[number]
                poses[index, :3] = body.position + self._origin - R @ self._com[number]
                poses[index, 3:] = quaternion_of(R, poses[index, 3:])
                velocities[index, :3], velocities[index, 3:] = body.velocity, body.angular_velocity

    def begin_step(self, time: float, dt: float, gravity: np.ndarray, kick_dt: float) -> None:
        """Apply gravity and the world's forces for `kick_dt` [s]."""
        self.restore_step()
        self._before = self._states()
        for body, force, prescribed in zip(self.bodies, self.force, self.prescribed, strict=True):
            body.release()
            body.time = time
            if prescribed:
                body.hold = np.zeros((6, 6))
            else:
                body.accelerate(gravity, kick_dt)
                body.push(kick_dt * force)

    def solve_contacts(self) -> None:
        """Do nothing: the newton world handles contacts."""

    def end_step(self, dt: float) -> None:
        """Move and rotate the bodies."""
        self._before = None
        for body, impulse in zip(self.bodies, self.impulses, strict=True):
            impulse += body.received_impulse
        self.bodies.release()
        self.bodies.advance(dt)

    def restore_step(self) -> None:
        """Undo `begin_step`, if a step has begun."""
        if self._before is not None:
            self.bodies.restore(self._before)
            self._before = None

    def stop_reason(self, size: Sequence[float], endless: Sequence[int]) -> str | None:
        """Return the reason why the simulation cannot continue, if any.

        A body is not finite.
        """
        wrong = [body.name for body in self.bodies if not np.isfinite(body.state()).all()]
        return f"{wrong[0]} has a velocity that is not finite" if wrong else None

    def state(self) -> dict[str, np.ndarray]:
        """Return the state for `restore`."""
        return {"bodies": self._states()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from `state`."""
        self._before = None
        self.bodies.restore(np.asarray(state["bodies"]))

    def _properties(self, model: newton.Model) -> list[tuple[int, MassProperties]]:
        """Return mass, center and inertia of each body as placed in the model.

        Those of a unit ball for bodies without mass.
        """
        masses, centers, inertias = (
            getattr(model, f"body_{name}").numpy()[self.indices]
            for name in ("mass", "com", "inertia")
        )
        properties = []
        for index, R, q, mass, com, inertia in zip(
            self.indices, self._turned, self._placed, masses, centers, inertias, strict=True
        ):
            own = inertia.astype(np.float64) if mass > 0.0 else np.eye(3)
            turned = R @ (0.5 * (own + own.T)) @ R.T
            center = q[:3] + R @ com - self._origin
            properties.append(
                (
                    int(index),
                    MassProperties(
                        mass=float(mass) or 1.0, center=center, inertia=0.5 * (turned + turned.T)
                    ),
                )
            )
        return properties


SAME = 1e-6  # [m, and of a rotation's entries]: float32 accuracy of a pose


def quaternion_of(R: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the quaternion (x, y, z, w) of a rotation.

    Of the two, the one nearer to another quaternion.
    """
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(R).as_quat()
    return -q if q @ near < 0.0 else q
