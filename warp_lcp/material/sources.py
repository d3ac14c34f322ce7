"""Sources, drains and open sides: inflow at a given velocity, and outflow."""

import math
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import launch_list, list_kernel
from warp_lcp.grid.domain_sides import mark_gone
from warp_lcp.grid.particle_loops import MARGIN, ListMemory, launch
from warp_lcp.grid.particles import GROWTH, Particles
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.launch_graph import LaunchGraph, clear
from warp_lcp.kernels.recorded_arguments import Slot
from warp_lcp.material import sources_kernels as kernels
from warp_lcp.material.boundary import Boundary, Faces
from warp_lcp.operators.grid_poisson import SOLID

NOW = 1e-9  # s: rounding error of a time at which a step ends
GRAZED = 1e-9  # fraction of a path: a shorter piece in a cell is rounding
FILLED = 0.5  # fraction of a full cell: a source that starts fills cells with less
GOLDEN_STEPS = 64  # steps of a fixed point iteration, each of which gains half a digit
JAMMED = 2.0  # fraction of a full cell: a cell with more gets no more particles


@dataclass(frozen=True)
class Source:
    """Inflow region.

    Args:
        name: name of the source in messages.
        contains: returns which points [m], shape (n, 3), lie in it, shape (n,).
        velocity: velocity of its material [m/s], shape (3,), not 0.
        start: when it starts to run [s].
        stop: when it no longer does [s].
        kept: number carried by its particles; None if they carry none.
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

    The area of the inflow is that of the cells' faces. While a source runs, the faces of its cells
    have its velocity, and the pressure treats the cells as a solid that moves at it: the outflow is
    area times velocity, whatever is in the way. Material behind a source is not drawn in.

    Particles lie on a lattice that moves with the source; those that the lattice moves into the
    cells in a step are new. The lattice is a function of time alone, so that a resumed run is
    bitwise identical. A source that starts fills its cells, unless they are full already.

    The lattice is sheared along the flow, see `lattice_shear`, and jittered across it. A lattice
    with layers across the flow would become rods when a falling sheet or jet is stretched.

    A step need not end where a source starts or stops. The particles that enter are exactly those
    that the lattice brings in from start to stop, however the time is divided into steps. The flow
    has the source's velocity in the steps in whose middle the source runs.

    Args:
        grid: the grid.
        boundary: solids and walls; with whole cells it has velocities.
        sources: a cell belongs to the first that contains its center.
        per_axis: particles along the edge of a cell.
        jitter: width of their random displacement across the flow, a fraction of their distance.
        random_seed: seed of the displacements.

    Raises:
        ValueError: a source has no open cell.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        sources: Sequence[Source],
        *,
        per_axis: int,
        jitter: float,
        random_seed: int,
    ) -> None:
        self.grid, self.boundary, self.sources = grid, boundary, tuple(sources)
        self.per_axis, self.jitter, self.random_seed = per_axis, jitter, random_seed
        owner = _owners(grid, boundary, self.sources)
        self._cells = cells = np.argwhere(owner >= 0)  # (k, j, i) from 0
        self._slots = np.zeros(grid.shape, dtype=np.int32)
        self._slots[tuple((cells + 1).T)] = np.arange(1, len(cells) + 1)
        self._owner = owner[tuple(cells.T)].astype(np.int32)
        part = grid.part
        self._check_cells(part.ranks.sum(np.bincount(self._owner, minlength=len(self.sources))))
        low, high = np.array(part.owned.low) - 1, np.array(part.owned.high) - 1
        # By slot: whether this process owns the cell.
        self._emits = np.append(True, ((cells >= low) & (cells < high)).all(axis=1))
        self._boxes = [
            self._box(cells[self._owner == number]) for number in range(len(self.sources))
        ]
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
            self._window = grid.window(
                (cells.min(axis=0) + 1)[::-1], (cells.max(axis=0) + 1)[::-1], grow=1
            )
        self._moving_walls = boundary.velocity if not boundary.open else []
        self._running: list[bool] | None = None  # values on the device; None if not set
        self._imposing, self._counting = (
            LaunchGraph(device, record) for record in (self._impose, self._count)
        )
        self._entering = LaunchGraph(device, self._enter)
        self._nothing = (
            *(np.zeros(0, dtype=np.int32) for _ in range(3)),
            np.zeros((0, 3), dtype=np.float32),
        )
        self._span = HostArray(14, wp.float64, device)  # see `particle_models.h`
        self._lattice, self._memory = ListMemory(device), zeros(0, wp.int32, device)
        self._points, self._found = (
            dict.fromkeys(("entries", "slot", "filled", "point"), zeros(0, wp.int32, device)),
            list[np.ndarray](),
        )

    def top_speed(self, time: float, span: float) -> float:
        """Return the largest speed of sources that run in a time span [m/s].

        From `time` to `time` + `span` [s].
        """
        return max(
            (
                float(np.linalg.norm(s.velocity))
                for s in self.sources
                if s.start <= time + span and s.stop > time
            ),
            default=0.0,
        )

    def supply(self, time: float, velocity: Faces, kind: wp.array) -> None:
        """Set the velocity of running sources on faces; close their cells to the pressure.

        Before the pressure solve.

        Args:
            time: time in the middle of the step [s].
            velocity: u* of each component [m/s] (updated).
            kind: int8 of AIR, FLUID, SOLID (updated).
        """
        running = [source.runs(time) for source in self.sources]
        if running != self._running:
            self._fields[2].assign(np.array(running, dtype=np.uint8))
            self._running = running
        self._imposing.run(velocity, [], kind, True, variant=(velocity[0].ptr, 0, kind.ptr, True))

    def impose_velocity(self, velocity: Faces, known: Faces, shown: wp.array | None = None) -> None:
        """Set the velocity of the running sources again.

        Of those that `supply` found.

        Args:
            velocity: velocity of each component [m/s] (updated).
            known: int8 of each component (updated): 1 on those faces; or empty.
            shown: int8 (updated): the sources' cells become FLUID.
        """
        own = velocity[0].ptr, known[0].ptr if known else 0, 0 if shown is None else shown.ptr
        self._imposing.run(velocity, known, shown, False, variant=(*own, False))

    def emit(self, particles: Particles, before: float | None, now: float) -> int:
        """Add the incoming particles, and return their number; collective.

        Each process adds those of its own cells.

        Args:
            particles: the material (updated).
            before: at the start of the step [s]; None if there has been no step.
            now: time at the end of the step [s].
        """
        since = now if before is None else before
        running = [
            number
            for number, source in enumerate(self.sources)
            if source.start <= now + NOW and source.stop > since + NOW
        ]
        if not running:
            return 0
        entered = []
        for number in running:
            start = self.sources[number].start
            starts = before is None or start > before + NOW
            swept = self._entered(
                number, min(max(since, start), now) if starts else since, now, starts=starts
            )
            if len(swept[-1]):
                entered.append((number, swept))
        if not entered and not self.grid.part.shared:  # ranks count together
            return 0
        held = self._occupants(particles) / self.per_axis**self.grid.dimension
        emitted = 0
        for number, swept in entered:
            source, points = self.sources[number], self._new(held, *swept)
            particles.append(
                points,
                np.broadcast_to(source.velocity.astype(np.float32), points.shape),
                source.kept,
            )
            emitted += len(points)
        return emitted

    def _check_cells(self, counts: np.ndarray) -> None:
        """Refuse sources without an open cell; `counts` are their open cells."""
        for source, count in zip(self.sources, counts, strict=True):
            if count == 0:
                raise ValueError(
                    f"{source.name} holds no open cell's center: it is too small for cells of "
                    f"{self.grid.spacing:.4g} m, or lies in "
                    "solids, outside the domain or in an earlier source"
                )

    def _occupants(self, particles: Particles) -> np.ndarray:
        """Return the number of particles in each cell, of all processes.

        Particles may have entered cells that another process owns.

        A cell's number in the whole domain is (k n_y + j) n_x + i. Each process collects the counts
        of all processes by this number, and adds those of its own source cells.
        """
        self._counting.run(particles)
        own_counts, part = np.asarray(self._counts.numpy()), self.grid.part
        if part.comm is None:
            return own_counts
        nx, ny, _ = self.grid.domain_counts
        k, j, i = (self._cells + np.array(self.grid.origin)[::-1]).T.astype(np.int64)
        cells = (k * ny + j) * nx + i
        found = np.flatnonzero(own_counts)
        all_counts = np.concatenate(
            part.ranks.collect(np.stack([cells[found], own_counts[found]])), axis=1
        )
        order = np.argsort(cells)
        place = np.searchsorted(cells[order], all_counts[0])
        known = place < len(cells)
        known[known] = cells[order][place[known]] == all_counts[0][known]
        total = np.zeros(len(cells), dtype=np.int64)
        np.add.at(total, order[place[known]], all_counts[1][known])
        return total

    def _count(self, particles: Particles) -> None:
        """Launch the count of the particles in each cell."""
        clear(self._counts)
        numbers = [
            1.0 / self.grid.spacing,
            wp.vec3i(*self.grid.counts),
            wp.vec3i(*self.grid.origin),
        ]
        inputs = [*numbers, self._fields[0], particles.position, self._counts]
        launch_list(
            kernels.occupants_kernel, particles.count, inputs, device=self.grid.device, ordered=True
        )

    def _entered(
        self, number: int, since: float, now: float, *, starts: bool
    ) -> tuple[np.ndarray, ...]:
        """Find the points that a source's lattice has brought in since a time [s].

        Returns:
            Of each point the slot of the cell that it has come into last, how often it came into
            one, and, if the source starts then, the slot of the cell that it was in at first, which
            are 0 for none; float32, shape (n, 3): where it is [m]. Some have left the cells again.
        """
        box, until = self._boxes[number], min(now, self.sources[number].stop)
        if box is None:
            return self._nothing
        distance, ways = (
            self.grid.spacing / self.per_axis,
            [self._way(number, time) for time in (since, until, now)],
        )
        low, counts = [0.0] * 3, [1] * 3
        for axis in range(self.grid.dimension):
            begin, end = ways[0][axis], ways[1][axis]
            low[axis] = math.floor((box[0][axis] - max(begin, end)) / distance) - 1.0
            counts[axis] = int(
                math.ceil((box[1][axis] - min(begin, end)) / distance) + 1.0 - low[axis]
            )
        self._reserve(math.prod(counts))
        self._span.host[:] = (*ways[0], *ways[1], *ways[2], *low, *counts[:2])
        self._span.send()
        self._entering.run(number)
        if self.grid.device.is_cuda:
            self._found = self._split(self._memory.numpy())
        entries, slot, filled, points = (
            array[: int(self._lattice.count.value)] for array in self._found
        )
        which = np.flatnonzero(entries | filled if starts else entries)
        if not len(which):
            return self._nothing
        return slot[which], entries[which], filled[which] * starts, points[which]

    def _enter(self, number: int) -> None:
        """Launch the motion of a source's lattice points through its cells.

        The lattice points are dx / per_axis apart [m]. The kernel's seed is
        (random_seed + number) * 0x9E3779B97F4A7C15 + 1 modulo 2^64, as a signed number.
        """
        grid, seed = self.grid, (self.random_seed + number) * 0x9E3779B97F4A7C15 + 1
        along, shear = lattice_shear(self.sources[number].velocity, grid.dimension)
        size = dict(zip(("size_x", "size_y", "size_z"), map(float, grid.extent), strict=True))
        size |= dict(zip(("shear_x", "shear_y", "shear_z"), shear.tolist(), strict=True))
        numbers = {
            "number": number,
            "along": along,
            "nx": grid.shape[2],
            "ny": grid.shape[1],
            "nz": grid.shape[0],
            "seed": (seed + 2**63) % 2**64 - 2**63,
        }
        lengths = {
            "distance": grid.spacing / self.per_axis,
            "jitter": self.jitter,
            "grazed": GRAZED,
            "margin": 1.1 * MARGIN * grid.spacing,
        }
        kernel_args = {
            "slots": self._fields[0].flatten(),
            "owner": self._fields[1],
            "span": self._span.array,
            **self._points,
        }
        launch(
            kernels.ENTER,
            int(self._lattice.count.value),
            grid,
            **kernel_args,
            **numbers,
            **lengths,
            **size,
        )

    def _reserve(self, count: int) -> None:
        """Allocate memory for a number of lattice points."""
        if count > len(self._points["entries"]):
            size, memory = (
                int(GROWTH * count),
                zeros(6 * int(GROWTH * count), wp.int32, self.grid.device),
            )
            # One memory for all arrays, so that one copy reads them.
            for place, name in enumerate(self._points):
                kind = wp.vec3 if name == "point" else wp.int32
                self._points[name] = wp.array(
                    ptr=memory.ptr + 4 * place * size,
                    dtype=kind,
                    shape=size,
                    device=self.grid.device,
                )
            self._memory = memory
            self._lattice.set_list(count, self._points)
            if self.grid.device.is_cpu:
                self._found = [array.numpy() for array in self._points.values()]  # the same memory
        self._lattice.resize(count)

    @staticmethod
    def _split(memory: np.ndarray) -> list[np.ndarray]:
        """Return entries, slots, filled and points, shape (n, 3), as views of one memory."""
        size = len(memory) // 6
        return [
            *memory[: 3 * size].reshape(3, size),
            memory[3 * size :].view(np.float32).reshape(size, 3),
        ]

    def _new(
        self,
        held: np.ndarray,
        slot: np.ndarray,
        entries: np.ndarray,
        filled: np.ndarray,
        points: np.ndarray,
    ) -> np.ndarray:
        """Return the places of new particles [m], from the points of `_entered`.

        If the source starts, points that fill its cells are included.

        Args:
            held: fill of each cell, relative to rest.
            slot: slots returned by `_entered`.
            entries: likewise.
            filled: likewise.
            points: likewise.
        """
        new = np.where(self._emits[slot] & (held[np.maximum(slot, 1) - 1] < JAMMED), entries, 0)
        new += (filled > 0) & self._emits[filled] & (held[np.maximum(filled, 1) - 1] < FILLED)
        points = np.repeat(points, new, axis=0)
        return points[self.boundary.admits(points)] if len(points) else points

    def _way(self, number: int, time: float) -> list[float]:
        """Return the displacement of a source's lattice at a time [m]."""
        source = self.sources[number]
        return [float(v) * (time - source.start) for v in source.velocity]

    def _box(self, cells: np.ndarray) -> tuple[list[float], list[float]] | None:
        """Return the low and high corner [m] of cells (k, j, i); None without cells."""
        if not len(cells):
            return None
        low, high = (
            corner[::-1] + np.array(self.grid.origin)
            for corner in (cells.min(axis=0), cells.max(axis=0) + 1)
        )
        return (low * self.grid.spacing).tolist(), (high * self.grid.spacing).tolist()

    def _impose(self, velocity: Faces, known: Faces, cells: wp.array | None, supply: bool) -> None:
        """Launch the kernels of `supply` or of `hold`."""
        walls = self._moving_walls if supply else []
        if self._window is None:
            return
        for axis, field in enumerate(velocity):
            given = [field, walls[axis] if walls else None, known[axis] if known else None]
            self._window.launch(
                kernels.impose_kernel, [axis, int(supply), *self._fields, self._velocities, *given]
            )
        if cells is not None:
            self._window.launch(kernels.occupy_kernel, [*self._fields, int(not supply), cells])


def lattice_shear(velocity: np.ndarray, dimension: int) -> tuple[int, np.ndarray]:
    """Shear a lattice so that it has no layers across a flow.

    With axis a, the sheared lattice has the points n + e_a (s_b n_b + s_c n_c), n of integers.
    Those that pass a plane across the flow v at one time have the same v p / v_a, which is

        n_a + alpha_b n_b + alpha_c n_c,   alpha_b = s_b + v_b / v_a.

    With alpha = 1 / g in 2-D, and 1 / g, 1 / g^2 in 3-D, where g^(d+1) = g + 1 for d axes across
    the flow, these times are evenly spread, in whatever part of the columns (Kronecker sequence). A
    flow that is stretched along v keeps its points apart: in 2-D g is the golden ratio, and of all
    lattices, stretched or not, that of the golden ratio has the largest least distance (Hurwitz).

    Args:
        velocity: v [m/s], shape (3,), not 0.
        dimension: 2 or 3.

    Returns:
        a, the axis nearest to the flow, and s, shape (3,), 0 along a.
    """
    along, shear = int(np.argmax(np.abs(velocity))), np.zeros(3)
    across = [axis for axis in range(dimension) if axis != along]
    g = 1.0
    for _ in range(GOLDEN_STEPS):
        g = (1.0 + g) ** (1.0 / (len(across) + 1))
    for power, axis in enumerate(across, start=1):
        shear[axis] = g**-power - float(velocity[axis]) / float(velocity[along])
    return along, shear


def _owners(grid: StaggeredGrid, boundary: Boundary, sources: Sequence[Source]) -> np.ndarray:
    """Return the source of each open cell, -1 for none, shape (nz, ny, nx)."""
    nz, ny, nx = (n - 2 for n in grid.shape)
    K, J, I = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    centers = (
        np.stack([I.ravel(), J.ravel(), K.ravel()], axis=1) + np.array(grid.origin) + 0.5
    ) * grid.spacing
    if grid.dimension == 2:
        centers[:, 2] = 0.0
    owner = np.full(len(centers), -1)
    free = (grid.interior(boundary.base.numpy()) != SOLID).ravel()
    for number, source in enumerate(sources):
        mine = free & (owner < 0)
        mine[mine] = source.contains(centers[mine])
        owner[mine] = number
    return owner.reshape(nz, ny, nx)


DEPARTED, DRAINED = wp.constant(1), wp.constant(2)  # marks of particles


@list_kernel("warp_lcp.material.outlets")
@typing.no_type_check
def mark_inside_kernel(i, distance: wp.array(dtype=wp.float32), marks: wp.array(dtype=wp.int32)):
    """Mark particles at a negative distance that have not departed."""
    if distance[i] < 0.0 and marks[i] == 0:
        marks[i] = DRAINED


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
        open_sides: open sides of the domain, see `warp_lcp.grid.domain_sides.side_bits`.
    """

    def __init__(self, grid: StaggeredGrid, drains: Sequence[Drain], open_sides: int) -> None:
        self.grid, self.drains, self.open_sides = grid, tuple(drains), open_sides
        self._store, self._slot = zeros(0, wp.float32, grid.device), Slot()
        self._distance = self._store  # view of as many entries as there are particles
        self._leaving = LaunchGraph(grid.device, self._launch)

    def apply(self, particles: Particles, before: float, now: float) -> tuple[int, int]:
        """Remove particles; the others keep their order.

        Args:
            particles: the material (updated).
            before: time at the start of the step [s].
            now: time at the end of the step [s].

        Returns:
            How many drains have swallowed, and how many have left through open sides.
        """
        return self._remove(
            particles, tuple(drain for drain in self.drains if drain.opens(before, now))
        )

    def remove_departed(self, particles: Particles) -> int:
        """Remove particles beyond open sides; return their number."""
        return self._remove(particles, ())[1]

    def _remove(self, particles: Particles, drains: tuple[Drain, ...]) -> tuple[int, int]:
        """Remove particles beyond open sides and in some drains.

        Returns how many the drains have removed, and how many have left.
        """
        count = particles.count
        if not count or not (self.open_sides or drains):
            return 0, 0
        if drains and len(self._distance) != count:
            if len(self._store) < count:
                self._store = zeros(particles.capacity, wp.float32, self.grid.device)
            self._distance = self._store[:count]
            self._slot.point_to(self._distance)
        marks = particles.marks
        self._leaving.run(particles, drains, marks, self._distance)
        particles.launch_totals()
        departed, drained = particles.finish_removal(marks)
        return drained, departed

    def _launch(
        self, particles: Particles, drains: tuple[Drain, ...], marks: wp.array, distance: wp.array
    ) -> None:
        """Launch the marking of the particles that leave, and their removal."""
        position = particles.position
        mark_gone(self.grid, self.open_sides, position, marks)
        for drain in drains:
            drain.geometry.signed_distance(position, distance)
            launch_list(
                mark_inside_kernel, particles.count, [distance, marks], device=self.grid.device
            )
        particles.launch_removal(marks)
