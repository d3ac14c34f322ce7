"""Distributed particles: migration between ranks, and ghost particles at cuts.

A particle belongs to the rank of its box. In a step a rank has its own particles and copies of
those within a cell of its box, the ghosts; later its own alone. Sums over particles have one order
that does not depend on the ranks, so that sums at a face have the same bits on any number of ranks:
the order of the last sort by cell. A particle's number in that order is its `place`. Until the next
sort, ghosts are stored behind the others, and new particles take the memory of those that have
left: `runs` describe the order. Messages go from rank to rank. Their lengths change from step to
step, so a star forest would have to be rebuilt each time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.distributed.particle_messages import (
    KERNELS,
    REACH,
    Buffer,
    ParticleMessages,
    bounds_of,
)
from warp_lcp.distributed.summation_order import SummationOrder
from warp_lcp.grid.grid_part import ParticleExchange
from warp_lcp.grid.particle_loops import launch
from warp_lcp.grid.particles import MOST_A_CELL, NEW, Particles, ParticleTotals

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain

# Position relative to a box: in it and away from its cuts, within reach of them, beyond them.
INNER, BORDER, OUTSIDE = 0, 1, 2
WHERE = KERNELS["warp_lcp.distributed.particles.where"]
ROOM = 1.25  # storage relative to the particles at the start: ghosts come before the first step


class ParticleMigration(ParticleExchange):
    """The particles of a rank, as a part of the particles of all ranks.

    Args:
        part: the subdomain of this rank.
        particles: this rank's, in its box or within its ghost layers.
    """

    def __init__(self, part: Subdomain, particles: Particles) -> None:
        super().__init__(particles)
        self._places, self._placed = Buffer(wp.int64), 0
        self._counts: list[int] = []
        self._expected = 0
        self._added = 0  # particles added by this rank since the last totals
        self.move_to(part)

    def move_to(self, part: Subdomain) -> None:  # type: ignore[override]
        """Move to another box.

        `assign` then sets its particles.
        """
        self.part, decomposition, around = part, part.decomposition, part.box.grown(REACH)
        # Indices of this rank's own particles, or how many of the first; None: all.
        self._own: np.ndarray | int | None = None
        self._lying: SummationOrder | None = None  # order of this rank's particles; None: not known
        self._neighbors = [
            r
            for r, box in enumerate(decomposition.boxes)
            if r != part.ranks.rank and decomposition.boxes_overlap(box, around)
        ]
        self._messages = ParticleMessages(part, self.particles, self._places, self._neighbors)
        if self._neighbors:
            self.room = ROOM

    @property
    def place(self) -> np.ndarray:
        """Place of each particle in the order of all ranks, int64, shape (count,)."""
        return self._places.host[: self._placed]

    @place.setter
    def place(self, place: np.ndarray) -> None:
        self._places.store(place)
        self._placed = len(place)

    @property
    def counts(self) -> list[int]:
        """Number of particles of each rank at the last totals."""
        return self._counts

    @property
    def expected(self) -> int:
        """Number of particles of all ranks.

        It is the last total, with the particles added and removed since then.
        """
        return self._expected

    def state(self) -> dict[str, np.ndarray]:
        """Return `place`, the key of the order."""
        return {"place": self.place.copy()}

    def arrange(self, *, sort: bool) -> None:
        """Migrate particles to the ranks of their boxes, add ghosts, and sort.

        Particles that have left the box are sent; those that arrive, and ghosts, are brought into
        order.
        """
        self.drop_ghosts()
        if self._neighbors:
            self._exchange()
        if sort:
            self.particles.sort()
        else:
            self.particles.number()
            if self._neighbors:
                self._find_runs()

    def exchange_ghost_positions(self) -> None:
        """Make ghosts available with their positions alone.

        Own particles stay on this rank, wherever they are.
        """
        if self.particles.offsets is not None:
            self.arrange(sort=True)
        elif self._neighbors:
            self.drop_ghosts()
            self._own = self.particles.count
            self._placed += self._messages.exchange(positions_only=True)
            self._find_runs()

    @contextmanager
    def with_ghosts(self, step: int) -> Iterator[None]:
        """Restore the particles around this rank's box.

        They are arranged as in the step of this number.
        """
        self.particles.arrange(step)
        self._lie_in_order()
        yield
        self.drop_ghosts()

    def _exchange(self) -> None:
        """Migrate particles, and store ghosts behind the others."""
        first, come = self.particles.count, self._messages.exchange(positions_only=False)
        own, end, free = self._messages.settle(come)
        self.particles.resize(end)
        self._placed, self._own = end, own
        if self._lying is not None:
            self._lying = self._lying.changed(free, first, own)

    def _find_runs(self) -> None:
        """Compute the summation order of the particles.

        The first particles are this rank's.
        """
        assert isinstance(self._own, int), "ghosts lie behind the others"
        if self._lying is None:
            self._order_first(self._own)
            self._lying = SummationOrder(self.place[: self._own].copy())
        runs = self._lying.runs(self.place, self._own)
        self.particles.set_runs(wp.array(runs, dtype=wp.int32, device=self.part.grid.device))

    def _order_first(self, count: int) -> None:
        """Sort the first particles by place, after some were added or removed."""
        place = self.place[:count]
        if (place[1:] < place[:-1]).any():
            self._gather_rows(
                np.append(np.argsort(place, kind="stable"), np.arange(count, self.particles.count))
            )
            self.particles.number()

    def _gather_rows(self, order: np.ndarray) -> None:
        """Keep the particles of these numbers, in this order."""
        self.particles.gather_rows(order)
        self.place = self.place[order]

    def _lie_in_order(self) -> None:
        """Sort the particles, ghosts among them, into the summation order."""
        self._order_first(self.particles.count)
        if self._own is not None:
            self._own = self._where() != OUTSIDE
        self._lying = self.particles.runs = None

    def begin_sort(self) -> None:
        """Sort the particles by place."""
        self._lie_in_order()

    def end_sort(self) -> None:
        """Renumber the places of the particles, which are sorted by cell."""
        if self._own is not None:
            self._own = self._where() != OUTSIDE
        self._messages.give_places()
        self._placed = self.particles.count

    def next_place(self) -> int:
        """Return a place behind the particles of all ranks; collective.

        This rank has its own particles alone, numbered.
        """
        self.drop_ghosts()
        self.particles.number()
        return max(NEW, 1 + int(self.part.ranks.max(self.place.max(initial=0))))

    def last_cells(self, begin: int, behind: int = 0) -> np.ndarray:
        """Return the cell of each particle from an index on, from its place."""
        return (self.place[begin:] - behind) // MOST_A_CELL

    def count(self) -> None:
        """Count the particles of all ranks; collective."""
        self._counts, self._added = self.part.ranks.gather(self.particles.count).ravel().tolist(), 0
        self._expected = sum(self._counts)

    def register_append(self, count: int) -> None:
        """Assign the next places to new particles, which are stored behind the others."""
        self.add_places(max(NEW, 1 + int(self.place.max(initial=0))) + np.arange(count))

    def add_places(self, places: np.ndarray) -> None:
        """Set the places of particles stored behind the others."""
        self.place, self._lying = np.append(self.place, places), None
        self._added += len(places)

    def register_removal(self, marks: wp.array) -> None:
        """Drop the places of particles that are about to be removed."""
        before = len(self.place)
        self.place, self._lying = self.place[marks.numpy()[: self.particles.count] == 0], None
        self._added += len(self.place) - before

    def drop_ghosts(self) -> None:
        """Drop ghosts; `key` then holds the cells of this rank's own particles."""
        mine, self._own, self.particles.runs = self._own, None, None
        if isinstance(mine, int):
            self.particles.resize(mine)
            self._placed = mine
        elif mine is not None:
            self._gather_rows(np.flatnonzero(mine))
            self.particles.number()
            self._lying = SummationOrder(self.place.copy())

    def joined_totals(self, own_totals: ParticleTotals) -> ParticleTotals:
        """Return sums over all ranks' particles; there must be no ghosts."""
        assert self._own is None, "ghosts would be counted twice"
        n, ranks = own_totals.count, self.part.ranks
        before, added, self._added = sum(self._counts), self._added, 0
        if ranks.size == 1:
            self._counts, self._expected = [n], before + added
            return own_totals
        # One message: count, bad values, 7 means times the count, additions; then 7 maxima.
        own_values = np.full(18, -np.inf)
        own_values[:3], own_values[10] = (
            (n, own_totals.bad_positions, own_totals.bad_velocities),
            added,
        )
        own_values[3:10] = (
            own_totals.mean_square_speed,
            *own_totals.center.tolist(),
            *own_totals.velocity.tolist(),
        )
        own_values[11] = own_totals.max_speed
        if n:
            own_values[12:15], own_values[15:] = -own_totals.low, own_totals.high
        with np.errstate(invalid="ignore"):
            own_values[3:10] *= n
            everyone = ranks.gather(own_values)
        sums, most, self._counts = (
            everyone.sum(axis=0),
            everyone[:, -7:].max(axis=0),
            everyone[:, 0].astype(np.int64).tolist(),
        )
        count, self._expected = int(sums[0]), before + int(sums[10])
        if count == 0:
            return own_totals
        return ParticleTotals(
            count=count,
            mean_square_speed=float(sums[3]) / count,
            velocity=sums[7:10] / count,
            center=sums[4:7] / count,
            low=-most[1:4],
            high=most[4:7],
            max_speed=float(most[0]),
            bad_positions=int(sums[1]),
            bad_velocities=int(sums[2]),
        )

    def assign(self, arrays: Mapping[str, np.ndarray], place: np.ndarray) -> None:
        """Replace the particles, in the order of their places; collective."""
        self._own = self._lying = None
        super().assign(arrays, place)
        self.place = np.sort(np.asarray(place, dtype=np.int64))
        self.count()

    def _where(self) -> np.ndarray:
        """Return INNER, BORDER or OUTSIDE of each particle, uint8, shape (count,)."""
        grid, count = self.part.grid, self.particles.count
        inside = wp.empty(count, dtype=wp.uint8, device=grid.device)
        if count:
            launch(
                WHERE,
                count,
                grid,
                position=self.particles.position,
                where=inside,
                **bounds_of(self.part),
            )
        return np.asarray(inside.numpy())
