"""Which contacts stand firm, so that bodies on them are held: walls, and bodies that are held themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_lcp.rigid.contacts import Contacts

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
    def of(cls, contacts: Contacts, impulses: np.ndarray, bodies: int) -> Firm:
        """Return what walls and other solids hold, by impulses of shape (k, dimension)."""
        normal = impulses[:, 0]
        largest = np.zeros(bodies + 1)
        np.maximum.at(largest, contacts.first, normal)
        np.maximum.at(largest, contacts.second, normal)
        largest[bodies] = np.inf
        bears = normal > BEARS * np.minimum(largest[contacts.first], largest[contacts.second])
        sticks = np.abs(impulses[:, 1:]) < (contacts.friction * normal)[:, None] * (1.0 - BEARS)
        held = bears[:, None] & np.concatenate([bears[:, None], sticks], axis=1)
        return cls(held, held & (contacts.second == bodies)[:, None], np.zeros_like(held), bodies)

    def square(self, contacts: Contacts, number: int, root: np.ndarray) -> np.ndarray:
        """Return G' J' J G of the rows J that hold a body, shape (q, q); G: `root` of its inverse mass, shape (q, q)."""
        one, other = contacts.first == number, contacts.second == number
        J = (
            np.concatenate(
                [contacts.one[one][self.first[one]], contacts.other[other][self.second[other]]]
            )
            @ root
        )
        return np.asarray(J.T @ J)

    def spread(
        self, contacts: Contacts, number: int, free: np.ndarray, left: np.ndarray
    ) -> list[int]:
        """Let a body that is held hold others; return which.

        Args:
            contacts: the contacts.
            number: of the body.
            free: root of its inverse mass, shape (q, q).
            left: of what is left of that.
        """
        reached: list[int] = []
        sides = (
            (self.first, contacts.second, contacts.other, contacts.first),
            (self.second, contacts.first, contacts.one, contacts.second),
        )
        for rows, mine, J, beyond in sides:
            here = np.flatnonzero((mine == number) & (beyond < self.bodies))
            if not len(here):
                continue
            yields = [np.square(J[here] @ root).sum(axis=2) for root in (left, free)]
            fresh = self.held[here] & (yields[0] < STILL * yields[1])
            rows[here] |= fresh
            reached += beyond[here[fresh.any(axis=1)]].tolist()
        return list(dict.fromkeys(reached))
