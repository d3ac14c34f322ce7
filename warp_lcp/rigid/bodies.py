"""Rigid bodies of a scene: time step with contacts and joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_lcp.grid.grid_part import ONE_PROCESS
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.rigid.body import STATE, BodyMotion, BodyStates, RigidBody, lengths
from warp_lcp.rigid.contact_detection import ContactDetection
from warp_lcp.rigid.contact_shape import ContactShape
from warp_lcp.rigid.contact_solve import Contacts, ContactSolve, ImpulseSolver, sweeps_and_newton
from warp_lcp.rigid.joints import Joint
from warp_lcp.rigid.obstacles import Obstacle
from warp_lcp.rigid.outline import BodySurface, body_surface

OUTSIDE = 3.0  # distance of a removed body's center from the domain, times its reach
IN_PLANE = ("x", "y", "vx", "vy", "angle", "spin")
IN_SPACE = ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")


@dataclass(frozen=True)
class _StepStart:
    """Values of `begin_step` that the rest of the step needs.

    Args:
        states: states of the bodies before the step.
        free: momenta without contacts, shape (n, 6).
        supported: momenta with contacts, without the material, shape (n, 6).
        contacts: contacts of the bodies.
        impulses: impulses of the contacts without the material; once `settled` is set, including
            it.
        detour: displacement errors of the bodies in the step due to impacts.
        dt: length of the step [s].
        kick_dt: time that gravity acts [s].
        settled: whether contacts have been solved with the impulses of the material.
    """

    states: np.ndarray
    free: np.ndarray
    supported: np.ndarray
    contacts: Contacts
    impulses: np.ndarray
    detour: np.ndarray | None
    dt: float
    kick_dt: float
    settled: bool = False


class RigidBodies:
    """Rigid bodies of a scene, moved by material, walls and each other.

    A step is `begin_step`, the material's solve with `RigidBody.apply_impulse`, and `end_step`, or
    `restore_step` if the solve fails. `begin_step` computes the velocities V* that contacts allow
    without the material. `end_step` starts again from gravity and the material's impulses and
    solves for the contacts once more, since the loads on walls have changed.

    Args:
        bodies: in the order of their solids.
        geometries: the shape of each body as placed in the scene.
        numbers: the wall number of each body, 1 + the index of its solid.
        obstacles: walls and solids in contact with bodies.
        dimension: 2 or 3.
        solver: solver for the impulses of contacts and joints; the default handles only contacts.
        joints: between the bodies, numbered as in `bodies`; restitution must be 0 with them.
        ranks: processes that share the bodies, see `warp_lcp.distributed.ranks.Ranks`. Each one has
            all bodies and computes the same steps; `begin_step`, `solve_contacts` and `end_step`
            are collective.

    Attributes:
        motions: a `BodyMotion` of each body, for the solids.
        time: time of the state [s].
        contacts: number of contact points in the last step.
        contact_residual: residual of the last contact problem, relative to that of no impulses.
        contact_iterations: iterations of its solve.
        exits: open sides of the domain for bodies: its size [m], and bits of
            `warp_lcp.grid.domain_sides.side_bits`. A body whose center of mass has crossed one is
            removed for good: at rest outside, without contacts, in no frame.
        material: whether a material can move the bodies; else contacts that support them are not
            tracked.

    Raises:
        ValueError: a body is not wholly inside the domain, or overlaps another body or a solid.
    """

    _columns: tuple[str, ...] | None = None  # log columns, built at the first use

    def __init__(
        self,
        bodies: Sequence[RigidBody],
        geometries: Sequence[Geometry],
        numbers: Sequence[int],
        obstacles: Sequence[Obstacle],
        dimension: int,
        solver: ImpulseSolver = sweeps_and_newton,
        joints: Sequence[Joint] = (),
        ranks: Any = ONE_PROCESS,
    ) -> None:
        """Prepare the shapes for contact, and check that bodies start apart."""
        self._ranks = ranks
        self.bodies, self.numbers, self.dimension = BodyStates.of(bodies), list(numbers), dimension
        self.motions = [BodyMotion(body) for body in self.bodies]
        self._geometries = list(geometries)
        self.shapes = [ContactShape.of(geometry, dimension) for geometry in geometries]
        self._solve = ContactSolve(
            ContactDetection(self.bodies, self.shapes, obstacles, dimension), solver, joints
        )
        self.joints = self._solve.joints
        self._surfaces: list[BodySurface] | None = None
        self._begun: _StepStart | None = None
        self.contacts, self.contact_residual, self.contact_iterations = 0, 0.0, 0
        self.exits: tuple[Sequence[float], int] = ((), 0)
        self.material = True
        self._solve.check_start(self.time)

    @property
    def time(self) -> float:
        """Time of the state [s]."""
        return self.bodies[0].time

    def begin_step(self, time: float, dt: float, gravity: np.ndarray, kick_dt: float) -> None:
        """Apply gravity and contacts; fix supported bodies against walls and solids.

        These are the domain's walls, moving solids and fixed solids. Along supported directions a
        body does not respond to impulses of the material (see `RigidBody.inverse_mass`): for the
        material, a body on the floor is like the floor. `solve_contacts` updates which contacts
        support bodies.

        Args:
            time: time of the state [s].
            dt: time step [s], > 0.
            gravity: [m/s^2], shape (3,).
            kick_dt: time that gravity acts [s].
        """
        self.restore_step()
        gravity = np.asarray(gravity, dtype=np.float64)
        self.bodies.time[:] = time
        states, gone = self._states(), self.gone()
        contacts = self._solve.find(time, dt, gravity, gone)
        approach = self._solve.approach(contacts)
        self.bodies.release()
        self.bodies.momentum[~gone] += (self.bodies.mass * kick_dt)[~gone, None] * gravity
        before = self._solve.bounce(contacts, approach, dt, kick_dt, gravity)
        free = self._momenta()
        impulses = self._solve.push_apart(contacts, dt=dt, kick_dt=kick_dt)
        if self.material:
            self._solve.absorb_impulses(contacts, impulses)
        self.contact_residual, self.contact_iterations = (
            self._solve.residual,
            self._solve.iterations,
        )
        self._begun = _StepStart(
            states,
            free,
            self._momenta(),
            contacts,
            impulses,
            self._solve.detour(contacts, before, impulses),
            dt,
            kick_dt,
        )
        self._agree()

    def solve_contacts(self) -> None:
        """Solve the contacts with the impulses of the material.

        The momenta are reset to those without contacts, plus the impulses of the material, and
        contacts are solved again, starting from the impulses of `begin_step`. Without impulses of
        the material, those of `begin_step` are kept.

        Raises:
            RuntimeError: there was no `begin_step`.
        """
        pending = self._begun
        if pending is None:
            raise RuntimeError("solve_contacts: call begin_step first")
        impulses = pending.impulses
        if self.bodies.received_impulse.any():
            self._set_momenta(pending.free + self.bodies.received_impulse)
            impulses = self._solve.push_apart(
                pending.contacts, pending.impulses, dt=pending.dt, kick_dt=pending.kick_dt
            )
            self.contact_residual, self.contact_iterations = (
                self._solve.residual,
                self._solve.iterations,
            )
        self._begun = _StepStart(
            pending.states,
            pending.free,
            pending.supported,
            pending.contacts,
            impulses,
            pending.detour,
            pending.dt,
            pending.kick_dt,
            True,
        )
        self.contact_residual = self._ranks.share(self.contact_residual)

    def release_lifted(self, speed: float) -> bool:
        """Release supported bodies that the material lifts off their supports.

        The material has been solved with bodies that contacts hold. Contacts push, but do not pull:
        a body that approaches a floor through thick liquid would be held at its velocity against
        the pressure that stops it, and then be thrown back by the impulse of that pressure. The
        material is to be solved again, with the released bodies free. All bodies are then as after
        `begin_step`, without impulses of the material.

        Args:
            speed: least change of a body's velocity, anywhere on it, for a release [m/s].

        Returns:
            Whether bodies have been released.

        Raises:
            RuntimeError: there was no `begin_step`.
        """
        pending = self._begun
        if pending is None:
            raise RuntimeError("release_lifted: call begin_step first")
        held = np.array([body.hold is not None for body in self.bodies])
        if not (held.any() and self.bodies.received_impulse.any()):
            return bool(self._ranks.share(False))
        momenta, assumed = self._momenta(), self.bodies.velocities()
        self._set_momenta(pending.free + self.bodies.received_impulse)
        times = {"dt": pending.dt, "kick_dt": pending.kick_dt}
        self._solve.push_apart(pending.contacts, pending.impulses, **times)
        change = self.bodies.velocities() - assumed
        sizes = lengths(change[:, :3]) + self._solve.reach * lengths(change[:, 3:])
        lifted = self._ranks.share(held & (sizes > speed))
        self._set_momenta(momenta)
        if not lifted.any():
            return False
        self._set_momenta(np.where(lifted[:, None], pending.free, pending.supported))
        self.bodies.received_impulse[:] = 0.0
        for body, released in zip(self.bodies, lifted, strict=True):
            body.hold = None if released else body.hold
        return True

    def _set_momenta(self, momenta: np.ndarray) -> None:
        """Set the momenta of the bodies, shape (n, 6)."""
        self.bodies.momentum[:] = momenta[:, :3]
        self.bodies.angular_momentum[:] = momenta[:, 3:]

    def end_step(self, dt: float) -> None:
        """Move the bodies; calls `solve_contacts` if it has not been called.

        Args:
            dt: the argument of `begin_step` [s].

        Raises:
            RuntimeError: there was no `begin_step`.
        """
        if self._begun is None or not self._begun.settled:
            self.solve_contacts()
        assert self._begun is not None
        pending = self._begun
        self._solve.store_impulses(pending.contacts, pending.impulses)
        self.contacts = len(pending.contacts)
        ways = self._solve.separation(pending.contacts, dt, pending.detour)
        self.bodies.release()
        self.bodies.advance(dt)
        for way in (pending.detour, ways):
            if way is not None:
                self.bodies.shift(way)
        self._begun = None
        self._agree()

    def _agree(self) -> None:
        """Broadcast bodies, supports and contact memory from the root rank.

        Different processors may round differently, and a difference of a bit between ranks would in
        time become a different contact.
        """
        if self._ranks.size == 1:
            return
        own_values = (
            self.state(),
            [body.hold for body in self.bodies],
            self.contacts,
            self.contact_residual,
        )
        state, holds, self.contacts, self.contact_residual = self._ranks.share(own_values)
        self._restore_state(state)
        for body, hold in zip(self.bodies, holds, strict=True):
            body.hold = hold

    def gone(self) -> np.ndarray:
        """Return which bodies have left the domain, bool, shape (n,)."""
        size, sides = self.exits
        beyond = np.zeros(len(self.bodies), dtype=bool)
        for axis, length in enumerate(size if sides else ()):
            at = self.bodies.position[:, axis]
            beyond |= bool(sides >> 2 * axis & 1) & (at < 0.0) | bool(sides >> 2 * axis + 1 & 1) & (
                at > length
            )
        return beyond

    def leave(self) -> None:
        """Remove bodies that have crossed an open side; they rest outside."""
        size, sides = self.exits
        for number in np.flatnonzero(self.gone()) if sides else ():
            position, way = self.bodies.position[number], OUTSIDE * self._solve.reach[number]
            self.bodies.momentum[number], self.bodies.angular_momentum[number] = 0.0, 0.0
            for axis, length in enumerate(size):
                if sides >> 2 * axis & 1 and position[axis] < 0.0:
                    position[axis] = -way
                if sides >> 2 * axis + 1 & 1 and position[axis] > length:
                    position[axis] = length + way

    def restore_step(self) -> None:
        """Undo `begin_step`, if a step has begun."""
        if self._begun is not None:
            self.bodies.restore(self._begun.states)
            self._begun = None

    def stop_reason(self, size: Sequence[float], endless: Sequence[int]) -> str | None:
        """Return the reason why the simulation cannot continue, or "".

        A body is not finite, or touches its own periodic image.

        Args:
            size: size of the domain [m].
            endless: periodic axes, at whose two sides solids must be equal.
        """
        finite = np.isfinite(self.bodies.values[:, :STATE]).all(axis=1)
        if not finite.all():
            return f"{self.bodies[int(finite.argmin())].name} has a velocity that is not finite"
        for body, shape, motion in (
            zip(self.bodies, self.shapes, self.motions, strict=True) if len(endless) else ()
        ):
            points = motion.pose(body.time).apply(shape.points)
            for axis in endless:
                if (
                    points[:, axis].min() - shape.radius < 0.0
                    or points[:, axis].max() + shape.radius > size[axis]
                ):
                    return (
                        f"{body.name} has reached a side of the periodic {'xyz'[axis]} axis, "
                        "which rigid bodies cannot cross"
                    )
        return None

    def top_speed(self, span: float, gravity: float = 0.0) -> float:
        """Return the largest future speed of a point of a body [m/s].

        Args:
            span: time to look ahead [s].
            gravity: its magnitude [m/s^2].
        """
        six, there = self.bodies.velocities(), ~self.gone()
        speeds = lengths(six[:, :3]) + lengths(six[:, 3:]) * self._solve.reach
        return float(speeds[there].max()) + span * gravity if there.any() else 0.0

    def kinetic_energy(self) -> float:
        """Return the kinetic energy [J; J/m in 2-D]."""
        six = self.bodies.velocities()
        return 0.5 * float(
            (self.bodies.momentum * six[:, :3]).sum()
            + (self.bodies.angular_momentum * six[:, 3:]).sum()
        )

    def potential_energy(self, gravity: np.ndarray) -> float:
        """Return the potential energy [J; J/m in 2-D], 0 at the origin."""
        return -float(self.bodies.mass @ (self.bodies.position @ gravity))

    def state(self) -> dict[str, np.ndarray]:
        """Return the state, for a bitwise identical continuation."""
        joints = {"joint_impulses": self._solve.joint_impulses} if self.joints else {}
        return {"bodies": self._states(), "body_contacts": self._solve.memory.state(), **joints}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore `state`.

        Raises:
            ValueError: the state belongs to other bodies.
        """
        states = np.asarray(state["bodies"], dtype=np.float64)
        if states.shape != (len(self.bodies), STATE):
            raise ValueError(
                f"the state's bodies have shape {states.shape}: this scene has "
                f"{(len(self.bodies), STATE)}"
            )
        self._begun = None
        self._restore_state(state)

    def _restore_state(self, state: Mapping[str, np.ndarray]) -> None:
        self._solve.memory.restore(state.get("body_contacts", np.zeros((0, 8))))
        self._solve.joint_impulses = np.array(
            state.get("joint_impulses", 0.0 * self._solve.joint_impulses), dtype=np.float64
        )
        self.bodies.restore(np.asarray(state["bodies"], dtype=np.float64))

    def columns(self) -> tuple[str, ...]:
        """Return the log columns: position, velocity and rotation of each body.

        x, y, z: center of mass [m]; vx, vy, vz: its velocity [m/s]; 2-D: angle and spin, the
        rotation [degrees] and its speed [degrees/s]; 3-D: wx, wy, wz, the angular velocity
        [degrees/s]. contacts: number of points where bodies touch or nearly touch;
        contact_residual: residual of the contact problem, relative to that of no impulses. With
        open sides: bodies_gone, the number of removed bodies. With joints: joint_error, the largest
        distance of anchors [m] or angle between fixed directions [rad]; for each hinge, numbered
        among the joints, joint0_angle [degrees], and joint0_torque of its motor [N m].
        """
        names = IN_PLANE if self.dimension == 2 else IN_SPACE
        return (
            *(f"body{number}_{name}" for number in range(len(self.bodies)) for name in names),
            "contacts",
            "contact_residual",
            *(("bodies_gone",) if self.exits[1] else ()),
            *(
                (
                    "joint_error",
                    *(f"joint{number}_{name}" for number, name in self._joint_columns()),
                )
                if self.joints
                else ()
            ),
        )

    def _joint_columns(self) -> list[tuple[int, str]]:
        """Return joint number and column name of each joint column."""
        hinges = [
            (number, joint) for number, joint in enumerate(self.joints) if joint.kind == "hinge"
        ]
        return [
            (number, name)
            for number, j in hinges
            for name in ("angle", *(("torque",) if j.motor_torque > 0.0 else ()))
        ]

    def _joint_row(self) -> list[float]:
        """Return the entries of the columns of joints."""
        if not self.joints:
            return []
        errors, torques = [0.0], self._solve.motor_torques()
        for joint in self.joints:
            rows = joint.rows(self.bodies, 1.0, self.dimension)
            errors.append(float(np.abs(rows.error[rows.equations]).max()))
        values = {
            "angle": lambda number: float(np.degrees(self.joints[number].angle(self.bodies))),
            "torque": torques.__getitem__,
        }
        return [max(errors), *(values[name](number) for number, name in self._joint_columns())]

    def row(self) -> dict[str, float | int]:
        """Return the values of the log columns."""
        bodies, six = self.bodies, self.bodies.velocities()
        six[:, 3:] = np.degrees(six[:, 3:])
        columns = [bodies.position, six]
        if self.dimension == 2:
            columns = [
                bodies.position[:, :2],
                six[:, :2],
                np.degrees(bodies.angle)[:, None],
                six[:, 5:],
            ]
        numbers = np.concatenate(columns, axis=1).ravel().tolist()
        gone = [int(self.gone().sum())] if self.exits[1] else []
        if self._columns is None:
            self._columns = self.columns()
        return dict(
            zip(
                self._columns,
                [*numbers, self.contacts, float(self.contact_residual), *gone, *self._joint_row()],
                strict=True,
            )
        )

    def surfaces(self) -> BodySurface:
        """Return the surfaces of all bodies for a frame.

        Fields: `body`, counted from 0, and `velocity` [m/s].
        """
        if self._surfaces is None:
            self._surfaces = [
                body_surface(geometry, self.dimension) for geometry in self._geometries
            ]
        surfaces, gone = [], self.gone()
        for number, (body, motion, surface) in enumerate(
            zip(self.bodies, self.motions, self._surfaces, strict=True)
        ):
            points = motion.pose(body.time).apply(surface.points)
            velocity = body.velocity + np.cross(body.angular_velocity, points - body.position)
            fields = {
                "body": np.full(len(points), number, dtype=np.int32),
                "velocity": velocity.astype(np.float32),
            }
            shown = surface.corners[:0] if gone[number] else surface.corners
            kept = slice(0, 0 if gone[number] else None)
            surfaces.append(
                BodySurface(
                    points[kept].astype(np.float32),
                    shown,
                    {name: values[kept] for name, values in fields.items()},
                )
            )
        return BodySurface.joined(surfaces)

    def _states(self) -> np.ndarray:
        return self.bodies.values[:, :STATE].copy()

    def _momenta(self) -> np.ndarray:
        return np.concatenate([self.bodies.momentum, self.bodies.angular_momentum], axis=1)
