"""Rigid bodies: spheres, boxes and gears, where they are, how they move, their mass and inertia ([Book] 1.3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from warp_lcp.settings import Count, Positive, Settings

FIXED = np.inf  # mass [kg] of a body that does not move


@dataclass(frozen=True)
class Sphere(Settings):
    """A ball of a radius [m].

    Raises:
        ValueError: the radius is not positive.
    """

    radius: Positive

    @property
    def reach(self) -> float:
        """Largest distance of a point from the center [m]."""
        return self.radius

    def inertia(self, mass: float) -> np.ndarray:
        """Return the inertia about the center in the body's frame [kg m^2], shape (3, 3): 2/5 m r^2."""
        return 0.4 * mass * self.radius**2 * np.eye(3)


@dataclass(frozen=True)
class Box:
    """A box by its half sides [m] along the body's axes.

    Raises:
        ValueError: a side is not positive.
    """

    half: tuple[float, float, float]

    def __post_init__(self) -> None:
        """Check the sides."""
        if len(self.half) != 3 or not all(0 < h < np.inf for h in self.half):
            raise ValueError(f"half = {self.half}: must be three numbers > 0, in m")

    @property
    def reach(self) -> float:
        """Largest distance of a point from the center [m]."""
        return float(np.linalg.norm(self.half))

    def inertia(self, mass: float) -> np.ndarray:
        """Return the inertia about the center in the body's frame [kg m^2], shape (3, 3): m (b^2 + c^2) / 3 for half sides b, c."""
        squares = np.square(self.half)
        return mass / 3 * np.diag(squares.sum() - squares)

    def parts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the boxes that it is made of, each a rotation in the body's frame and half sides [m]."""
        return [(np.eye(3), np.asarray(self.half, dtype=np.float64))]


@dataclass(frozen=True)
class Gear(Settings):
    """Bars that cross in the center, in the body's xy plane: 2 `bars` teeth.

    Args:
        radius: of the tips [m].
        tooth: half the width of a bar [m].
        thickness: half of it, along z [m].
        bars: how many; their mass is the same.

    Raises:
        ValueError: a length is not positive, or there is no bar.
    """

    radius: Positive
    tooth: Positive
    thickness: Positive
    bars: Count = 3

    @property
    def reach(self) -> float:
        """Largest distance of a point from the center [m]."""
        return float(np.linalg.norm([self.radius, self.tooth, self.thickness]))

    def inertia(self, mass: float) -> np.ndarray:
        """Return the inertia about the center in the body's frame [kg m^2], shape (3, 3)."""
        return np.sum([R @ Box((h[0], h[1], h[2])).inertia(mass / self.bars) @ R.T for R, h in self.parts()], axis=0)

    def parts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the bars, each a rotation in the body's frame and half sides [m]."""
        half = np.array([self.radius, self.tooth, self.thickness])
        return [(rotation(np.array([0.0, 0.0, np.pi * k / self.bars])), half) for k in range(self.bars)]


Shape = Sphere | Box | Gear


def rotation(vector: np.ndarray) -> np.ndarray:
    """Return the matrix that turns by |vector| [rad] about vector (Rodrigues), shape (3, 3)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross @ cross


class RigidBodies:
    """The state of n bodies; arrays are float64 and may be written in place.

    Args:
        shapes: of each.
        mass: of each [kg]; FIXED for one that does not move.
        position: of the centers of mass [m], shape (n, 3).
        rotation: from each body's frame to the world's, shape (n, 3, 3); the identity if None.
        velocity: of the centers and angular, in the world's frame [m/s, rad/s], shape (n, 6); 0 if None.

    Raises:
        ValueError: shapes of arrays differ, a mass is not positive, a number is not finite, or there is no body.

    Example:
        >>> bodies = RigidBodies([Sphere(0.5)], [2.0], [[0.0, 0.0, 1.0]], velocity=[[3.0, 0.0, 0.0, 0.0, 0.0, 10.0]])
        >>> print(bodies.momentum()[:3], bodies.kinetic_energy())
        [6. 0. 0.] 19.0
    """

    def __init__(
        self,
        shapes: Sequence[Shape],
        mass: Sequence[float] | np.ndarray,
        position: object,
        rotation: object = None,
        velocity: object = None,
    ) -> None:
        n = len(shapes)
        if n == 0:
            raise ValueError("shapes is empty: there must be a body")
        self.shapes, self.mass = tuple(shapes), np.array(mass, dtype=np.float64)
        self.position = np.array(position, dtype=np.float64)
        self.rotation = np.array(np.tile(np.eye(3), (n, 1, 1)) if rotation is None else rotation, dtype=np.float64)
        self.velocity = np.array(np.zeros((n, 6)) if velocity is None else velocity, dtype=np.float64)
        for name, shape in (("mass", (n,)), ("position", (n, 3)), ("rotation", (n, 3, 3)), ("velocity", (n, 6))):
            value = getattr(self, name)
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}: expected {shape}")
            if name != "mass" and not np.isfinite(value).all():
                raise ValueError(f"{name} holds a value that is not finite")
        if not (self.mass > 0).all():
            raise ValueError("mass holds a value that is not positive")
        self.free = np.isfinite(self.mass)
        self._body_inertia = np.array([s.inertia(m if f else 1.0) for s, m, f in zip(self.shapes, self.mass, self.free, strict=True)])
        self.velocity[~self.free] = 0.0

    def __len__(self) -> int:
        """Return the number of bodies."""
        return len(self.shapes)

    def inertia(self) -> np.ndarray:
        """Return R I R' of each body [kg m^2], shape (n, 3, 3); of a fixed one that for 1 kg."""
        return self.rotation @ self._body_inertia @ self.rotation.transpose(0, 2, 1)

    def inverse_mass(self) -> scipy.sparse.csr_array:
        """Return M^-1 for velocities (linear, angular) of the bodies in turn, shape (6n, 6n); 0 for fixed bodies."""
        blocks = np.zeros((len(self), 6, 6))
        blocks[self.free, :3, :3] = np.eye(3) / self.mass[self.free, None, None]
        blocks[self.free, 3:, 3:] = np.linalg.inv(self.inertia()[self.free])
        n = len(self)
        return scipy.sparse.bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(6 * n, 6 * n)).tocsr()

    def move(self, dt: float) -> None:
        """Move along the velocities for dt [s]; the angular momentum of each body stays: its angular velocity follows the inertia."""
        spin = np.einsum("nij,nj->ni", self.inertia(), self.velocity[:, 3:])
        self.position += dt * self.velocity[:, :3]
        self.turn(dt * self.velocity[:, 3:])
        self.velocity[:, 3:] = np.linalg.solve(self.inertia(), spin[:, :, None])[:, :, 0]

    def turn(self, vectors: np.ndarray) -> None:
        """Turn each body by a rotation vector [rad], shape (n, 3)."""
        for i in np.flatnonzero(self.free):
            u, _, vt = np.linalg.svd(rotation(vectors[i]) @ self.rotation[i])  # the nearest rotation: rounding does not pile up
            self.rotation[i] = u @ vt

    def momentum(self) -> np.ndarray:
        """Return the momentum [kg m/s] and the angular momentum about the origin [kg m^2/s] of the free bodies, shape (6,)."""
        f = self.free
        p = self.mass[f, None] * self.velocity[f, :3]
        spin = np.einsum("nij,nj->ni", self.inertia()[f], self.velocity[f, 3:])
        return np.concatenate([p.sum(axis=0), (np.cross(self.position[f], p) + spin).sum(axis=0)])

    def kinetic_energy(self) -> float:
        """Return v'M v / 2 [J]."""
        f, w = self.free, self.velocity[:, 3:]
        spin = np.einsum("ni,nij,nj->n", w, self.inertia(), w)[f].sum()
        return 0.5 * float((self.mass[f] * np.square(self.velocity[f, :3]).sum(axis=1)).sum() + spin)

    def potential_energy(self, gravity: np.ndarray) -> float:
        """Return -sum of m g.x [J]."""
        return -float((self.mass[self.free] * (self.position[self.free] @ gravity)).sum())
