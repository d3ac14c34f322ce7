"""Contacts of a step, and the impulses remembered for the next one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array, csr_array

from warp_lcp.rigid.body import BodyStates, cross, lengths

# Relative to a body's size: a contact this close to one of the last step starts from its impulse.
SAME_PLACE = 0.05
KEPT = 32  # most contacts remembered for each body


@dataclass(frozen=True, eq=False)
class Contacts:
    """The k contacts of a step; rows: normal and `dimension` - 1 tangents.

    A body has q velocities.

    Args:
        first: body that the normal points into, shape (k,).
        second: body that the normal comes from, the number of bodies for an obstacle, shape (k,).
        point: points in the world [m], shape (k, 3).
        frames: normal and tangents, shape (k, dimension, 3).
        gap: [m], shape (k,).
        size: size of the smaller body [m], shape (k,).
        friction: Coulomb's coefficient, shape (k,).
        one: rows for the velocities of the first body, shape (k, dimension, q).
        other: rows for the second body, 0 for an obstacle.
        wall: velocity of moving obstacles [m/s], shape (k, dimension).
        target: smallest allowed normal velocity [m/s], which closes the gap or rebounds, shape
            (k,).
        restitution: ratio of the speeds after and before an impact, shape (k,).
        when: time from the step's beginning to the impact that bounces, at this contact or
            elsewhere among connected bodies [s], shape (k,); 0 without an impact.
    """

    first: np.ndarray
    second: np.ndarray
    point: np.ndarray
    frames: np.ndarray
    gap: np.ndarray
    size: np.ndarray
    friction: np.ndarray
    one: np.ndarray
    other: np.ndarray
    wall: np.ndarray
    target: np.ndarray
    restitution: np.ndarray
    when: np.ndarray

    def __len__(self) -> int:
        """Return the number of contacts."""
        return len(self.gap)

    def jacobian(self, bodies: int) -> csr_array:
        """Return the contact Jacobian J, shape (k dimension, bodies q)."""
        return jacobian(self.first, self.second, self.one, self.other, bodies)

    def velocities(self, of_bodies: np.ndarray) -> np.ndarray:
        """Return relative velocities at contacts [m/s], shape (k, dimension).

        From those of the bodies, shape (n, q).
        """
        V = np.vstack([of_bodies, np.zeros(of_bodies.shape[1])])
        both = (self.one @ V[self.first][:, :, None] + self.other @ V[self.second][:, :, None])[
            :, :, 0
        ]
        return np.asarray(both + self.wall)

    def on_bodies(self, impulses: np.ndarray, count: int) -> np.ndarray:
        """Return the impulse on each body, shape (count, q).

        From impulses of contacts, shape (k, rows) with rows <= dimension.
        """
        rows = impulses.shape[1]
        total = np.zeros((count + 1, self.one.shape[2]))
        np.add.at(total, self.first, (impulses[:, None] @ self.one[:, :rows])[:, 0])
        np.add.at(total, self.second, (impulses[:, None] @ self.other[:, :rows])[:, 0])
        return total[:-1]


class ContactMemory:
    """Impulses of the last step's contacts, to start the next solve from.

    Attributes:
        values: first and second body, position in the first body's axes [m], impulse in the world's
            axes [N s]; shape (k, 8).
    """

    def __init__(self, bodies: int) -> None:
        self.values, self._most = np.zeros((0, 8)), KEPT * bodies

    def state(self) -> np.ndarray:
        """Return the values, padded with rows of -1 to a fixed shape."""
        return np.concatenate([self.values, np.full((self._most - len(self.values), 8), -1.0)])

    def restore(self, state: np.ndarray) -> None:
        """Restore `state`; an empty array clears the memory."""
        values = np.array(state, dtype=np.float64).reshape(-1, 8)
        self.values = values[values[:, 0] >= 0.0]

    def keep(self, contacts: Contacts, impulses: np.ndarray, bodies: BodyStates) -> None:
        """Store impulses, shape (k, dimension)."""
        world = (impulses[:, None] @ contacts.frames)[:, 0]
        self.store(
            np.column_stack([contacts.first, contacts.second, _places(contacts, bodies), world])
        )

    def store(self, values: np.ndarray) -> None:
        """Store values, shape (k, 8), up to the capacity."""
        self.values = values[: self._most]

    def initial_impulses(self, contacts: Contacts, bodies: BodyStates) -> np.ndarray:
        """Return initial impulses, shape (k, dimension).

        They are those of the nearest stored contact of the same pair, each used once.
        """
        start, old = np.zeros(contacts.wall.shape), self.values
        if not len(old) or not len(contacts):
            return start
        places, pairs = _places(contacts, bodies), len(bodies) + 1
        keys, before = (
            contacts.first * pairs + contacts.second,
            (old[:, 0] * pairs + old[:, 1]).astype(np.int64),
        )
        order = np.argsort(before, kind="stable")
        low, high = (np.searchsorted(before[order], keys, side=side) for side in ("left", "right"))
        # All pairs of a new and an old contact of the same two bodies.
        fresh = np.repeat(np.arange(len(keys)), high - low)
        old_index = order[
            np.arange(len(fresh)) - np.repeat(np.cumsum(high - low) - high, high - low)
        ]
        way = lengths(places[fresh] - old[old_index, 2:5])
        mine, theirs = _least(fresh, old_index, way), _least(old_index, fresh, way)
        nearest = np.zeros((2, len(way)), dtype=bool)
        nearest[0, mine] = nearest[1, theirs] = True
        both = np.flatnonzero(nearest[0] & nearest[1])
        both = both[way[both] < SAME_PLACE * contacts.size[fresh[both]]]
        start[fresh[both]] = (contacts.frames[fresh[both]] @ old[old_index[both], 5:, None])[
            :, :, 0
        ]
        return start


def _least(group: np.ndarray, other: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return the entry of each group with the shortest distance.

    Of equal ones, the one with the least `other`.
    """
    order = np.lexsort((other, way, group))
    return order[np.diff(group[order], prepend=-1) > 0]


def _places(contacts: Contacts, bodies: BodyStates) -> np.ndarray:
    """Return contact points in the axes of their first bodies [m], shape (k, 3)."""
    arms = contacts.point - bodies.position[contacts.first]
    return np.asarray((arms[:, None] @ bodies.rotation[contacts.first])[:, 0])


def jacobian(
    first: np.ndarray, second: np.ndarray, one: np.ndarray, other: np.ndarray, bodies: int
) -> csr_array:
    """Return the Jacobian J of pairs, shape (k rows, q bodies).

    Args:
        first: first body of each pair, shape (k,).
        second: the other body, `bodies` for an obstacle.
        one: rows for the first body, shape (k, rows, q).
        other: rows for the second body.
        bodies: number of bodies.
    """
    k, rows, q = one.shape
    blocks, places = (
        np.stack([one, other], axis=1).reshape(2 * k, rows, q),
        np.stack([first, second], axis=1).ravel(),
    )
    return csr_array(
        bsr_array(
            (blocks, places, 2 * np.arange(k + 1)), shape=(k * rows, (bodies + 1) * q)
        ).tocsr()[:, : bodies * q]
    )


def contact_frames(
    normal: np.ndarray, dimension: int, ways: Sequence[tuple[np.ndarray, float]] = ()
) -> np.ndarray:
    """Return normal and tangents of contacts, shape (k, dimension, 3).

    Right-handed in space. There the first tangent is along the last of `ways` that is longer than
    its least length: the friction box is then as wide as the cone in that direction.
    """
    if dimension == 2:
        return np.stack(
            [normal, np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)], axis=1
        )
    u = cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    for way, least in ways:
        along = way - (way * normal).sum(axis=1)[:, None] * normal
        u = np.where((lengths(along) > least)[:, None], along, u)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([normal, u, cross(normal, u)], axis=1)
