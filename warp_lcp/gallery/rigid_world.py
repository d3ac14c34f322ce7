"""World of bodies, ground, hinges and gravity, and its velocity problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse

from warp_lcp.grid.signed_distance import Box, Sphere
from warp_lcp.rigid.body import BodyStates, RigidBody
from warp_lcp.rigid.contact_detection import NONE, ContactDetection
from warp_lcp.rigid.contact_models import ContactSystem
from warp_lcp.rigid.contact_shape import ContactShape
from warp_lcp.rigid.contact_solve import ContactSolve
from warp_lcp.rigid.contacts import Contacts
from warp_lcp.rigid.joints import Joint, JointRows
from warp_lcp.rigid.mass_properties import MassProperties, mass_properties
from warp_lcp.rigid.obstacles import Obstacle

Parts = Sphere | Box | Sequence[Box]  # a ball, a box, or boxes with a common center

FIXED = np.inf  # mass [kg] of a body that does not move
GROUND = Obstacle(name="ground", points=np.zeros((1, 3)), normals=np.array([[0.0, 0.0, 1.0]]))
GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2]
# Relative to the smallest body's reach: gaps up to this are contacts, besides those that the
# fastest bodies can close in a step.
MARGIN = 0.02
NEAR_LIMIT = 0.2  # [rad]: limits farther away have no row
# Relative to the smallest body's reach: overlap that is not corrected, so that resting contacts
# persist.
SLOP = 0.002


@dataclass(eq=False)
class World:
    """State of a contact scene: bodies, shapes, joints, gravity.

    Args:
        name: name of the scene, with its parameters.
        solids: the placed shape of each body: a ball, a box, or boxes with a common center and
            equal shares of the mass.
        mass: mass of each body [kg]; FIXED for one that does not move.
        obstacles: the ground.
        hinges: joints; bodies of a joint do not collide.
        friction: coefficient mu >= 0 of all contacts.
        gravity: [m/s^2].
        ignored: further pairs of bodies that do not collide, the smaller index first.

    Attributes:
        bodies: the bodies' state, updated by steps.
        fixed: mask of the fixed bodies, shape (n,).
        contact_solve: finds contacts and stores their impulses.
        size: reach of the smallest body [m].

    Raises:
        ValueError: there is no body, a mass is not positive, friction is negative, or gravity is
            not finite.
    """

    name: str
    solids: Sequence[Parts]
    mass: Sequence[float] | np.ndarray
    obstacles: tuple[Obstacle, ...] = (GROUND,)
    hinges: tuple[Joint, ...] = ()
    friction: float = 0.5
    gravity: tuple[float, float, float] = GRAVITY
    ignored: frozenset[tuple[int, int]] = frozenset()
    bodies: BodyStates = field(init=False)
    fixed: np.ndarray = field(init=False)
    contact_solve: ContactSolve = field(init=False)
    size: float = field(init=False)

    def __post_init__(self) -> None:
        """Check gravity, and create the bodies, which check the other values."""
        if not np.isfinite(self.gravity).all():
            raise ValueError(f"gravity = {self.gravity}: must be finite, in m/s^2")
        if not len(self.solids):
            raise ValueError("solids is empty: expected at least one body")
        self.fixed = np.isposinf(self.mass)
        parts = [
            _made(solid, 1.0 if m == FIXED else m)
            for solid, m in zip(self.solids, self.mass, strict=True)
        ]
        self.bodies = BodyStates(
            [
                RigidBody(p, name=f"body {i}", friction=self.friction)
                for i, (p, _) in enumerate(parts)
            ]
        )
        shapes = [shape for _, shape in parts]
        self.contact_solve = ContactSolve(
            ContactDetection(self.bodies, shapes, self.obstacles, 3, every=True)
        )
        self.size = min(shape.reach(properties.center) for properties, shape in parts)

    def velocities(self) -> np.ndarray:
        """Return velocities, linear and angular, of the bodies [m/s, rad/s], shape (n, 6)."""
        return self.bodies.velocities()

    def contacts(self, dt: float = 0.0, *, margin: float | None = None) -> Contacts:
        """Return the current contacts, or those possible within dt [s].

        With dt, every body can move at the largest speed of all.

        Args:
            dt: time step [s].
            margin: gap [m] up to which there is a contact; None: from the bodies' sizes and speeds.
        """
        fastest, near = (
            float(np.linalg.norm(self.velocities()[:, :3], axis=1).max()),
            MARGIN * self.size,
        )
        near, way = (near, dt * fastest) if margin is None else (margin, 0.0)
        n, ignored = len(self.bodies), self.ignored | {hinge.pair for hinge in self.hinges}
        still = np.append(self.fixed, True)
        detected = self.contact_solve.detection.find(
            0.0, np.full(n, way), np.full(len(self.obstacles), near + way), near
        )
        detected = detected.without(ignored)
        detected = detected.where(~(still[detected.first] & still[detected.second]))
        detected = detected.where(
            np.lexsort((detected.first, detected.second, detected.obstacle == NONE))
        )
        return self.contact_solve.assembled(detected, 0.0, 1.0, None)

    def assemble(self, dt: float, *, rate: float = 0.2) -> Assembly:
        """Return the velocity problem of a step.

        u = J v' + c with v' = v + dt g + M^-1 J'r. For a contact's normal row c = gap / dt if there
        is a gap, so that an approaching body arrives within the step, and rate min(gap + slop, 0) /
        dt if bodies overlap (Baumgarte); for joints see `JointRows.bias`.

        Args:
            dt: time step [s].
            rate: fraction of an overlap or of a joint's error that the step removes, in [0, 1].

        Raises:
            ValueError: dt or rate is out of range.
        """
        if not (dt > 0 and 0 <= rate <= 1):
            raise ValueError(f"dt = {dt}, rate = {rate}: must be > 0 and in [0, 1]")
        n, contacts = len(self.bodies), self.contacts(dt)
        joints = [_near(hinge.rows(self.bodies, dt)) for hinge in self.hinges]
        J = scipy.sparse.csr_array(
            scipy.sparse.vstack([contacts.jacobian(n), *(rows.jacobian(n) for rows in joints)])
        )
        masses = [
            np.zeros((6, 6)) if still else body.free_inverse_mass(3)
            for body, still in zip(self.bodies, self.fixed, strict=True)
        ]
        response = scipy.sparse.csr_array(
            scipy.sparse.bsr_array((np.array(masses), np.arange(n), np.arange(n + 1))) @ J.T
        )
        falling = self.velocities()
        falling[~self.fixed, :3] += dt * np.array(self.gravity)
        bias, gap = np.zeros((len(contacts), 3)), contacts.gap
        bias[:, 0] = np.where(gap > 0, gap, rate * np.minimum(gap + SLOP * self.size, 0.0)) / dt
        bias = np.concatenate([bias.ravel(), *(rows.bias(dt, rate) for rows in joints)])
        low = np.concatenate([np.zeros(0), *(rows.lower for rows in joints)])
        high = np.concatenate([np.zeros(0), *(rows.upper for rows in joints)])
        B = scipy.sparse.csr_array(J @ response)
        B = scipy.sparse.csr_array(0.5 * (B + B.T))  # rounding must not make it unsymmetric
        system = ContactSystem(
            self.name,
            B,
            J @ falling.ravel() + bias,
            np.full(len(contacts), self.friction),
            low,
            high,
        )
        return Assembly(system, contacts, J, response, falling, bias)

    def energy(self) -> float:
        """Return kinetic plus potential energy of the moving bodies [J]."""
        moving = [body for body, still in zip(self.bodies, self.fixed, strict=True) if not still]
        return sum(
            body.kinetic_energy + body.potential_energy(np.array(self.gravity)) for body in moving
        )

    def deepest(self) -> float:
        """Return the largest overlap of bodies [m], 0 without overlap."""
        return max(0.0, -float(self.contacts().gap.min(initial=0.0)))


@dataclass(frozen=True, eq=False)
class Assembly:
    """Velocity problem of a step and the response to its impulses.

    Args:
        system: B, q, friction, bounds of joints.
        contacts: its contacts.
        J: maps velocities of the bodies to those at contacts and joints, shape (rows, 6n).
        response: M^-1 J', maps impulses to velocities of the bodies, shape (6n, rows).
        falling: velocities of the bodies without impulses, shape (n, 6).
        bias: c, the part of q that removes position errors [m/s], shape (rows,).
    """

    system: ContactSystem
    contacts: Contacts
    J: scipy.sparse.csr_array
    response: scipy.sparse.csr_array
    falling: np.ndarray
    bias: np.ndarray

    def velocity(self, r: np.ndarray) -> np.ndarray:
        """Return v' of the bodies after impulses r, shape (n, 6)."""
        return self.falling + (self.response @ r).reshape(self.falling.shape)


def _made(solid: Parts, mass: float) -> tuple[MassProperties, ContactShape]:
    """Return mass properties and surface of a body.

    Several boxes share the mass evenly.
    """
    if isinstance(solid, Sphere):
        return mass_properties(solid, 3, mass=mass), ContactShape.of(solid, 3)
    boxes = [solid] if isinstance(solid, Box) else solid
    parts = [mass_properties(box, 3, mass=mass / len(boxes)) for box in boxes]
    inertia = np.sum([part.inertia for part in parts], axis=0)
    return MassProperties(mass=mass, center=parts[0].center, inertia=inertia), ContactShape.united(
        boxes
    )


def _near(rows: JointRows) -> JointRows:
    """Return the rows without those of distant limits."""
    return rows.where(rows.equations | rows.motors | (rows.error <= NEAR_LIMIT))
