"""Bodies, ground, hinges and gravity, and the velocity problem of their next time step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from warp_lcp.gallery.contact_detection import Contacts, Plane, detect
from warp_lcp.gallery.contact_models import ContactSystem
from warp_lcp.gallery.hinges import Hinge, hinge_jacobian
from warp_lcp.gallery.rigid_bodies import RigidBodies

GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2]
MARGIN = 0.02  # of the smallest body's reach: gaps up to it are contacts, besides those that the fastest bodies may close in a step
SLOP = 0.002  # of the smallest body's reach: overlap that is left alone, so that resting contacts stay


@dataclass(eq=False)
class World:
    """What a scene consists of.

    Args:
        name: the scene, with its parameters.
        bodies: their state; steps write it.
        planes: the ground.
        hinges: joints; the bodies of one do not collide.
        friction: coefficient mu >= 0 of all contacts.
        gravity: [m/s^2].
        ignored: further pairs of bodies that do not collide, the smaller index first.

    Raises:
        ValueError: friction is negative, or gravity is not finite.
    """

    name: str
    bodies: RigidBodies
    planes: tuple[Plane, ...] = (Plane((0.0, 0.0, 1.0)),)
    hinges: tuple[Hinge, ...] = ()
    friction: float = 0.5
    gravity: tuple[float, float, float] = GRAVITY
    ignored: frozenset[tuple[int, int]] = frozenset()

    def __post_init__(self) -> None:
        """Check friction and gravity."""
        if not 0 <= self.friction < np.inf:
            raise ValueError(f"friction = {self.friction}: must be >= 0 and finite")
        if not np.isfinite(self.gravity).all():
            raise ValueError(f"gravity = {self.gravity}: must be finite, in m/s^2")

    @property
    def size(self) -> float:
        """Reach of the smallest body [m]."""
        return min(shape.reach for shape in self.bodies.shapes)

    def contacts(self, dt: float = 0.0) -> Contacts:
        """Return where bodies touch now, or may within dt [s] if two of them meet at the largest speed of all."""
        ignored = self.ignored | {hinge.pair for hinge in self.hinges}
        fastest = float(np.linalg.norm(self.bodies.velocity[:, :3], axis=1).max())
        return detect(self.bodies, self.planes, MARGIN * self.size + 2 * dt * fastest, ignored)

    def assemble(self, dt: float, *, rate: float = 0.2, contacts: Contacts | None = None) -> Assembly:
        """Return the velocity problem of a step.

        u = J v' + c with v' = v + dt g + M^-1 J'r. For a contact's normal row c = gap / dt where there is a gap, so that what approaches
        arrives in the step, and rate min(gap + slop, 0) / dt where bodies overlap (Baumgarte); joints see `Hinge.rows`.

        Args:
            dt: time step [s].
            rate: part of an overlap or of a joint's error that the step removes, in [0, 1].
            contacts: where bodies touch; detected if None.

        Raises:
            ValueError: dt or rate is out of range.
        """
        if not (dt > 0 and 0 <= rate <= 1):
            raise ValueError(f"dt = {dt}, rate = {rate}: must be > 0 and in [0, 1]")
        bodies, contacts = self.bodies, self.contacts(dt) if contacts is None else contacts
        rows = [hinge.rows(bodies, dt, rate) for hinge in self.hinges]
        J = scipy.sparse.csr_array(scipy.sparse.vstack([contacts.jacobian(bodies), hinge_jacobian(self.hinges, rows, len(bodies))]).tocsr())
        M = bodies.inverse_mass()
        falling = bodies.velocity.copy()
        falling[bodies.free, :3] += dt * np.array(self.gravity)
        bias = np.zeros(J.shape[0])
        gap = contacts.gap
        bias[0 : 3 * len(contacts) : 3] = np.where(gap > 0, gap, rate * np.minimum(gap + SLOP * self.size, 0.0)) / dt
        joints = [np.concatenate([getattr(r, name) for r in rows]) if rows else np.zeros(0) for name in ("bias", "lower", "upper")]
        bias[3 * len(contacts) :] = joints[0]
        response = scipy.sparse.csr_array(M @ J.T)
        q = J @ falling.ravel() + bias
        B = scipy.sparse.csr_array(J @ response)
        B = scipy.sparse.csr_array(0.5 * (B + B.T))  # rounding must not make it unsymmetric
        system = ContactSystem(self.name, B, q, np.full(len(contacts), self.friction), joints[1], joints[2])
        return Assembly(system, contacts, response, falling, bias)

    def energy(self) -> float:
        """Return kinetic and potential energy [J]."""
        return self.bodies.kinetic_energy() + self.bodies.potential_energy(np.array(self.gravity))

    def deepest(self) -> float:
        """Return the largest overlap of bodies [m], 0 where there is none."""
        gaps = self.contacts().gap
        return max(0.0, -float(gaps.min())) if gaps.size else 0.0


@dataclass(frozen=True, eq=False)
class Assembly:
    """A step's velocity problem, and what its impulses do.

    Args:
        system: B, q, friction, bounds of joints.
        contacts: the points of its contacts.
        response: M^-1 J', velocities of the bodies from impulses, shape (6n, rows).
        falling: velocities of the bodies without impulses, shape (n, 6).
        bias: c, the part of q that removes errors of position [m/s], shape (rows,).
    """

    system: ContactSystem
    contacts: Contacts
    response: scipy.sparse.csr_array
    falling: np.ndarray
    bias: np.ndarray

    def velocity(self, r: np.ndarray) -> np.ndarray:
        """Return v' of the bodies after impulses r, shape (n, 6)."""
        return self.falling + (self.response @ r).reshape(self.falling.shape)
