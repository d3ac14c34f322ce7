"""Particles that belong to the rank whose box they are in: they move on to others, and cells at a cut know those beside them.

In a step a rank has its own particles and copies of those within a cell of its box, ghosts; then its own alone. Sums take all in one order
that does not depend on the ranks, so that those around a face have the same bits on any number of ranks: that of the last sort by cell,
which a number stands for, the particle's `place`. Until the next sort ghosts lie behind the others, and what comes takes the room of what
goes: `runs` tell the order. Messages go from rank to rank: their lengths change from step to step, so that a star forest would have to be
made anew each time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.distributed.decomposition import CellBox
from warp_lcp.distributed.particle_pieces import cells_of
from warp_lcp.distributed.place_order import PlaceOrder
from warp_lcp.grid.part import ParticleExchange
from warp_lcp.grid.particle_loops import launch
from warp_lcp.grid.particles import MOST_A_CELL, NEW, Particles, ParticleTotals
from warp_lcp.rows import KernelFile

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain

INNER, BORDER, OUTSIDE = 0, 1, 2  # of a box: in it and away from its cuts, within reach of them, beyond them
KERNELS = KernelFile(Path(__file__).parent / "headers/distributed.h")
WHERE = KERNELS["warp_lcp.distributed.particles.where"]


REACH = 1  # cells from a box within which particles touch its faces and cells
ROOM = 1.25  # of the storage over the particles at the start: ghosts come before the first step
ENDLESS = 1e30  # a coordinate beyond all


class ParticleMigration(ParticleExchange):
    """The particles of a rank among those of all.

    Args:
        part: where this rank works.
        particles: this rank's, in its box or within its ghost layers.

    Attributes:
        place: int64, shape (count,): where each particle is in the order of all ranks' particles.
    """

    place: np.ndarray

    def __init__(self, part: Subdomain, particles: Particles) -> None:
        super().__init__(particles)
        self.place = np.empty(0, dtype=np.int64)
        self._counts: list[int] = []
        self._expected = 0
        self._added = 0  # by this rank since the last totals
        self.move_to(part)

    def move_to(self, part: Subdomain) -> None:  # type: ignore[override]
        """Belong to another box from now on; `assign` then brings what lies in it."""
        self.part, decomposition, around = part, part.decomposition, part.box.grown(REACH)
        self._own: np.ndarray | int | None = None  # which particles are this rank's, or how many of the first; None: all
        self._lying: PlaceOrder | None = None  # of those of this rank; None: not known
        self._neighbors = [r for r, box in enumerate(decomposition.boxes) if r != part.ranks.rank and decomposition.meet(box, around)]
        self._end = _beyond(decomposition.counts, part.grid.spacing)
        if self._neighbors:
            self.room = ROOM

    @property
    def counts(self) -> list[int]:
        """Particles of each rank when the last totals found them."""
        return self._counts

    @property
    def expected(self) -> int:
        """How many particles all ranks had before the last totals, with those that had been added and removed since then."""
        return self._expected

    def state(self) -> dict[str, np.ndarray]:
        """Return `place`."""
        return {"place": self.place.copy()}

    def arrange(self, *, sort: bool) -> None:
        """Hand particles that have left the box to their ranks, take in those that came, with ghosts, and bring all into order."""
        self.drop_ghosts()
        self.particles.number()
        if self._neighbors:
            self._exchange()
        if sort:
            self.particles.sort()
        elif self._neighbors:
            self.particles.number()
            self._find_runs()

    def look_around(self) -> None:
        """Let ghosts be there with their positions alone; own particles stay this rank's, wherever they are."""
        if self.particles.offsets is not None:
            self.arrange(sort=True)
        elif self._neighbors:
            self.drop_ghosts()
            self.particles.number()
            self._own = self.particles.count
            self._swap(np.flatnonzero(self._where() != INNER), ["position"])
            self._find_runs()

    @contextmanager
    def with_ghosts(self, step: int) -> Iterator[None]:
        """Let the particles around this rank's box be there, arranged as in a step of this number."""
        self.particles.arrange(step)
        self._lie_in_order()
        yield
        self.drop_ghosts()

    def _exchange(self) -> None:
        """Hand over and take in, and put ghosts behind the others."""
        particles = self.particles
        first, border = particles.count, np.flatnonzero(self._where() != INNER)
        cells = self._swap(border, list(particles.arrays()))
        out, near = ~_within(cells, self.part.box), _within(cells, self.part.box.grown(REACH))
        come = first + np.flatnonzero(self._where(first) == OUTSIDE)
        others, ghosts = np.append(border[out], come), np.append(border[out & near], come)
        count, end = particles.count - len(others), particles.count - len(others) + len(ghosts)
        own, there = np.ones(particles.count - count, dtype=bool), np.zeros(len(ghosts), dtype=bool)  # of the numbers from `count` on
        own[others[others >= count] - count] = False
        stay = (ghosts >= count) & (ghosts < end)
        there[ghosts[stay] - count] = True
        free, last = others[others < count], count + np.flatnonzero(own)
        sources, targets = np.append(last, ghosts[~stay]), np.append(free, count + np.flatnonzero(~there))
        particles.move(sources, targets)
        self.place[targets] = self.place[sources]
        particles.resize(end)
        self.place, self._own = self.place[:end], count
        if self._lying is not None:
            self._lying = self._lying.changed(free, first, count)

    def _find_runs(self) -> None:
        """Find the order in which sums take the particles, of which the first are this rank's."""
        assert isinstance(self._own, int), "ghosts lie behind the others"
        if self._lying is None:
            self._order_first(self._own)
            self._lying = PlaceOrder(self.place[: self._own])
        runs = self._lying.runs(self.place, self._own)
        self.particles.set_runs(wp.array(runs, dtype=wp.int32, device=self.part.grid.device))

    def _order_first(self, count: int) -> None:
        """Bring the first particles into the order of their places, of which others have been added or gone."""
        place = self.place[:count]
        if (place[1:] < place[:-1]).any():
            self._take(np.append(np.argsort(place, kind="stable"), np.arange(count, self.particles.count)))
            self.particles.number()

    def _take(self, order: np.ndarray) -> None:
        """Keep the particles of these numbers, in this order."""
        self.particles.take(order)
        self.place = self.place[order]

    def _lie_in_order(self) -> None:
        """Bring the particles into the order in which sums take them, ghosts among them."""
        self._order_first(self.particles.count)
        if self._own is not None:
            self._own = self._where() != OUTSIDE
        self._lying = self.particles.runs = None

    def begin_sort(self) -> None:
        """Bring the particles into the order of their places."""
        self._lie_in_order()

    def end_sort(self) -> None:
        """Give the particles, which lie in the order of their cells, new places."""
        count = self.particles.count
        if self._own is not None:
            self._own = self._where() != OUTSIDE
        nx, ny, _ = self.part.decomposition.counts
        key, begins = self.particles.key.numpy()[:count], np.ones(count, dtype=bool)
        begins[1:] = key[1:] != key[:-1]
        starts = np.flatnonzero(begins)
        i, j, k = self._cells(starts).astype(np.int64) % np.array(self.part.decomposition.counts)[:, None]
        first = ((k * ny + j) * nx + i) * MOST_A_CELL
        self.place = np.repeat(first - starts, np.diff(starts, append=count))
        self.place += np.arange(count)

    def next_place(self) -> int:
        """Return a place behind those of all ranks' particles, when this rank's own are there alone, numbered; collective."""
        self.drop_ghosts()
        self.particles.number()
        return max(NEW, 1 + int(self.part.ranks.max(self.place.max(initial=0))))

    def count(self) -> None:
        """Count the particles of all ranks; collective."""
        self._counts, self._added = self.part.ranks.gather(self.particles.count).ravel().tolist(), 0
        self._expected = sum(self._counts)

    def appended(self, count: int) -> None:
        """Give particles behind the others places behind theirs."""
        self.add_places(max(NEW, 1 + int(self.place.max(initial=0))) + np.arange(count))

    def add_places(self, places: np.ndarray) -> None:
        """Give particles behind the others their places."""
        self.place, self._lying = np.append(self.place, places), None
        self._added += len(places)

    def removing(self, marks: wp.array) -> None:
        """Forget the places of particles that are about to be removed."""
        before = len(self.place)
        self.place, self._lying = self.place[marks.numpy()[: self.particles.count] == 0], None
        self._added += len(self.place) - before

    def drop_ghosts(self) -> None:
        """Keep this rank's own particles alone; `key` then holds their cells."""
        mine, self._own, self.particles.runs = self._own, None, None
        if isinstance(mine, int):
            self.particles.resize(mine)
            self.place = self.place[:mine]
        elif mine is not None:
            self._take(np.flatnonzero(mine))
            self.particles.number()
            self._lying = PlaceOrder(self.place)

    def joined_totals(self, own: ParticleTotals) -> ParticleTotals:
        """Return sums over all ranks' particles; there are no ghosts now."""
        assert self._own is None, "ghosts would be counted twice"
        n, ranks = own.count, self.part.ranks
        before, added, self._added = sum(self._counts), self._added, 0
        if ranks.size == 1:
            self._counts, self._expected = [n], before + added
            return own
        ends = own.max_speed, *(-own.low if n else [-np.inf] * 3), *(own.high if n else [-np.inf] * 3)
        with np.errstate(invalid="ignore"):
            means = n * own.mean_square_speed, *(n * own.center), *(n * own.velocity)
            everyone = ranks.gather(np.array([n, own.bad_positions, own.bad_velocities, *means, added, *ends]))
        sums, most, self._counts = everyone.sum(axis=0), everyone[:, -7:].max(axis=0), everyone[:, 0].astype(np.int64).tolist()
        count, self._expected = int(sums[0]), before + int(sums[10])
        if count == 0:
            return own
        return ParticleTotals(
            count=count, mean_square_speed=float(sums[3]) / count, velocity=sums[7:10] / count, center=sums[4:7] / count, low=-most[1:4],
            high=most[4:7], max_speed=float(most[0]), bad_positions=int(sums[1]), bad_velocities=int(sums[2]),
        )  # fmt: skip

    def assign(self, arrays: Mapping[str, np.ndarray], place: np.ndarray) -> None:
        """Take other particles, in the order of their places; collective."""
        self._own = self._lying = None
        super().assign(arrays, place)
        self.place = np.sort(np.asarray(place, dtype=np.int64))
        self.count()

    def _where(self, first: int = 0) -> np.ndarray:
        """Return INNER, BORDER or OUTSIDE of each particle from a number on, uint8, shape (count - first,)."""
        part, grid = self.part, self.part.grid
        bits = [[part.cuts >> 2 * axis + side & 1 for axis in range(3)] for side in range(2)]
        low = [box + 1 if cut else -ENDLESS for box, cut in zip(part.box.low, bits[0], strict=True)]
        high = [box + 1 if cut else ENDLESS for box, cut in zip(part.box.high, bits[1], strict=True)]
        low_x, low_y, low_z, high_x, high_y, high_z = map(float, low + high)
        found = wp.empty(self.particles.count - first, dtype=wp.uint8, device=grid.device)
        if len(found):
            ends = {"low_x": low_x, "low_y": low_y, "low_z": low_z, "high_x": high_x, "high_y": high_y, "high_z": high_z}
            position = self.particles.position[first:]
            launch(WHERE, len(found), grid, position=position, where=found, reach=float(REACH), **ends)
        return np.asarray(found.numpy())

    def _cells(self, which: np.ndarray) -> np.ndarray:
        """Return the cell (x, y, z) of the whole domain that some particles were last numbered in, shape (3, n)."""
        nx, ny, _ = (n + 2 for n in self.part.grid.counts)
        rows, i = np.divmod(self.particles.key.numpy()[: self.particles.count][which], nx)
        k, j = np.divmod(rows, ny)
        return np.stack([i, j, k]) + (np.array(self.part.grid.origin, dtype=np.int32) - 1)[:, None]

    def _swap(self, border: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Exchange columns of what neighbors must know: particles in their boxes and within a cell of them.

        Args:
            border: numbers of particles that may be.
            names: of the columns that come; what comes lies behind the others.

        Returns:
            The cells (x, y, z) of the whole domain that those of `border` lie in, shape (3, n).
        """
        joined = self.part.decomposition.joined  # who has gone around has come far
        cells = cells_of(self.part, self.particles.position.numpy()[border]).T if joined else self._cells(border)
        incoming = self.part.mailbox.swap({rank: self._seen_by(rank, border, cells, names) for rank in self._neighbors})
        if joined:
            incoming.append(self._seen_by(self.part.ranks.rank, border, cells, names))
        counts = [len(message) // (8 + 12 * len(names)) for message in incoming]
        first = self.particles.make_room(sum(counts))
        arrays = self.particles.arrays()

        def come(begin: int, end: int) -> np.ndarray:  # bytes of each particle
            return np.concatenate([message[begin * n : end * n] for message, n in zip(incoming, counts, strict=True)])

        if sum(counts):
            for column, name in enumerate(names):
                values = come(8 + 12 * column, 20 + 12 * column).view(np.float32).reshape(-1, 3)
                arrays[name][first:].assign(values)
        self.place = np.append(self.place, come(0, 8).view(np.int64))
        return cells

    def _seen_by(self, rank: int, border: np.ndarray, cells: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Return what a rank must know of, as bytes; arguments as of `_swap`.

        Where axes have no end, positions are those that continue what is in its box; of this rank, which has the others, those alone.
        """
        decomposition, arrays = self.part.decomposition, self.particles.arrays()
        columns = [arrays[name].numpy() for name in names]
        shifts, seen = decomposition.shifts[rank == self.part.ranks.rank :], decomposition.boxes[rank].grown(REACH)
        found = [border[_within(cells, seen.moved(shift, -1))] for shift in shifts]
        which = np.concatenate(found)
        columns = [column[which] for column in columns]
        if decomposition.joined:
            way, position = np.repeat(shifts, [len(part) for part in found], axis=0), columns[names.index("position")]
            position += way * self.part.grid.spacing
            np.maximum(position, self._end, out=position, where=way > 0)  # not inside by its rounding
        return np.concatenate([values.ravel().view(np.uint8) for values in (self.place[which], *columns)])


def _beyond(counts: Sequence[int], spacing: float) -> np.ndarray:
    """Return the least coordinates [m] for which kernels find the cell beyond the last along x, y, z, float32."""
    one, inverse = np.float32(1.0), np.float32(1.0 / spacing)
    end = np.array(counts, dtype=np.float32) * np.float32(spacing)
    while (short := end * inverse + one < np.array(counts, dtype=np.float32) + one).any():
        end[short] = np.nextafter(end[short], np.float32(np.inf))
    return end


def _within(cells: np.ndarray, box: CellBox) -> np.ndarray:
    """Tell which cells (x, y, z), shape (3, n), are in a box."""
    low, high = np.array([box.low, box.high], dtype=np.int32)[:, :, None]
    return np.asarray(((cells >= low) & (cells < high)).all(axis=0))
