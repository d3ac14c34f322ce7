"""Sources, drains and open sides: inflow at a given velocity, and outflow."""

import itertools
import math
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.grid.particles import MARGIN, Particles
from warp_lcp.grid.sides import mark_gone
from warp_lcp.grid.solids import Geometry
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.material import sources_kernels as kernels
from warp_lcp.material.boundary import Boundary, Faces
from warp_lcp.operators.grid_poisson import SOLID
from warp_lcp.rows.compiler import forward_kernel
from warp_lcp.rows.program import LaunchGraph

NOW = 1e-9  # s: a time that a step has been cut to may be off by its rounding
GRAZED = 1e-9  # of a way: less than that in a cell is rounding
FILLED = 0.5  # of a full cell's particles: a source that starts fills cells that hold fewer
JAMMED = 2.0  # cells that hold more than this share get no more


@dataclass(frozen=True)
class Source:
    """Inflow region.

    Args:
        name: what messages call it.
        contains: returns which points [m], shape (n, 3), lie in it, shape (n,).
        velocity: of its material [m/s], shape (3,), not 0.
        start: when it starts to run [s].
        stop: when it no longer does [s].
        kept: number carried by its particles; None: none.
    """

    name: str
    contains: Callable[[np.ndarray], np.ndarray]
    velocity: np.ndarray
    start: float = 0.0
    stop: float = np.inf
    kept: float | None = None

    def runs(self, time: float) -> bool:
        """Return whether the source runs from `time` [s] on."""
        return self.start <= time + NOW < self.stop


class Sources:
    """Inflow through the cells whose centers lie in a source.

    The area of the inflow is that of the cells' faces.

    While a source runs, the faces of its cells have its velocity, and the pressure sees the cells as a solid that moves at it: what leaves
    them is area times velocity, whatever is in the way. Material behind a source is not drawn in. Particles lie on a jittered lattice that
    moves with the source; those that the lattice brings into the cells in a step are new. It is a function of time alone, so that an
    resumed run is bitwise identical. A source that starts fills its cells, unless they are full already.

    A step need not end where a source starts or stops. What comes in is what the lattice brings in from start to stop, to the particle,
    however the time is cut into steps; the flow has the source's velocity in the steps in whose middle it runs.

    Args:
        grid: the grid.
        boundary: solids and walls; with whole cells it has velocities.
        sources: a cell belongs to the first that contains its center.
        per_axis: particles along the edge of a cell.
        jitter: width of their random displacement, a fraction of their distance.
        random_seed: of the displacements.

    Raises:
        ValueError: a source has no open cell.
    """

    def __init__(
        self, grid: StaggeredGrid, boundary: Boundary, sources: Sequence[Source], *, per_axis: int, jitter: float, random_seed: int
    ) -> None:
        self.grid, self.boundary, self.sources = grid, boundary, tuple(sources)
        self.per_axis, self.jitter, self.random_seed = per_axis, jitter, random_seed
        owner = _owners(grid, boundary, self.sources)
        self._cells = cells = np.argwhere(owner >= 0)  # (k, j, i) from 0
        self._slots = np.zeros(grid.shape, dtype=np.int32)
        self._slots[tuple((cells + 1).T)] = np.arange(1, len(cells) + 1)
        self._owner = owner[tuple(cells.T)].astype(np.int32)
        self._check_cells(np.bincount(self._owner, minlength=len(self.sources)))
        self._emits = np.ones(1 + len(cells), dtype=bool)  # by slot
        self._boxes = [self._box(cells[self._owner == number]) for number in range(len(self.sources))]
        device = grid.device
        self._fields = [
            wp.array(self._slots, dtype=wp.int32, device=device),
            wp.array(self._owner, dtype=wp.int32, device=device),
            wp.zeros(len(self.sources), dtype=wp.uint8, device=device),
        ]
        velocities = np.array([source.velocity for source in self.sources], dtype=np.float32)
        self._velocities = wp.array(velocities, dtype=wp.vec3, device=device)
        self._counts = wp.zeros(len(cells), dtype=wp.int32, device=device)
        self._window: Window | None = None
        if len(cells):
            self._window = grid.window((cells.min(axis=0) + 1)[::-1], (cells.max(axis=0) + 1)[::-1], grow=1)
        self._moving_walls = boundary.velocity if not boundary.open else []
        self._running: list[bool] | None = None  # what the device knows of it
        self._imposing = LaunchGraph(device, self._impose)

    def top_speed(self, time: float, span: float) -> float:
        """Return the largest speed of sources that run in a time span [m/s].

        From `time` to `time` + `span` [s].
        """
        return max((float(np.linalg.norm(s.velocity)) for s in self.sources if s.start <= time + span and s.stop > time), default=0.0)

    def supply(self, time: float, velocity: Faces, kind: wp.array) -> None:
        """Set the velocity of running sources on faces; close their cells to the pressure.

        Before the pressure solve.

        Args:
            time: in the middle of the step [s].
            velocity: u* of each component [m/s] (updated).
            kind: int8 of AIR, FLUID, SOLID (updated).
        """
        running = [source.runs(time) for source in self.sources]
        if running != self._running:
            self._fields[2].assign(np.array(running, dtype=np.uint8))
            self._running = running
        self._imposing.run(velocity, [], kind, True, variant=(velocity[0].ptr, 0, kind.ptr, True))

    def hold(self, velocity: Faces, known: Faces, shown: wp.array | None = None) -> None:
        """Set the velocity of the running sources again.

        Of those that `supply` found.

        Args:
            velocity: of each component [m/s] (updated).
            known: int8 of each component (updated): 1 on those faces; or empty.
            shown: int8 (updated): the sources' cells become FLUID.
        """
        own = velocity[0].ptr, known[0].ptr if known else 0, 0 if shown is None else shown.ptr
        self._imposing.run(velocity, known, shown, False, variant=(*own, False))

    def emit(self, particles: Particles, before: float | None, now: float) -> int:
        """Add the incoming particles and return their number.

        Args:
            particles: the material (updated).
            before: at the start of the step [s]; None: there has been no step.
            now: at its end [s].
        """
        since = now if before is None else before
        running = [number for number, source in enumerate(self.sources) if source.start <= now + NOW and source.stop > since + NOW]
        if not running:
            return 0
        held = self._occupants(particles) / self.per_axis**self.grid.dimension
        emitted = 0
        for number in running:
            source = self.sources[number]
            if self._boxes[number] is None:
                continue
            starts = before is None or source.start > before + NOW
            points = self._points(number, min(max(since, source.start), now) if starts else since, now, held, starts=starts)
            particles.append(points, np.broadcast_to(source.velocity.astype(np.float32), points.shape), source.kept)
            emitted += len(points)
        return emitted

    def _check_cells(self, counts: np.ndarray) -> None:
        """Refuse sources without an open cell, given how many each has."""
        for source, count in zip(self.sources, counts, strict=True):
            if count == 0:
                raise ValueError(
                    f"{source.name} holds no open cell's center: it is too small for cells of {self.grid.spacing:.4g} m, or lies in "
                    "solids, outside the domain or in an earlier source"
                )

    def _occupants(self, particles: Particles) -> np.ndarray:
        """Return how many particles each cell holds."""
        self._counts.zero_()
        numbers = [1.0 / self.grid.spacing, wp.vec3i(*self.grid.counts), wp.vec3i(*self.grid.origin)]
        inputs = [*numbers, self._fields[0], particles.position, self._counts]
        wp.launch(kernels.occupants_kernel, particles.count, inputs, device=self.grid.device)
        return np.asarray(self._counts.numpy())

    def _points(self, number: int, since: float, now: float, held: np.ndarray, *, starts: bool) -> np.ndarray:
        """Return where the points are [m] that a source's lattice has brought in since a time [s].

        If the source starts then, those that fill cells are among them. Some have left the cells again.
        """
        until = min(now, self.sources[number].stop)
        lattice, jitter = self._lattice(number, since, until)
        filled, slot, entries = self._entries(number, *(self._at(number, lattice, jitter, time) for time in (since, until)))
        new = np.where(self._emits[slot] & (held[np.maximum(slot, 1) - 1] < JAMMED), entries, 0)
        if starts:
            new += (filled > 0) & self._emits[filled] & (held[np.maximum(filled, 1) - 1] < FILLED)
        lattice, jitter = np.repeat(lattice, new, axis=0), np.repeat(jitter, new, axis=0)
        points = self._at(number, lattice, jitter, now).astype(np.float32)
        dx, axes = self.grid.spacing, slice(self.grid.dimension)
        size = self.grid.extent[axes]
        np.clip(points[:, axes], 1.1 * MARGIN * dx, size - 1.1 * MARGIN * dx, out=points[:, axes])
        return points[self.boundary.admits(points)] if len(points) else points

    def _lattice(self, number: int, since: float, until: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of the points that may lie in a source's cells between two times, shape (n, 3), and their displacements."""
        distance, dimension = self.grid.spacing / self.per_axis, self.grid.dimension
        ways, box = (self._way(number, since), self._way(number, until)), self._boxes[number]
        assert box is not None, "a source without cells here emits nothing"
        lows, highs = (box[0] - np.maximum(*ways)) / distance, (box[1] - np.minimum(*ways)) / distance
        ranges = [np.arange(np.floor(low) - 1, np.ceil(high) + 1) for low, high in zip(lows, highs, strict=True)]
        if dimension == 2:
            ranges[2] = np.zeros(1)
        Z, Y, X = np.meshgrid(ranges[2], ranges[1], ranges[0], indexing="ij")
        lattice = np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)
        return lattice, self.jitter * (_uniform(lattice, self.random_seed + number) - 0.5)

    def _at(self, number: int, lattice: np.ndarray, jitter: np.ndarray, time: float) -> np.ndarray:
        """Return where lattice points are at a time [m]."""
        points = (lattice + 0.5 + jitter) * (self.grid.spacing / self.per_axis) + self._way(number, time)
        if self.grid.dimension == 2:
            points[:, 2] = 0.0
        return np.asarray(points)

    def _way(self, number: int, time: float) -> np.ndarray:
        source = self.sources[number]
        return np.asarray(source.velocity * (time - source.start), dtype=np.float64)

    def _slot(self, points: np.ndarray, number: int) -> np.ndarray:
        """Return the slot of the source's cell that each point lies in, 0 if it lies in none."""
        cells = np.floor(points / self.grid.spacing).astype(np.int64) + 1 - np.array(self.grid.origin)
        if self.grid.dimension == 2:
            cells[:, 2] = 1
        np.clip(cells, 0, np.array(self.grid.shape[::-1]) - 1, out=cells)
        slot = self._slots[cells[:, 2], cells[:, 1], cells[:, 0]]
        return np.where((slot > 0) & (self._owner[np.maximum(slot, 1) - 1] == number), slot, 0)

    def _entries(self, number: int, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Follow points [m], which all go the same straight way, through a source's cells.

        Returns:
            The slots that they are in at first, those that they have come into last, and how often they have come in.
        """
        filled = here = self._slot(first, number)
        slot, entries = np.zeros_like(here), np.zeros(len(here), dtype=np.int64)
        begin, way = first / self.grid.spacing, (last[0] - first[0]) / self.grid.spacing
        crossings = [np.zeros(len(first)), np.ones(len(first))]  # shares of the way between which it stays in one cell
        for axis in np.flatnonzero(way):
            plane = (np.floor if way[axis] > 0.0 else np.ceil)(begin[:, axis]) - begin[:, axis]
            crossings += [(plane + n * np.sign(way[axis])) / way[axis] for n in range(1, math.ceil(abs(way[axis])) + 1)]
        ordered = np.sort(np.clip(crossings, 0.0, 1.0), axis=0)
        middles = ((first + (0.5 * (a + b))[:, None] * (last - first), b - a > GRAZED) for a, b in itertools.pairwise(ordered))
        for points, counts in itertools.chain(middles, [(last, True)]):
            there = np.where(counts, self._slot(points, number), here)
            comes = (here == 0) & (there > 0)
            slot, entries, here = np.where(comes, there, slot), entries + comes, there
        return filled, slot, entries

    def _box(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the low and the high corner [m] of cells (k, j, i); None: there are none."""
        if not len(cells):
            return None
        low, high = (corner[::-1] + np.array(self.grid.origin) for corner in (cells.min(axis=0), cells.max(axis=0) + 1))
        return low * self.grid.spacing, high * self.grid.spacing

    def _impose(self, velocity: Faces, known: Faces, cells: wp.array | None, supply: bool) -> None:
        """Launch what `supply` does, or what `hold` does."""
        walls = self._moving_walls if supply else []
        if self._window is None:
            return
        for axis, field in enumerate(velocity):
            given = [field, walls[axis] if walls else None, known[axis] if known else None]
            self._window.launch(kernels.impose_kernel, [axis, int(supply), *self._fields, self._velocities, *given])
        if cells is not None:
            self._window.launch(kernels.occupy_kernel, [*self._fields, int(not supply), cells])


def _owners(grid: StaggeredGrid, boundary: Boundary, sources: Sequence[Source]) -> np.ndarray:
    """Return the source that each open cell belongs to, -1 for none, shape (nz, ny, nx)."""
    nz, ny, nx = (n - 2 for n in grid.shape)
    K, J, I = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    centers = (np.stack([I.ravel(), J.ravel(), K.ravel()], axis=1) + np.array(grid.origin) + 0.5) * grid.spacing
    if grid.dimension == 2:
        centers[:, 2] = 0.0
    owner = np.full(len(centers), -1)
    free = (grid.interior(boundary.base.numpy()) != SOLID).ravel()
    for number, source in enumerate(sources):
        mine = free & (owner < 0)
        mine[mine] = source.contains(centers[mine])
        owner[mine] = number
    return owner.reshape(nz, ny, nx)


def _uniform(lattice: np.ndarray, seed: int) -> np.ndarray:
    """Return a number in [0, 1) for each coordinate that depends on nothing but the lattice point and the seed."""
    # the finalizer of SplitMix64 after each word
    state = np.full(len(lattice), (seed * 0x9E3779B97F4A7C15 + 1) % 2**64, dtype=np.uint64)
    words = [*lattice.astype(np.int64).astype(np.uint64).T]
    with np.errstate(over="ignore"):
        for word in words:
            state = _mixed(state ^ word)
        columns = [_mixed(state + np.uint64((axis + 1) * 0x9E3779B97F4A7C15 % 2**64)) for axis in range(3)]
    return np.stack(columns, axis=1).astype(np.float64) / 2.0**64


def _mixed(word: np.ndarray) -> np.ndarray:
    word = word + np.uint64(0x9E3779B97F4A7C15)
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))


@forward_kernel(module="warp_lcp.material.outlets")
@typing.no_type_check
def mark_inside_kernel(distance: wp.array(dtype=wp.float32), marks: wp.array(dtype=wp.int32)):
    """Mark particles at a negative distance."""
    p = wp.tid()
    if distance[p] < 0.0:
        marks[p] = 1


@dataclass(frozen=True)
class Drain:
    """Region that removes material.

    Args:
        geometry: the region.
        start: when it opens [s].
        stop: when it closes [s].
    """

    geometry: Geometry
    start: float = 0.0
    stop: float = np.inf

    def opens(self, before: float, now: float) -> bool:
        """Return whether the drain is open after `before` and up to `now` [s]."""
        return self.start <= now + NOW and before + NOW < self.stop


class Outlets:
    """Drains and open sides, which remove particles.

    A drain acts at the end of each step in part of which it is open, however small that part is.

    Args:
        grid: the grid.
        drains: regions that swallow material.
        open_sides: of the domain, see `warp_lcp.grid.sides.side_bits`.
    """

    def __init__(self, grid: StaggeredGrid, drains: Sequence[Drain], open_sides: int) -> None:
        self.grid, self.drains, self.open_sides = grid, tuple(drains), open_sides
        self._distance = wp.zeros(0, dtype=wp.float32, device=grid.device)

    def apply(self, particles: Particles, before: float, now: float) -> tuple[int, int]:
        """Remove particles; the others keep their order.

        Args:
            particles: the material (updated).
            before: at the start of the step [s].
            now: at its end [s].

        Returns:
            How many drains have swallowed, and how many have left through open sides.
        """
        departed, drained = self.remove_departed(particles), 0
        drains = [drain for drain in self.drains if drain.opens(before, now)]
        if drains and particles.count:
            marks = particles.marks
            marks.zero_()
            if len(self._distance) < particles.count:
                self._distance = wp.zeros(particles.capacity, dtype=wp.float32, device=self.grid.device)
            for drain in drains:
                distance = self._distance[: particles.count]
                drain.geometry.signed_distance(particles.position, distance)
                wp.launch(mark_inside_kernel, particles.count, [distance, marks], device=self.grid.device)
            drained = particles.remove(marks)
        return drained, departed

    def remove_departed(self, particles: Particles) -> int:
        """Remove particles beyond open sides; return their number."""
        if not (self.open_sides and particles.count):
            return 0
        marks = particles.marks
        mark_gone(self.grid, self.open_sides, particles.position, marks)
        return particles.remove(marks)
