"""Particles that belong to the rank whose box they are in: they move on to others, and cells at a cut know those beside them.

In a step a rank has its own particles and copies of those within a cell of its box, ghosts; then its own alone. Sums take all in one order
that does not depend on the ranks, so that those around a face have the same bits on any number of ranks: that of the last sort by cell,
which a number stands for, the particle's `place`. Until the next sort ghosts lie behind the others, and what comes takes the room of what
goes: `runs` tell the order. Messages go from rank to rank: their lengths change from step to step, so that a star forest would have to be
made anew each time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_lcp.distributed.decomposition import CellBox
from warp_lcp.distributed.particle_pieces import cells_of
from warp_lcp.distributed.place_order import PlaceOrder
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.distributed.waiting import waiting
from warp_lcp.grid import particles_kernels as kernels
from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.particle_loops import launch
from warp_lcp.grid.particles import MOST_A_CELL, NEW, SORT_EVERY, UNSORTED, Particles, ParticleTotals
from warp_lcp.rows import KernelFile

INNER, BORDER, OUTSIDE = 0, 1, 2  # of a box: in it and away from its cuts, within reach of them, beyond them
KERNELS = KernelFile(Path(__file__).parent / "headers/distributed.h")
WHERE = KERNELS["warp_lcp.distributed.particles.where"]


REACH = 1  # cells from a box within which particles touch its faces and cells
ROOM = 1.25  # of the storage over the particles at the start: ghosts come before the first step
ENDLESS = 1e30  # a coordinate beyond all
COUNT, DATA = 7101, 7102  # tags of messages


class Post(Protocol):
    """Carries messages from each rank to its neighbors."""

    def swap(self, outgoing: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Return what the neighbors have sent, in the order of their ranks.

        Args:
            outgoing: an array of one type for every neighbor, of any length.
        """


class MpiPost:
    """Messages of MPI.

    Args:
        comm: of mpi4py.
    """

    def __init__(self, comm: Any) -> None:
        self._comm = comm

    def swap(self, outgoing: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Send lengths, then what is not empty."""
        from mpi4py import MPI

        neighbors, comm = sorted(outgoing), self._comm
        sizes = np.array([[len(outgoing[rank]) for rank in neighbors], [0] * len(neighbors)], dtype=np.int64)
        requests = [comm.Irecv(sizes[1, n : n + 1], rank, COUNT) for n, rank in enumerate(neighbors)]
        requests += [comm.Isend(sizes[0, n : n + 1], rank, COUNT) for n, rank in enumerate(neighbors)]
        with waiting("counts of migrating particles"):
            MPI.Request.Waitall(requests)
        kind = outgoing[neighbors[0]].dtype if neighbors else np.dtype(np.int64)
        incoming = [np.empty(int(size), dtype=kind) for size in sizes[1]]
        requests = [comm.Irecv([a.view(np.uint8), MPI.BYTE], rank, DATA) for a, rank in zip(incoming, neighbors, strict=True) if a.size]
        requests += [comm.Isend([outgoing[rank].view(np.uint8), MPI.BYTE], rank, DATA) for rank in neighbors if outgoing[rank].size]
        with waiting("particles"):
            MPI.Request.Waitall(requests)
        return incoming


class SharedParticles(Particles):
    """The particles of a rank.

    `totals` and `arrange` are collective.

    Args:
        part: where this rank works.
        position: [m], shape (n, 3), in this rank's box or within its ghost layers.
        velocity: [m/s], shape (n, 3).
        affine: also carry the gradient of each velocity component [1/s].
        kept: of `Particles`.
        place: int64, shape (n,), in what order particles of one cell are; None: as they come.
        indexed: of `Particles`.
        post: carries messages; MPI's if None.

    Attributes:
        place: int64, shape (count,): where each particle is in the order of all ranks' particles.
        post: carries messages.
        counts: particles of each rank when `totals` found them.

    Raises:
        ValueError: the shapes do not match.
    """

    def __init__(
        self, part: Subdomain, position: np.ndarray, velocity: np.ndarray, *, affine: bool, kept: np.ndarray | None = None,
        place: np.ndarray | None = None, indexed: bool | None = None, post: Post | None = None,
    ) -> None:  # fmt: skip
        self.post = post or MpiPost(part.ranks.comm)
        self._take_part(part)
        self.place = np.arange(len(position), dtype=np.int64) if place is None else np.asarray(place, dtype=np.int64)
        self._own: np.ndarray | int | None = None  # which particles are this rank's, or how many of the first; None: all
        self._lying: PlaceOrder | None = None  # of those of this rank; None: not known
        super().__init__(part.grid, position, velocity, affine=affine, kept=kept, indexed=indexed)

    def _take_part(self, part: Subdomain) -> None:
        self.part, decomposition, around = part, part.decomposition, part.box.grown(REACH)
        self._neighbors = [r for r, box in enumerate(decomposition.boxes) if r != part.ranks.rank and decomposition.meet(box, around)]
        self._end = _beyond(decomposition.counts, part.grid.spacing)
        if self._neighbors:
            self.room = ROOM

    def work_on(self, part: Subdomain) -> None:
        """Belong to another box from now on; `assign_with_places` then brings what lies in it."""
        self._own = self._lying = None
        self._take_part(part)

    def arrange(self, step: int) -> None:
        """Hand particles that have left the box to their ranks, take in those that came, with ghosts, and bring all into order."""
        self.drop_ghosts()
        self.number()
        due = self.offsets is not None or step % SORT_EVERY == 0
        if self._neighbors:
            self._exchange()
        if due:
            self.sort()
        elif self._neighbors:
            self.number()
            self._find_runs()

    def look_around(self) -> None:
        """Let ghosts be there with their positions alone; own particles stay this rank's, wherever they are."""
        if self.offsets is not None:
            self.arrange(UNSORTED)
        elif self._neighbors:
            self.drop_ghosts()
            self.number()
            self._own = self.count
            self._swap(np.flatnonzero(self._where() != INNER), ["position"])
            self._find_runs()

    def _exchange(self) -> None:
        """Hand over and take in, and put ghosts behind the others."""
        first, border = self.count, np.flatnonzero(self._where() != INNER)
        cells = self._swap(border, self._names)
        out, near = ~_within(cells, self.part.box), _within(cells, self.part.box.grown(REACH))
        come = first + np.flatnonzero(self._where(first) == OUTSIDE)
        others, ghosts = np.append(border[out], come), np.append(border[out & near], come)
        count, end = self.count - len(others), self.count - len(others) + len(ghosts)
        own, there = np.ones(self.count - count, dtype=bool), np.zeros(len(ghosts), dtype=bool)  # of the numbers from `count` on
        own[others[others >= count] - count] = False
        stay = (ghosts >= count) & (ghosts < end)
        there[ghosts[stay] - count] = True
        free, last = others[others < count], count + np.flatnonzero(own)
        self._move(np.append(last, ghosts[~stay]), np.append(free, count + np.flatnonzero(~there)))
        self._resize(end)
        self.place, self._own = self.place[: self.count], count
        if self._lying is not None:
            self._lying = self._lying.changed(free, first, count)

    def _find_runs(self) -> None:
        """Find the order in which sums take the particles, of which the first are this rank's."""
        assert isinstance(self._own, int), "ghosts lie behind the others"
        if self._lying is None:
            self._order_first(self._own)
            self._lying = PlaceOrder(self.place[: self._own])
        self.runs = wp.array(self._lying.runs(self.place, self._own), dtype=wp.int32, device=self.grid.device)
        self._memory.take(self.count, {"runs": self.runs})

    def _order_first(self, count: int) -> None:
        """Bring the first particles into the order of their places, of which others have been added or gone."""
        place = self.place[:count]
        if (place[1:] < place[:-1]).any():
            order = np.append(np.argsort(place, kind="stable"), np.arange(count, self.count))
            self._take(order, self.place[order])
            self.number()

    def lie_in_order(self) -> None:
        """Bring the particles into the order in which sums take them, ghosts among them."""
        self._order_first(self.count)
        if self._own is not None:
            self._own = self._where() != OUTSIDE
        self._lying = self.runs = None

    def sort(self) -> None:
        """Bring the particles into the order of their places, then into that of their cells, and give them new places."""
        self.lie_in_order()
        super().sort()
        if self._own is not None:
            self._own = self._where() != OUTSIDE
        nx, ny, _ = self.part.decomposition.counts
        key, begins = self.key.numpy()[: self.count], np.ones(self.count, dtype=bool)
        begins[1:] = key[1:] != key[:-1]
        starts = np.flatnonzero(begins)
        i, j, k = self._cells(starts).astype(np.int64) % np.array(self.part.decomposition.counts)[:, None]
        first = ((k * ny + j) * nx + i) * MOST_A_CELL
        self.place = np.repeat(first - starts, np.diff(starts, append=self.count))
        self.place += np.arange(self.count)

    def append(self, position: np.ndarray, velocity: np.ndarray, kept: np.ndarray | float | None = None) -> None:
        """Add particles behind the others, those of other ranks too; see the base class."""
        super().append(position, velocity, kept)
        first = max(NEW, 1 + int(self.place.max(initial=0)))
        self.add_places(first + np.arange(len(position)))

    def add_places(self, places: np.ndarray) -> None:
        """Give particles behind the others their places."""
        self.place, self._lying = np.append(self.place, places), None

    def finish_removal(self, marks: wp.array) -> tuple[int, int]:
        """End the removal of particles of this rank; see the base class."""
        count = self.count
        removed = super().finish_removal(marks)
        if self.count < count:
            self.place, self._lying = self.place[marks.numpy()[:count] == 0], None
        return removed

    def drop_ghosts(self) -> None:
        """Keep this rank's own particles alone."""
        mine, self._own, self.runs = self._own, None, None
        if isinstance(mine, int):
            self._resize(mine)
            self.place = self.place[:mine]
        elif mine is not None:
            order = np.flatnonzero(mine)
            self._take(order, self.place[order])
            self._lying = PlaceOrder(self.place)

    def cells_of(self, positions: np.ndarray) -> np.ndarray:
        """Return the interior cells of positions, see the base class; along axes without an end those that are nearest to the box."""
        cells, part = super().cells_of(positions), self.part
        for axis in part.decomposition.joined:
            count = part.decomposition.counts[axis]
            first = part.owned.low[2 - axis] - 1 - (count - part.box.counts[axis]) // 2
            cells[:, axis] = (cells[:, axis] - first) % count + first
        return cells

    def totals(self) -> ParticleTotals:
        """Return sums over all ranks' particles; there are no ghosts now."""
        assert self._own is None, "ghosts would be counted twice"
        mine, ranks = super().totals(), self.part.ranks
        self.counts = [mine.count]
        if ranks.size == 1:
            return mine
        n = mine.count
        ends = mine.max_speed, *(-mine.low if n else [-np.inf] * 3), *(mine.high if n else [-np.inf] * 3)
        with np.errstate(invalid="ignore"):
            means = n * mine.mean_square_speed, *(n * mine.center), *(n * mine.velocity)
            everyone = ranks.gather(np.array([n, mine.bad_positions, mine.bad_velocities, *means, *ends]))
        sums, most, self.counts = everyone.sum(axis=0), everyone[:, -7:].max(axis=0), everyone[:, 0].astype(np.int64).tolist()
        count = int(sums[0])
        if count == 0:
            return mine
        return ParticleTotals(
            count=count, mean_square_speed=float(sums[3]) / count, velocity=sums[7:10] / count, center=sums[4:7] / count, low=-most[1:4],
            high=most[4:7], max_speed=float(most[0]), bad_positions=int(sums[1]), bad_velocities=int(sums[2]),
        )  # fmt: skip

    def assign_with_places(self, arrays: Mapping[str, np.ndarray], place: np.ndarray) -> None:
        """Take other particles, in the order of their places.

        Args:
            arrays: float32 of shape (n, 3) for every name of `arrays`.
            place: int64, shape (n,).
        """
        self._own = self._lying = None
        order = np.argsort(place, kind="stable")
        self.assign({name: np.ascontiguousarray(values[order]) for name, values in arrays.items()})
        self.place = np.asarray(place, dtype=np.int64)[order]

    def _where(self, first: int = 0) -> np.ndarray:
        """Return INNER, BORDER or OUTSIDE of each particle from a number on, uint8, shape (count - first,)."""
        part, grid = self.part, self.grid
        bits = [[part.cuts >> 2 * axis + side & 1 for axis in range(3)] for side in range(2)]
        low = [box + 1 if cut else -ENDLESS for box, cut in zip(part.box.low, bits[0], strict=True)]
        high = [box + 1 if cut else ENDLESS for box, cut in zip(part.box.high, bits[1], strict=True)]
        low_x, low_y, low_z, high_x, high_y, high_z = map(float, low + high)
        found = wp.empty(self.count - first, dtype=wp.uint8, device=grid.device)
        if len(found):
            launch(
                WHERE, len(found), grid, position=self.position[first:], where=found, reach=float(REACH), low_x=low_x, low_y=low_y,
                low_z=low_z, high_x=high_x, high_y=high_y, high_z=high_z,
            )  # fmt: skip
        return np.asarray(found.numpy())

    def _cells(self, which: np.ndarray) -> np.ndarray:
        """Return the cell (x, y, z) of the whole domain that some particles were last numbered in, shape (3, n)."""
        nx, ny, _ = (n + 2 for n in self.grid.counts)
        rows, i = np.divmod(self.key.numpy()[: self.count][which], nx)
        k, j = np.divmod(rows, ny)
        return np.stack([i, j, k]) + (np.array(self.grid.origin, dtype=np.int32) - 1)[:, None]

    def _swap(self, border: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Exchange columns of what neighbors must know: particles in their boxes and within a cell of them.

        Args:
            border: numbers of particles that may be.
            names: of the columns that come; what comes lies behind the others.

        Returns:
            The cells (x, y, z) of the whole domain that those of `border` lie in, shape (3, n).
        """
        joined = self.part.decomposition.joined  # who has gone around has come far
        cells = cells_of(self.part, self.position.numpy()[border]).T if joined else self._cells(border)
        incoming = self.post.swap({rank: self._seen_by(rank, border, cells, names) for rank in self._neighbors})
        if joined:
            incoming.append(self._seen_by(self.part.ranks.rank, border, cells, names))
        counts = [len(message) // (8 + 12 * len(names)) for message in incoming]
        first = self.make_room(sum(counts))

        def come(begin: int, end: int) -> np.ndarray:  # bytes of each particle
            return np.concatenate([message[begin * n : end * n] for message, n in zip(incoming, counts, strict=True)])

        if sum(counts):
            for column, name in enumerate(names):
                values = come(8 + 12 * column, 20 + 12 * column).view(np.float32).reshape(-1, 3)
                self._columns[name].view[first:].assign(values)
        self.place = np.append(self.place, come(0, 8).view(np.int64))
        return cells

    def _seen_by(self, rank: int, border: np.ndarray, cells: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Return what a rank must know of, as bytes; arguments as of `_swap`.

        Where axes have no end, positions are those that continue what is in its box; of this rank, which has the others, those alone.
        """
        decomposition, columns = self.part.decomposition, [self._columns[name].view.numpy() for name in names]
        shifts, seen = decomposition.shifts[rank == self.part.ranks.rank :], decomposition.boxes[rank].grown(REACH)
        found = [border[_within(cells, seen.moved(shift, -1))] for shift in shifts]
        which = np.concatenate(found)
        columns = [column[which] for column in columns]
        if decomposition.joined:
            way, position = np.repeat(shifts, [len(part) for part in found], axis=0), columns[names.index("position")]
            position += way * self.grid.spacing
            np.maximum(position, self._end, out=position, where=way > 0)  # not inside by its rounding
        return np.concatenate([values.ravel().view(np.uint8) for values in (self.place[which], *columns)])

    def _move(self, sources: np.ndarray, targets: np.ndarray) -> None:
        """Bring particles of some numbers to where others are, or what is no longer wanted."""
        device = self.grid.device
        if len(sources):
            of, to = (wp.array(numbers, dtype=wp.int32, device=device) for numbers in (sources, targets))
            for column in self._columns.values():
                launch_list(kernels.reorder_kernel, len(sources), [of, column.view, self._spare.view], device=device, cost=4)
                launch_list(kernels.put_kernel, len(targets), [to, self._spare.view, column.view], device=device, cost=4)
            self.place[targets] = self.place[sources]

    def _take(self, order: np.ndarray, places: np.ndarray) -> None:
        """Keep the particles of these numbers, in this order."""
        device, count = self.grid.device, len(order)
        if count:
            numbers = wp.array(order.astype(np.int32, copy=False), dtype=wp.int32, device=device, copy=device.is_cuda)
            for name, column in self._columns.items():
                launch_list(kernels.reorder_kernel, count, [numbers, column.view, self._spare.view], device=device, cost=4)
                self._columns[name], self._spare = self._spare, column
        self._resize(count)
        self.place = places


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
