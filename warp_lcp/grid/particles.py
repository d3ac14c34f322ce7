"""Particles in approximate cell order: position, velocity, APIC gradients."""

import itertools
import math
import typing
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import warp as wp

from warp_lcp.grid import particles_kernels as kernels
from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.particle_ids import NO_ID, pack_ids, unpack_ids
from warp_lcp.grid.particle_loops import CPU_GRAIN, LIST_ROOM, ListMemory, launch
from warp_lcp.grid.radix_sort import digits_of, sort_keys
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.kernels import Rows
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import LaunchGraph, call, clear
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import RowsMemory, Scalar, Slot, rows_memory
from warp_lcp.kernels.vectors import DynamicReduction

CHUNK = 256  # fewest particles that one thread sums up
THREADS = 1024  # most threads of a sum; the host adds their partial results
CUDA_CHUNK, CUDA_THREADS = 16, 1 << 15  # likewise on a GPU
# Growth of the storage when it is full: n appended particles are copied at most 2 n times, and at
# most a third of the storage is unused.
GROWTH = 1.5
# Pieces of the keys in a sort. With more, the sums between two passes take longer.
SORT_PIECES = 32
# Places of particles in the order of all ranks' particles, see `warp_lcp.distributed.particles`.
MOST_A_CELL = 1 << 20  # particles; all places of a cell are numbers below those of the next cell
NEW = 1 << 62  # first place of particles that were added since the last sort
SORTED, UNSORTED = 0, 1  # steps in which `arrange` sorts, and in which it need not
# Steps between sorts if nothing needs the order. At CFL 2 the transfers get no slower within 16
# steps; a sort costs 25 ns a particle.
SORT_EVERY = 8


@dataclass(frozen=True)
class ParticleTotals:
    """Sums over all particles.

    Attributes:
        count: particles.
        mean_square_speed: [m^2/s^2].
        velocity: mean velocity [m/s], shape (3,).
        center: mean position [m], shape (3,).
        low: smallest coordinates [m], shape (3,).
        high: largest coordinates [m], shape (3,).
        max_speed: [m/s].
        bad_positions: particles whose position is not finite.
        bad_velocities: particles whose velocity is not finite (or its square overflows).
    """

    count: int = 0
    mean_square_speed: float = 0.0
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    low: np.ndarray = field(default_factory=lambda: np.zeros(3))
    high: np.ndarray = field(default_factory=lambda: np.zeros(3))
    max_speed: float = 0.0
    bad_positions: int = 0
    bad_velocities: int = 0

    @property
    def finite(self) -> bool:
        """Whether every position and velocity is finite."""
        return self.bad_positions == 0 and self.bad_velocities == 0

    def joined(self, other: "ParticleTotals") -> "ParticleTotals":
        """Return sums over these particles and others.

        Means are weighted by the counts n: mean = (n_1 mean_1 + n_2 mean_2) / (n_1 + n_2).
        """
        count = self.count + other.count
        if 0 in (self.count, other.count):
            return self if other.count == 0 else other
        mine, theirs = self.count / count, other.count / count
        return ParticleTotals(
            count=count,
            mean_square_speed=mine * self.mean_square_speed + theirs * other.mean_square_speed,
            velocity=mine * self.velocity + theirs * other.velocity,
            center=mine * self.center + theirs * other.center,
            low=np.minimum(self.low, other.low),
            high=np.maximum(self.high, other.high),
            max_speed=max(self.max_speed, other.max_speed),
            bad_positions=self.bad_positions + other.bad_positions,
            bad_velocities=self.bad_velocities + other.bad_velocities,
        )


class ParticleArray:
    """Array of one vector per particle, with spare capacity.

    Attributes:
        store: wp.vec3, shape (capacity,).
        count: vectors in use.
        slot: address for recorded launches; None until it is known.
        listed: number of vectors, for recorded launches.
    """

    slot: Slot | None = None
    listed: ListMemory

    def __init__(self, capacity: int, count: int, device: wp.Device) -> None:
        self._host: np.ndarray | None = None
        if device.is_cpu:  # NumPy's zeros take no memory before a particle has been there
            self._host = np.zeros((capacity, 3), dtype=np.float32)
            self.store = wp.array(self._host, dtype=wp.vec3, device=device, copy=False)
        else:
            self.store = wp.zeros(capacity, dtype=wp.vec3, device=device)
        self._view: wp.array | None = None
        self.count = count

    @property
    def view(self) -> wp.array:
        """The part in use, shape (count,)."""
        if self._view is None:
            self._view = self.store[: self.count]
            if self.slot is not None:
                self._view.slot, self._view.listed = self.slot, self.listed
        return self._view

    def use(self, count: int) -> None:
        """Set the number of vectors in use."""
        if count != self.count:
            self.count, self._view = count, None

    def publish(self, memory: ListMemory, name: str) -> None:
        """Publish the vectors in use to recorded launches, by a name."""
        self.slot, self.listed = memory.slot(name), memory
        self.slot.point_to_first(self.count, self.store)
        if self._view is not None:
            self._view.slot, self._view.listed = self.slot, memory

    def set_from(self, first: int, values: np.ndarray | float) -> None:
        """Set the vectors in use from an index on.

        Args:
            first: the index.
            values: shape (count - first, 3), or one number for all.
        """
        if self._host is not None:
            self._host[first : self.count] = values
        elif isinstance(values, np.ndarray):
            self.view[first:].assign(np.ascontiguousarray(values, dtype=np.float32))
        else:
            self.view[first:].fill_(values)


class Particles:
    """Particles, sorted by cell in place.

    Args:
        grid: the grid whose cells order the particles.
        position: [m], shape (n, 3); z = 0 in 2-D.
        velocity: [m/s], shape (n, 3).
        affine: also carry the gradient of each velocity component [1/s].
        kept: a number that each particle carries, shape (n,); None if they carry none.
        ids: whether each particle has an id.
        indexed: sort in every step and store the first particle of each cell, for transfers that
            gather. Default on CUDA, if the transfers need it there.

    Attributes:
        count: particles.
        key: number of the stored cell of each particle when last numbered or sorted, shape (2
            capacity,), the first `count` in use.
        offsets: first particle of each stored cell, int32, shape (cells + 1,), at the last sort;
            None unless `indexed`.
        runs: begin and end of each run of particles in the order of summation, int32, shape (2
            runs,); None if all particles are in this order.
        exchange: exchange with other processes, see `warp_lcp.grid.grid_part.ParticleExchange`.

    Raises:
        ValueError: the shapes do not match.
    """

    runs: wp.array | None = None
    _order: wp.array  # scratch memory, as large as `key`
    _spare: ParticleArray  # memory of the next reordered column

    def __init__(
        self,
        grid: StaggeredGrid,
        position: np.ndarray,
        velocity: np.ndarray,
        *,
        affine: bool,
        kept: np.ndarray | None = None,
        ids: bool = False,
        indexed: bool | None = None,
    ) -> None:
        _check_shapes(position, velocity)
        self.grid, self.count, self._capacity = grid, 0, 0
        indexed = grid.device.is_cuda if indexed is None else indexed
        self.offsets = (
            wp.zeros(grid.size + 1, dtype=wp.int32, device=grid.device) if indexed else None
        )
        self._names = [
            "position",
            "velocity",
            *(f"affine_{c}" for c in range(grid.dimension if affine else 0)),
        ]
        self._names += ["kept"] * (kept is not None) + ["identity"] * ids
        self._tally, columns, device = None, len(kernels.TOTAL.reductions), grid.device
        launches = self._launch_totals, self._launch_numbers, self._launch_sort
        self._totals, self._numbering, self._sorting = (
            LaunchGraph(device, launch) for launch in launches
        )
        self._removal = LaunchGraph(device, self._launch_removal)
        self._removed = DeviceScalar(device, 2, wp.int32)
        # Arrays and number of particles for which the launches were recorded.
        self._marks: tuple[tuple[object, int], wp.array | None] = (None, 0), None
        self._stays: wp.array | None = None  # beside them
        self._total_rows = rows_memory(device, LIST_ROOM)
        if device.is_cuda:
            self._tally = DynamicReduction(kernels.TOTAL, device, CUDA_THREADS)
        else:
            self._partials = wp.zeros(columns * THREADS, dtype=wp.float64, device=device)
            self._device_totals, self._places = DeviceScalar(device, columns), Scalar()
            self._sort_rows, self._sort_pieces = RowsMemory(), Scalar()
            self._counts = wp.zeros(0, dtype=wp.int32, device=device)
        self._last: ParticleTotals | None = None
        self._totals_launched = False  # whether a GPU has the sums of the current particles
        self._current_totals: ParticleTotals | None = None  # current sums
        self._columns: dict[str, ParticleArray] = {}
        self._memory = ListMemory(grid.device)
        self.exchange = grid.part.exchange_of(self)
        self._grow(0)
        self._publish()
        self.append(position, velocity, kept)

    @property
    def capacity(self) -> int:
        """Number of particles that fit before the storage grows."""
        return self._capacity

    @property
    def column_count(self) -> int:
        """Number of `arrays`."""
        return len(self._names)

    @property
    def listed_count(self) -> Scalar:
        """The number of particles, for recorded launches."""
        return self._memory.count

    @property
    def position(self) -> wp.array:
        """Positions [m], wp.vec3, shape (count,)."""
        return self._columns["position"].view

    @property
    def velocity(self) -> wp.array:
        """Velocities [m/s], wp.vec3, shape (count,)."""
        return self._columns["velocity"].view

    @property
    def affine(self) -> list[wp.array]:
        """Gradient of each velocity component [1/s], wp.vec3, shape (count,) each.

        Empty without `affine`.
        """
        return [self._columns[name].view for name in self._names if name.startswith("affine")]

    @property
    def kept(self) -> wp.array | None:
        """Number carried by each particle, or None.

        Stored three times, like a velocity: wp.vec3, shape (count,).
        """
        return self._columns["kept"].view if "kept" in self._columns else None

    @property
    def ids(self) -> np.ndarray | None:
        """Copy of the particles' ids, int64, shape (count,); None if they have none."""
        column = self._columns.get("identity")
        return None if column is None else unpack_ids(column.view.numpy())

    def set_ids(self, first: int, ids: np.ndarray) -> None:
        """Set the ids of the particles from an index on; particles must have ids."""
        self._columns["identity"].set_from(first, pack_ids(ids))

    def append(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        kept: np.ndarray | float | None = None,
        ids: np.ndarray | None = None,
    ) -> None:
        """Add particles at the end, with zero gradient.

        They are out of order until the next sort.

        Args:
            position: [m], shape (n, 3).
            velocity: [m/s], shape (n, 3).
            kept: the number that each carries, or one for all. Default: 1, for particles that carry
                one.
            ids: their ids, int64, shape (n,). Default: `NO_ID`, for particles that have ids.

        Raises:
            ValueError: the shapes do not match.
        """
        _check_shapes(position, velocity)
        if len(position) == 0:
            return
        before = self.count
        self.resize(before + len(position))
        for name, column in self._columns.items():
            if name == "kept":
                numbers = np.broadcast_to(
                    np.float32(1.0) if kept is None else np.asarray(kept, dtype=np.float32),
                    len(position),
                )
                column.set_from(before, np.repeat(numbers[:, None], 3, axis=1))
            elif name == "identity":
                self.set_ids(before, np.full(len(position), NO_ID) if ids is None else ids)
            else:  # sorting may have left anything behind the particles in use
                column.set_from(before, {"position": position, "velocity": velocity}.get(name, 0.0))
        self.exchange.register_append(len(position))

    def make_room(self, count: int) -> int:
        """Add particles at the end and return the index of the first.

        The caller sets their position, velocity and gradient.
        """
        before = self.count
        self.resize(before + count)
        return before

    @property
    def marks(self) -> wp.array:
        """Scratch memory for `remove`, int32, shape (count,)."""
        memory = self._order.ptr, self.count
        if self._marks[0] != memory:
            self._marks = memory, self._order[self._capacity : self._capacity + self.count]
            self._stays = self._order[: self.count]
            self._memory.set_list(self.count, {"marks": self._marks[1], "stays": self._stays})
        return self._marks[1]

    def remove(self, marks: wp.array) -> int:
        """Remove particles in place; the others keep their order.

        Nothing is copied if none is removed.

        Args:
            marks: int32, shape (count,): not 0 where a particle is to go; may be `marks`.

        Returns:
            How many were removed.
        """
        if self.count == 0:
            return 0
        self.launch_removal(marks)
        return sum(self.finish_removal(marks))

    def launch_removal(self, marks: wp.array) -> None:
        """Launch the removal of marked particles, of which there are some.

        It may be recorded; `finish_removal` then ends it.
        """
        mine = marks is self._marks[1] and self._stays is not None
        self._removal.run(marks, self._stays if mine else self._order[: self.count])

    def _launch_removal(self, marks: wp.array, stay: wp.array) -> None:
        """Launch the removal.

        On a GPU only count the removed particles, and write to `stay` 1 for those that stay.
        """
        device = self.grid.device
        if device.is_cuda:
            clear(self._removed.array)
            launch_list(
                kernels.stays_kernel, self.count, [marks, stay, self._removed.array], device=device
            )
            return
        optional = ("affine_0", "affine_1", "affine_2", "kept", "identity")
        columns = dict.fromkeys(optional) | self.arrays()
        kernel_args: dict[str, object] = {
            "removed": self._removed.array,
            "marks": marks,
            "count": self._memory.count,
            **columns,
        }
        kernels.CLOSE_RANKS.bind_arguments(Rows.entries(1, device), (), kernel_args).launch()

    def finish_removal(self, marks: wp.array) -> tuple[int, int]:
        """End the removal that has been launched.

        On a GPU, particle p moves to the place (number of particles up to p that stay) - 1, by a
        prefix sum, which keeps the order.

        Args:
            marks: those it was launched with.

        Returns:
            How many particles with the mark 1 were removed, and how many with another.
        """
        self._removed.changed()
        first, other_marks = self._removed.numpy().tolist()
        if first + other_marks:
            if self.grid.device.is_cuda:
                stay = self._order[: self.count]
                wp.utils.array_scan(stay, stay, inclusive=True)
                for name, column in self._columns.items():
                    inputs = [marks, stay, column.view, self._spare.view]
                    wp.launch(
                        kernels.close_ranks_kernel, self.count, inputs, device=self.grid.device
                    )
                    self._columns[name], self._spare = self._spare, column
            self.exchange.register_removal(marks)
            self.resize(self.count - first - other_marks)
        return first, other_marks

    def gather_rows(self, order: np.ndarray) -> None:
        """Keep the particles with these numbers, in this order."""
        device, count = self.grid.device, len(order)
        if count:
            numbers = wp.array(
                order.astype(np.int32, copy=False),
                dtype=wp.int32,
                device=device,
                copy=device.is_cuda,
            )
            for name, column in self._columns.items():
                launch_list(
                    kernels.reorder_kernel,
                    count,
                    [numbers, column.view, self._spare.view],
                    device=device,
                    cost=4,
                )
                self._columns[name], self._spare = self._spare, column
        self.resize(count)

    def move_to(self, grid: StaggeredGrid) -> None:
        """Sort the particles by the cells of another grid from now on."""
        self.grid = grid
        self.exchange.move_to(grid.part)
        for graph in (self._totals, self._numbering, self._sorting):
            graph.forget()
        if self.offsets is not None:
            self.offsets = wp.zeros(grid.size + 1, dtype=wp.int32, device=grid.device)

    def assign(self, arrays: typing.Mapping[str, np.ndarray]) -> None:
        """Replace the particles by given arrays.

        Args:
            arrays: float32 of shape (n, 3) for every name of `arrays`.
        """
        self.resize(len(arrays["position"]))
        for name, view in self.arrays().items():
            view.assign(arrays[name])

    def set_runs(self, runs: wp.array) -> None:
        """Let sums take the particles in the order of `runs`."""
        self.runs = runs
        self._memory.set_list(self.count, {"runs": runs})

    def resize(self, count: int) -> None:
        """Set the number of particles; new ones have undefined values."""
        before, self.count, self._current_totals, self._totals_launched = (
            self.count,
            count,
            None,
            False,
        )
        if count > self._capacity:
            self._grow(before)
        for column in (*self._columns.values(), self._spare):
            column.use(count)
        self._publish()

    def _publish(self) -> None:
        """Publish the number and the arrays of the particles to recorded launches."""
        count, memory = self.count, self._memory
        if count != memory.count.value and self._tally is not None:
            self._total_rows.set_layout(self._rows_of_totals().summed)
        elif count != memory.count.value:
            self._places.value = self._total_rows.set_entries(
                count, _chunk_of_totals(count, self.grid.device)
            )
            self._sort_pieces.value = self._sort_rows.set_entries(count, _piece_of_sort(count))
        for name, column in self._columns.items():
            column.publish(memory, name)
        self._spare.publish(memory, "spare")
        memory.set_list(count, {"key": self.key})

    def _grow(self, before: int) -> None:
        """Enlarge the storage to at least `count` particles; keep the first `before`.

        The new capacity is the largest of room * count, GROWTH * capacity and 1.
        """
        device = self.grid.device
        self._capacity = max(int(self.exchange.room * self.count), int(GROWTH * self._capacity), 1)
        for name in self._names:
            column = ParticleArray(self._capacity, self.count, device)
            if before:
                wp.copy(column.store, self._columns[name].store, count=before)
            self._columns[name] = column
        self._spare = ParticleArray(self._capacity, self.count, device)
        self.key = zeros(2 * self._capacity, wp.int32, device)
        self._order = zeros(2 * self._capacity, wp.int32, device)
        self._sorting.forget()  # its recorded launches use both halves

    def arrange(self, step: int) -> None:
        """Number the particles by cell, with ghosts on ranks; collective.

        They are sorted in every SORT_EVERY-th step, or where the order is needed.

        It depends on nothing but the step, so that a run that was interrupted does the same.

        Args:
            step: number of the step.
        """
        self.exchange.arrange(sort=self.offsets is not None or step % SORT_EVERY == 0)

    def exchange_ghost_positions(self) -> None:
        """Copy positions of other ranks' particles within a cell as ghosts; collective."""
        self.exchange.exchange_ghost_positions()

    def drop_ghosts(self) -> None:
        """Remove the ghosts of other processes."""
        self.exchange.drop_ghosts()

    def number(self) -> None:
        """Find the cell of each particle."""
        self._numbering.run()

    def _launch_numbers(self) -> None:
        grid = self.grid
        nx, ny, nz = grid.counts
        launch(
            kernels.NUMBER,
            self.count,
            grid,
            position=self.position,
            key=self.key,
            nx=nx,
            ny=ny,
            nz=nz,
        )

    def sort(self) -> None:
        """Sort the particles by cell (stable, so that runs are repeatable)."""
        self.exchange.begin_sort()
        self._sort_cells()
        self.exchange.end_sort()

    def _sort_cells(self) -> None:
        """Sort all columns by the cells' numbers.

        `offsets[c]` is then the number of particles in cells before c.
        """
        grid = self.grid
        if self.count == 0:
            if self.offsets is not None:
                self.offsets.zero_()
            return
        if self._tally is None:
            least = int(self._sort_pieces.value) * (
                (1 << digits_of(grid.size.bit_length())[1]) + kernels.APART
            )
            if self._counts.size < least:
                self._counts = wp.zeros(least, dtype=wp.int32, device=grid.device)
                self._sorting.forget()
            self._sorting.run(variant=grid.size.bit_length())
        else:
            self._sorting.run(self._keys_to_sort())
        for name, column in self._columns.items():  # each lies where the one before it was
            self._columns[name], self._spare = self._spare, column
        self._publish()
        if self.offsets is not None and self._tally is None:
            wp.launch(
                kernels.offset_kernel,
                grid.size + 1,
                [self.key, self.count, self.offsets],
                device=grid.device,
            )

    def _keys_to_sort(self) -> int:
        """Return the number of keys that a GPU sorts.

        It is at most a quarter more than the number of particles.

        So one graph serves many numbers of particles.
        """
        step = 1 << max(self.count.bit_length() - 3, 0)
        return min(-(-self.count // step) * step, self._capacity)

    def _launch_sort(self, keys: int = 0) -> None:
        """Launch the sort: number the particles, sort the numbers, reorder each column.

        Each column moves to the memory of the column before it.

        Args:
            keys: number of keys that a GPU sorts; those after the particles' have the largest
                number, and stay at the end.
        """
        device, size, count = self.grid.device, self.grid.size, self._memory.count
        bits = size.bit_length()
        self._launch_numbers()
        if device.is_cuda:
            launch_recorded(
                kernels.count_up_kernel,
                keys,
                [self._order, self.key, count, (1 << bits) - 1],
                device=device,
            )
            call(partial(wp.utils.radix_sort_pairs, self.key, self._order, keys, end_bit=bits))
            if self.offsets is not None:
                launch_recorded(
                    kernels.offset_kernel, size + 1, [self.key, count, self.offsets], device=device
                )
        else:
            rows = replace(_rows_of_sort(self.count, device), memory=self._sort_rows)
            sort_keys(
                _halves(self.key), _halves(self._order), self._counts, rows, self._sort_pieces, bits
            )
        views = [self._spare.view, *(column.view for column in self._columns.values())]
        for target, source in itertools.pairwise(views):
            launch_list(
                kernels.reorder_kernel,
                self.count,
                [self._order, source, target],
                device=device,
                cost=4,
            )

    def totals(self) -> ParticleTotals:
        """Return sums over the particles of all ranks; collective.

        They are bitwise reproducible, and 0 without particles. Ghosts are gone.
        """
        return self.exchange.joined_totals(self._own_totals())

    def _own_totals(self) -> ParticleTotals:
        if self._current_totals is not None:
            return self._current_totals
        if self.count == 0:
            return ParticleTotals()
        if self._tally is not None:
            if not self._totals_launched:
                self.launch_totals()
            self._totals_launched = False
            total = self._tally.read()
        else:
            self._totals.run()
            total = self._device_totals.numpy().copy()
        # Sums of |v|^2, x [m] (1 to 3) and v [m/s] (4 to 6), counts of x and v that are not finite
        # (7, 8), maxima of |v|^2 (9), x (10 to 12) and -x (13 to 15). Means are sums / count.
        self._last = totals = ParticleTotals(
            count=self.count,
            mean_square_speed=float(total[0]) / self.count,
            center=total[1:4] / self.count,
            velocity=total[4:7] / self.count,
            bad_positions=int(total[7]),
            bad_velocities=int(total[8]),
            max_speed=float(np.sqrt(total[9])),
            high=total[10:13],
            low=-total[13:16],
        )
        return totals

    def _rows_of_totals(self) -> Rows:
        """Return the division of the particles into rows for sums."""
        return Rows.entries(
            self.count, self.grid.device, _chunk_of_totals(self.count, self.grid.device)
        )

    def _launch_totals(self) -> None:
        """Launch the sums over the particles, and over the threads' partial sums."""
        rows = replace(self._rows_of_totals(), memory=self._total_rows)
        if self._tally is not None:
            self._tally.launch(
                rows, self.grid.placement, position=self.position, velocity=self.velocity
            )
            return
        kernels.TOTAL.bind(
            rows,
            self.grid.placement,
            position=self.position,
            velocity=self.velocity,
            out=self._partials,
        ).launch()
        columns = Rows.flat(len(kernels.TOTAL.reductions), self.grid.device, serial=True)
        kernels.ADD_IN_ORDER.bind(
            columns,
            partials=self._partials,
            results=self._device_totals.array,
            places_of_sums=self._places,
            sums_=len(kernels.TOTAL.sums),
        ).launch()

    def launch_totals(self) -> None:
        """Launch the next `totals` on a GPU, so that they share a readback with others.

        They are launched again if particles come or go before.
        """
        if self._tally is not None and self._current_totals is None and self.count:
            self._totals.run()
            self._tally.changed()
            self._totals_launched = True

    def totals_stay(self, stay: bool) -> None:
        """Declare that positions and velocities are unchanged since `totals`.

        The next `totals` then does not wait for a GPU.

        On a GPU, code that changes them between steps must reset this.
        """
        self._current_totals = (
            self._last if stay and self.count and self.grid.device.is_cuda else None
        )

    def cells_of(self, positions: np.ndarray) -> np.ndarray:
        """Return the interior cells (x, y, z), counted from 0, of positions [m].

        Shape (n, 3); they may lie outside of a part of a grid.
        """
        grid = self.grid
        cells = np.floor(np.nan_to_num(np.asarray(positions, dtype=np.float64)) / grid.spacing)
        return grid.part.nearest(
            np.clip(cells, 0, np.array(grid.domain_counts) - 1).astype(int) - np.array(grid.origin)
        )

    def cell_of(self, position: typing.Sequence[float] | np.ndarray) -> tuple[int, int, int]:
        """Return the interior cell (x, y, z), counted from 0, of one position [m].

        The position is finite; see `cells_of`.
        """
        grid = self.grid
        x, y, z = (
            min(max(math.floor(float(v) / grid.spacing), 0), n - 1) - o
            for v, n, o in zip(position, grid.domain_counts, grid.origin, strict=True)
        )
        return x, y, z

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of the particles by name."""
        return {name: column.view for name, column in self._columns.items()}


def _chunk_of_totals(count: int, device: wp.Device) -> int:
    """Return the number of particles that a thread sums up."""
    return max(
        CUDA_CHUNK if device.is_cuda else CHUNK,
        -(-count // (CUDA_THREADS if device.is_cuda else THREADS)),
    )


def _piece_of_sort(count: int) -> int:
    """Return the number of keys in one piece of a sort."""
    return max(CPU_GRAIN, -(-count // SORT_PIECES))


def _rows_of_sort(count: int, device: wp.Device) -> Rows:
    """Return the rows of a sort: one piece of keys a task."""
    return Rows.entries(count, device, _piece_of_sort(count), weight=4)


def _halves(array: wp.array) -> tuple[wp.array, wp.array]:
    half = array.size // 2
    return array[:half], array[half:]


def _check_shapes(position: np.ndarray, velocity: np.ndarray) -> None:
    if position.shape != (len(position), 3) or velocity.shape != position.shape:
        raise ValueError(
            f"position {position.shape} and velocity {velocity.shape}: must both be (n, 3)"
        )
