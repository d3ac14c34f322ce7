"""Part of the grid that a process works on, and its communication with the others.

A single process works on the whole grid. Then nothing is exchanged, and a sum over all processes is
the number itself. The part of a rank among several is `warp_lcp.distributed.subdomain.Subdomain`.
Methods named *collective* must be called by every rank, in the same order, also by one that has no
material.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar, TypeVar, Unpack, cast

import numpy as np
import warp as wp

from warp_lcp.kernels.launch_graph import HostTask
from warp_lcp.kernels.vectors import convert
from warp_lcp.operators.grid_poisson import GridPoisson, PoissonArguments

if TYPE_CHECKING:
    from warp_lcp.distributed.halo import StarForest
    from warp_lcp.distributed.ranks import Ranks
    from warp_lcp.distributed.subdomain import Subdomain
    from warp_lcp.grid.particles import Particles, ParticleTotals
    from warp_lcp.grid.staggered import StaggeredGrid, Window
    from warp_lcp.kernels.vectors import Communicator
    from warp_lcp.operators.padded_stencil import CellDecomposition


ValueT = TypeVar("ValueT")
NumbersT = TypeVar("NumbersT", float, np.ndarray)
FieldT = TypeVar("FieldT", bound=np.ndarray | wp.array)


class SerialCommunicator:
    """Communicator of a single process: every reduction returns its argument.

    `warp_lcp.distributed.ranks.Ranks` is the communicator of several ranks.
    """

    size, rank, is_root = 1, 0, True

    def sum(self, values: NumbersT) -> NumbersT:
        """Return the sum over the processes of a number or an array."""
        return values

    def max(self, values: NumbersT) -> NumbersT:
        """Return the maximum over the processes, entry by entry."""
        return values

    def any(self, condition: bool) -> bool:
        """Return whether a condition holds on any process."""
        return bool(condition)

    def gather(self, values: float | Sequence[float] | np.ndarray) -> np.ndarray:
        """Return an array of every process, shape (processes, *values.shape)."""
        return np.asarray(values)[None]

    def share(self, value: ValueT) -> ValueT:
        """Return the object of the first process."""
        return value

    def collect(self, value: ValueT) -> list[ValueT]:
        """Return an object of every process."""
        return [value]


Corner = tuple[int, int, int]

ONE_PROCESS = SerialCommunicator()


class ParticleExchange:
    """Exchange of particles between processes: a single process exchanges none.

    `warp_lcp.distributed.particles.ParticleMigration` is that of a rank among several.

    Args:
        particles: the particles of this process.

    Attributes:
        room: factor of the particle storage over the number of particles.
    """

    room = 1.0

    def __init__(self, particles: Particles) -> None:
        self.particles = particles

    @property
    def counts(self) -> list[int]:
        """Particles of each process at the last totals."""
        return [self.particles.count]

    @property
    def expected(self) -> int:
        """Number of particles that all processes must have.

        The last totals have counted them; only `append` and removal change the number.
        """
        return self.particles.count

    def move_to(self, part: GridPart) -> None:
        """Work on another part of the grid from now on."""

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays that a checkpoint needs besides the particles' own."""
        return {}

    def next_place(self) -> int:
        """Return a place in the order of sums after those of all particles; collective."""
        return 0

    def last_cells(self, begin: int, behind: int = 0) -> np.ndarray | None:
        """Return the cell of each particle from an index on, from its place.

        The particles are sorted by cell, or have been added in the order of cells. Returns None on
        a single process.

        Args:
            begin: index of the first one.
            behind: place to which their places are relative, as of `next_place`.
        """
        return None

    def assign(self, arrays: Mapping[str, np.ndarray], place: np.ndarray) -> None:
        """Replace the particles by others, in the order of their places; collective.

        Args:
            arrays: float32 of shape (n, 3) for every name of `Particles.arrays`.
            place: int64, shape (n,).
        """
        order = np.argsort(place, kind="stable")
        self.particles.assign(
            {name: np.ascontiguousarray(values[order]) for name, values in arrays.items()}
        )

    def count(self) -> None:
        """Count the particles of all processes; collective."""

    def register_append(self, count: int) -> None:
        """Register particles that have been appended."""

    def add_places(self, places: np.ndarray) -> None:
        """Set the places of the last appended particles in the order of sums, int64."""

    def register_removal(self, marks: wp.array) -> None:
        """Register the particles that are about to be removed: those whose mark is not 0."""

    def begin_sort(self) -> None:
        """Restore the order of particles from which a stable sort starts."""

    def end_sort(self) -> None:
        """Register the order that a sort has made."""

    def arrange(self, *, sort: bool) -> None:
        """Migrate particles, fetch ghosts and sort or number all by cell; collective.

        Particles that have left this process's part migrate to the process that owns their cell.
        """
        if sort:
            self.particles.sort()
        else:
            self.particles.number()

    def exchange_ghost_positions(self) -> None:
        """Copy positions of other ranks' particles within a cell as ghosts; collective."""

    def drop_ghosts(self) -> None:
        """Remove the ghosts; this process's own particles stay."""

    def with_ghosts(self, step: int) -> AbstractContextManager[None]:
        """Return a context with ghosts, all particles in the order of sums; collective.

        Args:
            step: the particles are arranged as in a step of this number.
        """
        return nullcontext()

    def joined_totals(self, own: ParticleTotals) -> ParticleTotals:
        """Return the sums over the particles of all processes; collective.

        `own` are the sums of this process.
        """
        return own


@dataclass(frozen=True)
class BodyNumbers:
    """Airborne bodies of material, numbered from the trees of cells on each process.

    Attributes:
        count: number of bodies in this process's numbering.
        several: number of bodies with trees on several processes; they come first.
        of_tree: the body of each tree of this process, int32, shape (trees,), -1 if it has none;
            None if each tree is a body.
    """

    count: int
    several: int = 0
    of_tree: np.ndarray | None = None


def subdomain_of(grid: StaggeredGrid) -> Subdomain:
    """Return the part of a grid on ranks; only if `grid.part.shared`."""
    return cast("Subdomain", grid.part)


class GridPart:
    """Part of the grid that a process works on: here the whole grid.

    Args:
        grid: the grid, whose fields have the cells of the part and a ring, or layers of ghost
            cells, around them.

    Attributes:
        grid: the grid.
        ranks: the communicator of the processes that work on the grid.
        decomposition: boxes of cells of the processes; None if there is one process.
        layers: layers of ghost cells around the part, its ring included.
        shared: whether several processes may work on the grid.
        joined: periodic axes that are cut; beyond the domain's sides the part of another process
            follows.
        cuts: bit n is set if the part of another process follows beyond side n, see
            `warp_lcp.grid.domain_sides`.
    """

    shared: ClassVar[bool] = False
    layers = 0
    cuts = 0
    joined: tuple[int, ...] = ()
    ranks: SerialCommunicator | Ranks = ONE_PROCESS
    decomposition: CellDecomposition | None = None

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid = grid

    @property
    def comm(self) -> Communicator | None:
        """The communicator that reductions use; None if there is one process."""
        return None

    @property
    def at_once(self) -> bool:
        """Whether launches that exchange ghost cells cannot be recorded."""
        return False

    @property
    def owned(self) -> Window:
        """The cells that this process owns."""
        return self.grid.domain

    @property
    def stored(self) -> Window:
        """The stored cells that this process owns, with the ring at the domain's sides."""
        return self.grid.everywhere

    @property
    def first(self) -> tuple[int, int, int]:
        """First owned cell along x, y, z, counted from 0 in the whole domain."""
        return self.grid.origin

    def keep_own(self, cells: np.ndarray) -> None:
        """Set a mask of the part's cells to False where another process owns them.

        The mask is bool of shape (nz, ny, nx).
        """

    def exchange_of(self, particles: Particles) -> ParticleExchange:
        """Return the exchange of particles of this part with other processes."""
        return ParticleExchange(particles)

    def nearest(self, cells: np.ndarray) -> np.ndarray:
        """Return the nearest periodic images of cells (x, y, z), shape (n, 3).

        Along periodic axes the image that is nearest to the part is chosen.
        """
        return cells

    def near(self, window: Window, layers: int) -> Window | None:
        """Return the cells of a window within some layers of the owned cells.

        Returns None if there are none.
        """
        return window

    def join_trees(
        self, trees: int, seen: Window | None, parent: wp.array, number: wp.array, held: wp.array
    ) -> BodyNumbers:
        """Join trees of cells across processes to bodies; collective.

        Args:
            trees: number of trees on this process.
            seen: the cells that it has searched; None if there are none.
            parent: parent of each cell in its tree, int32, flat.
            number: number of the tree of each root, -1 for other cells, int32, flat.
            held: not 0 at roots of trees that a wall touches, flat.
        """
        return BodyNumbers(trees)

    @property
    def corners(self) -> tuple[Corner, Corner] | None:
        """First cell (x, y, z) and the one past the last in a frame of this process.

        None if the frame has the whole domain.
        """
        return None

    def where(self) -> dict[str, np.ndarray]:
        """Return the box of the checkpoint's fields in the domain.

        `box` is int64 of shape (2, 3): the first cell and the one past the last. A whole domain has
        no entry.
        """
        low = np.array(self.grid.origin)
        return {} if self.grid.whole is None else {"box": np.array([low, low + self.grid.counts])}

    def checkpoint_fields(self, fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the arrays that a checkpoint of this process stores.

        Fields are cut to the part; numbers among them stay unchanged.
        """
        return dict(fields)

    @property
    def gathered_from(self) -> Corner:
        """First cell (x, y, z) of the field that `gathered` returns."""
        return self.grid.origin

    def gathered(self, values: np.ndarray) -> np.ndarray | None:
        """Gather the whole grid's field on the first process; collective.

        `values` is this part's field without its ring. Other processes get None.
        """
        return values

    def refill(self) -> Callable[[wp.array, wp.array], None] | None:
        """Function that fills ghost cells of marks and velocities; None if there are none.

        It is called after each extrapolated layer.
        """
        return None

    def cells_too_far(self, velocity: Sequence[wp.array], dt: float) -> float:
        """Return the cells that particles move in a step, if too many; collective.

        Returns 0 if all stay within the ghost cells.
        """
        return 0.0

    def should_rebalance(self, step: int) -> bool:
        """Return whether processes check for better parts in a step."""
        return False

    def rebalance(self, particles: Particles, a_cell: int) -> Subdomain | None:
        """Return the part of the grid that this process should have; collective.

        See `should_rebalance`. Returns None if the part stays the same.

        Args:
            particles: particles of this process; their totals have been computed.
            a_cell: particles in a full cell.
        """
        return None

    def notes(self) -> list[str]:
        """Return notes for the start of a run."""
        return []

    def owners(self, cells: np.ndarray) -> np.ndarray:
        """Return the process that owns each cell (x, y, z) of the domain, shape (n, 3)."""
        return np.zeros(len(cells), dtype=np.int64)

    def fill(
        self,
        *fields: wp.array | np.ndarray,
        width: int | None = None,
        parts: int = 1,
        forest: StarForest | None = None,
    ) -> None:
        """Halo exchange: fill the ghost cells of fields from their owners; collective.

        In one process there is nothing to do; on ranks see `Subdomain.fill`.

        Args:
            fields: arrays of any types, or stacks of equally many layers; the last axes are z, y,
                x.
            width: layers next to the owned cells; None for all.
            parts: the fields are those of `grid.refined(parts)`.
            forest: result of `forest`, for such fields; None for all cells.
        """

    def faces(self, window: Window) -> Window:
        """Return the cells of a window whose lower faces this process sums up.

        The window is one around its material.
        """
        return window

    def own_cells(self, window: Window) -> Window:
        """Return the cells of a window that this process sums up.

        The window is one around its material.
        """
        return window

    def whole(self, window: Window) -> Window:
        """Return the cells that all processes visit together, from one process's window.

        The window is one around its material.
        """
        return window

    def coarser(self, layers: int) -> StaggeredGrid | None:
        """Return the coarse grid, of twice the spacing, shared by the same processes.

        Returns None if they cannot share it.

        Args:
            layers: layers of ghost cells of its parts, the ring included.
        """
        return self.grid.coarser()

    @property
    def row_ranks(self) -> Ranks | None:
        """Processes that share rows along x, in order; None if rows are whole."""
        return None

    def known_of(self, field: np.ndarray) -> np.ndarray:
        """Return the view of a host field on the cells that only this process stores."""
        return field

    def box_of(self, field: FieldT) -> FieldT:
        """Return the view of a field, host or device, or of layers of one, on owned cells."""
        low, high = self.owned.low, self.owned.high
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        return cast(FieldT, field[(slice(None),) * (field.ndim - 3) + box])

    def fill_task(self, *fields: wp.array | np.ndarray, forest: StarForest) -> HostTask:
        """Return the exchange of a `forest`'s cells as a task.

        It runs at once or within a launch graph.
        """
        return HostTask(partial(self.fill, *fields, forest=forest))

    def forest(
        self,
        layers: int = 1,
        width: int | None = None,
        *,
        which: np.ndarray | None = None,
        into: StarForest | None = None,
    ) -> StarForest | None:
        """Return an exchange restricted to some cells, for `fill`; collective.

        Args:
            layers: number of layers of a field.
            width: layers of ghost cells next to the owned cells; None for all.
            which: bool mask of a field's cells; None for all.
            into: a forest that this one replaces, in recorded exchanges too; None if there is none.
        """

    def box_like(self, field: wp.array) -> wp.array:
        """Return the array that stands for a field in a problem on the owned cells.

        It is the field itself if that has no ghost cells.
        """
        return field

    def grid_field(self, box: wp.array) -> wp.array:
        """Return the field that stands for an array like those of `box_like` on the grid.

        It shares the array's memory if the part has no ghost cells.

        Args:
            box: flat, or in the shape of `box_like`.
        """
        return box.reshape(self.grid.shape)

    def copy_to_box(self, field: wp.array, box: wp.array) -> None:
        """Copy a field to the array of `box_like`, unless they share their memory."""

    def copy_from_box(self, box: wp.array, field: wp.array) -> None:
        """Copy the owned cells of an array like those of `box_like` to a field.

        Nothing is done if they share their memory.
        """

    def store(self, x: wp.array, field: wp.array, spare: wp.array) -> None:
        """Write the solution on the owned cells to a field, with ghost cells; collective.

        Args:
            x: float32 or float64, with as many elements as `box_like(field)`.
            field: float64 (written).
            spare: float64 memory of the size of x, which may be overwritten.
        """
        convert(x.flatten(), field.flatten())

    def poisson(self, cells: np.ndarray, **options: Unpack[PoissonArguments]) -> GridPoisson:
        """Return the operator of all processes' problem on the owned cells.

        The options are coefficients, fields of `box_like`, and periodic axes; see `GridPoisson`.
        """
        return GridPoisson(
            cells, device=self.grid.device, decomposition=self.decomposition, **options
        )
