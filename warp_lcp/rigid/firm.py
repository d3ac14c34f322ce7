"""Which contacts stand firm, so that bodies on them are held: walls, and bodies that are held themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_lcp.rigid.touching import Touching

BEARS = 1e-6  # of the largest impulse of a body: contacts with less do not hold it
STILL = 1e-6  # of how a free body yields: what yields less does not
SINGULAR = 1e-9  # of the largest: what several contacts say of the same direction


@dataclass(frozen=True, eq=False)
class Firm:
    """Rows of contacts, shape (k, dimension) each.

    Args:
        held: that bear; along tangents: that do not slip.
        first: of those, whose other side does not move, so that they hold their first body.
        second: that hold their second one.
        bodies: their number.
    """

    held: np.ndarray
    first: np.ndarray
    second: np.ndarray
    bodies: int

    @classmethod
    def of(cls, touching: Touching, impulses: np.ndarray, bodies: int) -> Firm:
        """Return what walls and other solids hold, by impulses of shape (k, dimension)."""
        normal = impulses[:, 0]
        largest = np.zeros(bodies + 1)
        np.maximum.at(largest, touching.first, normal)
        np.maximum.at(largest, touching.second, normal)
        largest[bodies] = np.inf
        bears = normal > BEARS * np.minimum(largest[touching.first], largest[touching.second])
        sticks = np.abs(impulses[:, 1:]) < (touching.friction * normal)[:, None] * (1.0 - BEARS)
        held = bears[:, None] & np.concatenate([bears[:, None], sticks], axis=1)
        return cls(held, held & (touching.second == bodies)[:, None], np.zeros_like(held), bodies)

    def square(self, touching: Touching, number: int, root: np.ndarray) -> np.ndarray:
        """Return G' J' J G of the rows J that hold a body, shape (q, q); G: `root` of its inverse mass, shape (q, q)."""
        one, other = touching.first == number, touching.second == number
        J = np.concatenate([touching.one[one][self.first[one]], touching.other[other][self.second[other]]]) @ root
        return np.asarray(J.T @ J)

    def spread(self, touching: Touching, number: int, free: np.ndarray, left: np.ndarray) -> list[int]:
        """Let a body that is held hold others; return which.

        Args:
            touching: the contacts.
            number: of the body.
            free: root of its inverse mass, shape (q, q).
            left: of what is left of that.
        """
        reached: list[int] = []
        sides = (
            (self.first, touching.second, touching.other, touching.first),
            (self.second, touching.first, touching.one, touching.second),
        )
        for rows, mine, J, beyond in sides:
            here = np.flatnonzero((mine == number) & (beyond < self.bodies))
            yields = [np.square(J[here] @ root).sum(axis=2) for root in (left, free)]
            fresh = self.held[here] & (yields[0] < STILL * yields[1])
            rows[here] |= fresh
            reached += beyond[here[fresh.any(axis=1)]].tolist()
        return list(dict.fromkeys(reached))
