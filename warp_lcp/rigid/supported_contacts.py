"""Contacts that support bodies: with walls, and with supported bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_lcp.rigid.contacts import Contacts

BEARS = 1e-6  # relative to the largest impulse of a body: smaller ones do not support it
STILL = 1e-6  # relative to a free body's response: smaller responses count as none
SINGULAR = 1e-9  # relative to the largest singular value: redundant contacts


@dataclass(frozen=True, eq=False)
class SupportedContacts:
    """Contact rows that support a body: which rows support which body.

    Masks of contact rows, shape (k, dimension) each.

    Args:
        held: rows with a load; along tangents, rows that do not slip.
        first: rows whose second side does not move, so that they support their first body.
        second: rows that support their second body.
        bodies: number of bodies.
    """

    held: np.ndarray
    first: np.ndarray
    second: np.ndarray
    bodies: int

    @classmethod
    def of(cls, contacts: Contacts, impulses: np.ndarray, bodies: int) -> SupportedContacts:
        """Return the supports by walls and solids, from impulses (k, dimension)."""
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
        """Return G' J' J G of the rows J that support a body, shape (q, q).

        G is `root`, the root of its inverse mass, shape (q, q).
        """
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
        """Let a supported body support others; return their numbers.

        Args:
            contacts: the contacts.
            number: number of the body.
            free: root of its inverse mass, shape (q, q).
            left: root of the inverse mass that remains with supports, shape (q, q).
        """
        reached: list[int] = []
        sides = (
            (self.first, contacts.second, contacts.other, contacts.first),
            (self.second, contacts.first, contacts.one, contacts.second),
        )
        for rows, mine, J, beyond in sides:
            touching = np.flatnonzero((mine == number) & (beyond < self.bodies))
            if not len(touching):
                continue
            yields = [np.square(J[touching] @ root).sum(axis=2) for root in (left, free)]
            fresh = self.held[touching] & (yields[0] < STILL * yields[1])
            rows[touching] |= fresh
            reached += beyond[touching[fresh.any(axis=1)]].tolist()
        return list(dict.fromkeys(reached))
